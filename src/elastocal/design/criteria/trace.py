"""Linear criteria: a weighted sum of the variances and covariances of the parameters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from elastocal.design.criteria.base import Array
from elastocal.design.criteria.scenarios import ScenarioCriterion
from elastocal.design.criteria.variances import Variances
from elastocal.errors import require

ASYMMETRY = 1e-9


@dataclass(frozen=True)
class TraceCriterion(ScenarioCriterion):
    """Φ_s = tr(C_s M_s⁻¹), L-optimality: C (S, p, p) symmetric, positive semidefinite, not 0.

    Nuisance parameters are marginalised by their rows and columns of C being zero.
    `reported` is `scale` · √Φ in `unit`.  1/Φ is concave for any C (Pukelsheim 2006, ch. 3 and
    5).  Raises InputError for another C.
    Source: Fedorov 1972; Atkinson, Donev & Tobias 2007, ch. 10 (L- or linear optimality).
    """

    C: Array
    name: str
    scale: float = 1.0
    unit: str = ""

    def __post_init__(self) -> None:
        C = self.C
        require(
            C.ndim == 3 and C.shape[1] == C.shape[2],
            f"C of the {self.name} criterion has shape {C.shape}; give (scenarios, p, p)",
        )
        size = np.abs(C).max(axis=(1, 2), initial=0.0)
        require(
            bool(np.isfinite(size).all() and (size > 0).all()),
            f"C of the {self.name} criterion is zero or not finite: no target depends on the "
            "parameters; check the test poses, loads and parameters of interest",
        )
        skew = np.abs(C - C.swapaxes(-1, -2)).max(axis=(1, 2))
        lowest = np.linalg.eigvalsh(C)[:, 0]
        require(
            bool((skew <= ASYMMETRY * size).all() and (lowest >= -ASYMMETRY * size).all()),
            f"C of the {self.name} criterion is not symmetric and positive semidefinite",
        )

    @cached_property
    def variances(self) -> Variances:
        """φ with F (S, 1, q, p), FᵀF = C and q the largest rank of the C_s."""
        eigenvalues, U = np.linalg.eigh(self.C)
        lost = len(U[0]) * np.finfo(float).eps * eigenvalues[:, -1:]
        kept = (eigenvalues > lost).any(axis=0)
        root = np.sqrt(np.maximum(eigenvalues, 0.0))[:, None, :] * U
        return Variances(root[:, None, :, kept].swapaxes(-1, -2))

    def each(self, M: Array) -> Array:
        return np.asarray(self.variances.of(M)[..., 0])

    def each_gradient(self, M: Array) -> tuple[Array, Array]:
        values, gains = self.variances.with_gains(M)
        gains = gains[:, :, 0]
        return values[:, 0], gains @ gains.swapaxes(-1, -2)

    def each_after_adding(self, M: Array, blocks: Array) -> Array:
        return np.asarray(self.variances.after_adding(M, blocks)[..., 0])

    def reported(self, value: float) -> tuple[float, str]:
        return self.scale * float(np.sqrt(value)), self.unit
