"""D-optimality: the volume of the confidence ellipsoid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.design.criteria.base import Array
from elastocal.design.criteria.low_rank import trustworthy, whitened_rows
from elastocal.design.criteria.spectral import SpectralCriterion


@dataclass(frozen=True)
class DeterminantCriterion(SpectralCriterion):
    """`D`: Φ_s = det(V_II)^{1/k} = (Π μ_i)^{−1/k}, V = M⁻¹; D_s-optimality with nuisance.

    The k-th root makes efficiencies comparable: Φ halves when every pose is measured twice.  An
    efficiency does not depend on the parametrisation of the parameters of interest.  `reported`:
    log det of the covariance V_II of the scaled parameters, without unit.
    Source: Wald 1943; Pukelsheim 2006, ch. 6 and 9; Atkinson, Donev & Tobias 2007, ch. 11.
    """

    name = "D"

    def phi(self, mu: Array) -> Array:
        return np.asarray(np.exp(-np.log(mu).mean(axis=-1)))

    def slope(self, mu: Array) -> Array:
        return np.asarray(self.phi(mu)[..., None] / (mu.shape[-1] * mu))

    def each(self, M: Array) -> Array:
        factor = self.marginal.factor(M)
        pivots = np.diagonal(factor.L, axis1=-2, axis2=-1)[..., -self.marginal.count :]
        return np.where(factor.regular, self.phi(pivots**2), np.inf)

    def each_after_adding(self, M: Array, blocks: Array) -> Array:
        """det(V_II) = det(M_NN)/det(M), and a pose multiplies each by one r × r determinant."""
        factor = self.marginal.factor(M)
        if not trustworthy(factor):
            return super().each_after_adding(M, blocks)
        order = self.marginal.ordered(M.shape[-1])
        nuisance = len(order) - self.marginal.count
        growth = np.empty((blocks.shape[1], len(M)))
        for part, W, K in whitened_rows(factor, blocks[..., order]):
            gained = _log_det(K)
            if nuisance:
                # L is lower triangular, so W's first columns are B_N L_NN⁻ᵀ.
                N = W[..., :nuisance]
                gained -= _log_det(np.eye(W.shape[-2]) + N @ N.swapaxes(-1, -2))
            growth[part] = gained.T
        return np.asarray(self.each(M) * np.exp(-growth / self.marginal.count))

    def reported(self, value: float) -> tuple[float, str]:
        return self.marginal.count * float(np.log(value)), "log det"


def _log_det(K: Array) -> Array:
    """log det (...,) of positive definite K (..., r, r)."""
    pivots = np.diagonal(np.linalg.cholesky(K), axis1=-2, axis2=-1)
    return np.asarray(2 * np.log(pivots).sum(axis=-1))
