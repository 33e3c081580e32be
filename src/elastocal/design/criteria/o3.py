"""Observability index O3: the smallest singular value."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.design.criteria.eigenvalue import EigenvalueCriterion


@dataclass(frozen=True)
class ThirdObservability(EigenvalueCriterion):
    """`O3` = σ_min, to be maximised: Φ_s = 1/O3² = 1/μ_1; it orders plans as E does.

    σ as in SpectralCriterion: of the scaled, whitened regressor with the nuisance columns
    projected out.  `reported`: O3, in noise standard deviations per typical size.
    Source: Nahvi, Hollerbach & Hayward 1994, IEEE Int. Conf. Robotics and Automation, 407–412.
    """

    name = "O3"

    def reported(self, value: float) -> tuple[float, str]:
        return float(1 / np.sqrt(value)), ""
