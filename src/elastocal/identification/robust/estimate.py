"""The result of every robust linear fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.robust.design import Design, lengths
from elastocal.identification.robust.loss import Loss

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RobustEstimate:
    """x (p,) with Σ B_iᵀ Ψ(e_i/σ) = 0, its residual (rows,), scale σ and the loss.

    `weights` (n,) are ψ(d)/d of each observation, 1 for what counts in full and 0 for what is
    rejected (unbounded where an L1 fit meets an observation).  They solve the estimating equation
    and are NOT inverse variances; for the covariance see `asymptotic`.  `optimality` says how
    nearly x is optimal: |Σ Q_iᵀ Ψ| over √Σ|Ψ|² with an orthonormal basis Q of B, or for L1 the
    duality gap relative to the minimum.
    """

    design: Design
    loss: Loss
    x: Array
    residual: Array
    scale: float
    converged: bool
    iterations: int
    optimality: float

    @property
    def distance(self) -> Array:
        """|e_i|/σ (n,)."""
        return lengths(self.residual, self.design.size) / self.scale

    @property
    def weights(self) -> Array:
        return self.loss.weight(self.distance)

    @property
    def objective(self) -> float:
        """Σ ρ(|e_i|/σ)."""
        return float(self.loss.rho(self.distance).sum())


def score_optimality(design: Design, loss: Loss, residual: Array, scale: float) -> float:
    """|Σ Q_iᵀ Ψ_i| / √Σ|Ψ_i|², zero at a solution of the estimating equation."""
    d = lengths(residual, design.size) / scale
    scores = design.rows(loss.weight(d)) * residual / scale
    size = float(np.linalg.norm(scores))
    return float(np.linalg.norm(design.Q.T @ scores)) / size if size > 0 else 0.0
