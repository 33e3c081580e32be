"""Criteria that depend on the eigenvalues of the information of interest only."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from elastocal.design.criteria.base import Array, IntArray
from elastocal.design.criteria.marginal import Interest
from elastocal.design.criteria.scenarios import ScenarioCriterion


@dataclass(frozen=True)
class SpectralCriterion(ScenarioCriterion):
    """Φ_s = φ(μ_1, …, μ_k), μ the eigenvalues of M_I = (V_II)⁻¹, V = M_s⁻¹.

    σ_i = √μ_i are the singular values of the stacked, scaled and whitened regressor of the
    parameters `interest` (k,) after projecting the nuisance columns out: those of the
    observability indices.  Without nuisance parameters and with unit noise they are the singular
    values of the scaled regressor itself, as in the literature.
    Raises InputError for an empty, repeated or unknown `interest`.
    """

    interest: IntArray

    def __post_init__(self) -> None:
        _ = self.marginal  # an unusable choice is refused here, not at the first plan

    @cached_property
    def marginal(self) -> Interest:
        return Interest(self.interest)

    @abstractmethod
    def phi(self, mu: Array) -> Array:
        """φ (...,) of positive eigenvalues μ (..., k) in ascending order."""

    @abstractmethod
    def slope(self, mu: Array) -> Array:
        """−∂φ/∂μ_i (..., k); a subgradient at a kink."""

    def each(self, M: Array) -> Array:
        factor = self.marginal.factor(M)
        mu = self._positive(np.asarray(np.linalg.eigvalsh(self.marginal.information(factor))))
        return np.where(factor.regular, self.phi(mu), np.inf)

    def each_gradient(self, M: Array) -> tuple[Array, Array]:
        factor = self.marginal.factor(M)
        factor.require_regular()
        mu, U = np.linalg.eigh(self.marginal.information(factor))
        mu = self._positive(mu)
        rows = U.swapaxes(-1, -2) @ self.marginal.projection(factor)
        G = rows.swapaxes(-1, -2) @ (self.slope(mu)[..., None] * rows)
        return self.phi(mu), (G + G.swapaxes(-1, -2)) / 2

    @staticmethod
    def _positive(mu: Array) -> Array:
        """Eigenvalues lost in rounding beside the largest one, kept above zero."""
        return np.maximum(mu, np.finfo(float).eps * mu[..., -1:])
