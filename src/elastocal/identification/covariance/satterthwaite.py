"""Satterthwaite degrees of freedom of variance estimates that are sums of squares.

A sandwich estimate of var(x̂_j) is v_j = Σ_c (a_cᵀ e_c)², with e = (I − QQᵀ)u and one vector a_c
per cluster.  Under the working model u ~ N(0, σ²I) the numbers a_cᵀe_c have covariance
σ²Γ, Γ = diag(a_cᵀa_c) − b bᵀ with rows b_c = Q_cᵀa_c, and v_j has the mean σ² tr Γ and the
variance 2σ⁴ tr Γ².  A scaled χ² with the same two moments has

    dof_j = (tr Γ)² / tr Γ²

(Satterthwaite 1946; Bell & McCaffrey 2002; Pustejovsky & Tipton 2018).  With

    tr Γ = Σ_c (a_cᵀa_c − |b_c|²),   tr Γ² = Σ_c [(a_cᵀa_c)² − 2 a_cᵀa_c |b_c|²] + ‖Σ_c b_c b_cᵀ‖²

only p-dimensional quantities are summed over clusters; neither Γ nor I − QQᵀ is formed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class SatterthwaiteSums:
    """The sums over clusters for all p parameters at once, added block by block."""

    def __init__(self, p: int) -> None:
        self._size, self._trace, self._square = np.zeros(p), np.zeros(p), np.zeros(p)
        self._outer = np.zeros((p, p, p))

    def add(self, aa: Array, b: Array) -> None:
        """Add clusters: aa (clusters, p) with a_cᵀa_c, b (clusters, p of Q, p) with b_c."""
        bb = np.sum(b * b, axis=1)
        self._size += aa.sum(axis=0)
        self._trace += (aa - bb).sum(axis=0)
        self._square += (aa * (aa - 2 * bb)).sum(axis=0)
        by_parameter = b.transpose(2, 1, 0)
        self._outer += by_parameter @ by_parameter.transpose(0, 2, 1)

    def dof(self) -> Array:
        """Degrees of freedom (p,); 0 where the residual says nothing of the variance."""
        square = self._square + np.sum(self._outer**2, axis=(1, 2))
        told = (self._trace > 1e-9 * self._size) & (square > 0)
        return np.where(told, self._trace**2 / np.where(told, square, 1.0), 0.0)
