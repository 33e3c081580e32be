"""Observability index O1: the volume of the ellipsoid of the singular values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.design.criteria.determinant import DeterminantCriterion
from elastocal.errors import require


@dataclass(frozen=True)
class FirstObservability(DeterminantCriterion):
    """`O1` = (σ_1 ⋯ σ_k)^{1/k} / √m, to be maximised: Φ_s = 1/(m O1²) = det(V_II)^{1/k}.

    m = `n_poses`, the number of measurement configurations.  At a given number of poses O1 orders
    plans as D does.  σ as in SpectralCriterion: of the scaled, whitened regressor with the
    nuisance columns projected out.  `reported`: O1, in noise standard deviations per typical size.
    Source: Menq & Borm 1988; Borm & Menq 1991, Int. J. Robotics Research 10(1), 51–63.
    """

    n_poses: int
    name = "O1"

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.n_poses > 0,
            f"O1 divides by the root of the number of poses, not {self.n_poses}; ask for one",
        )

    def reported(self, value: float) -> tuple[float, str]:
        return float(1 / np.sqrt(self.n_poses * value)), ""
