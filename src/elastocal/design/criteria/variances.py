"""Variances of linear functions of the parameters, now and after one more pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from elastocal.design.criteria.base import Array, candidate_sums
from elastocal.design.criteria.factor import Factor, factorise
from elastocal.design.criteria.low_rank import doubtful, trustworthy, whitened_rows


@dataclass(frozen=True)
class Variances:
    """φ_st = tr(F_st M_s⁻¹ F_stᵀ), the summed variance of F_st x̂ under scenario s.

    F (S, T, q, p): T groups of q linear functions of the p parameters.
    """

    F: Array

    def of(self, M: Array) -> Array:
        """φ (..., S, T) at M (..., S, p, p); inf where M_s is singular."""
        factor = factorise(M)
        return np.where(factor.regular[..., None], self._grouped(self._roots(factor)), np.inf)

    def with_gains(self, M: Array) -> tuple[Array, Array]:
        """φ (S, T), and V_s F_sᵀ (S, p, T, q) whose products are the −∂φ/∂M; M (S, p, p).

        Raises InsufficientDataError where M_s is singular.
        """
        factor = factorise(M)
        factor.require_regular()
        Z = self._roots(factor)
        gains = factor.inverse.swapaxes(-1, -2) @ Z
        return self._grouped(Z), gains.reshape(self._columns.shape[:2] + self.F.shape[1:3])

    def after_adding(self, M: Array, blocks: Array) -> Array:
        """φ (N, S, T) at M_s + B_siᵀ B_si; M (S, p, p), blocks (S, N, r, p)."""
        factor = factorise(M)
        n = blocks.shape[1]
        if not trustworthy(factor):
            return self._anew(M, blocks)
        Z = self._roots(factor)
        before = self._grouped(Z)
        values = np.empty((n, *before.shape))
        for part, W, K in whitened_rows(factor, blocks):
            values[part] = before - self._removed(W, K, Z).swapaxes(0, 1)
        condition = factor.condition[:, None]
        unsure = np.flatnonzero(doubtful(before, values, condition).any(axis=(1, 2)))
        values[unsure] = self._anew(M, blocks[:, unsure])
        return values

    @cached_property
    def _columns(self) -> Array:
        """F_sᵀ (S, p, T q)."""
        S, T, q, p = self.F.shape
        return np.ascontiguousarray(self.F.reshape(S, T * q, p).swapaxes(-1, -2))

    def _roots(self, factor: Factor) -> Array:
        """Z = L⁻¹ Fᵀ (..., S, p, T q), whose squares sum to φ."""
        return np.asarray(factor.inverse @ self._columns)

    def _grouped(self, Z: Array) -> Array:
        squares = (Z**2).sum(axis=-2)
        return np.asarray(squares.reshape(*squares.shape[:-1], *self.F.shape[1:3]).sum(axis=-1))

    def _removed(self, W: Array, K: Array, Z: Array) -> Array:
        """tr(Zᵀ Wᵀ K⁻¹ W Z) (S, n, T) by group, the variance that a pose takes away."""
        S, n, r, p = W.shape
        T, q = self.F.shape[1:3]
        X = (W.reshape(S, n * r, p) @ Z).reshape(S, n, r, T * q)
        if T == 1 and q > r:
            solved = np.linalg.solve(K, X @ X.swapaxes(-1, -2))
            return np.asarray(np.trace(solved, axis1=-2, axis2=-1)[..., None])
        products = (X * np.linalg.solve(K, X)).sum(axis=-2)
        return np.asarray(products.reshape(S, n, T, q).sum(axis=-1))

    def _anew(self, M: Array, blocks: Array) -> Array:
        values = np.empty((blocks.shape[1], *self.F.shape[:2]))
        for part, sums in candidate_sums(M, blocks):
            values[part] = self.of(sums)
        return values
