"""A criterion with one figure per scenario of the arm, averaged over the scenarios."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from elastocal.design.criteria.base import Array, Criterion, Gradient, candidate_sums


class ScenarioCriterion(Criterion):
    """Φ = (1/S) Σ_s Φ_s(M_s): the expectation over equally likely scenarios of the true arm.

    A nonlinear model's B depends on the parameters that are still to be found; the scenarios are
    draws from what is known of them (Atkinson, Donev & Tobias 2007, ch. 18).  1/Φ is the harmonic
    mean of the concave 1/Φ_s over S and hence concave.  With S = 1 this is Φ_1 itself.
    """

    @abstractmethod
    def each(self, M: Array) -> Array:
        """Φ_s (..., S) of M (..., S, p, p); inf where M_s is singular."""

    @abstractmethod
    def each_gradient(self, M: Array) -> tuple[Array, Array]:
        """Φ_s (S,) and −∂Φ_s/∂M_s (S, p, p) at M (S, p, p).

        Raises InsufficientDataError where M_s is singular.
        """

    def each_after_adding(self, M: Array, blocks: Array) -> Array:
        """Φ_s (N, S) at M_s + B_siᵀ B_si; M (S, p, p), blocks (S, N, r, p)."""
        values = np.empty((blocks.shape[1], len(M)))
        for part, sums in candidate_sums(M, blocks):
            values[part] = self.each(sums)
        return values

    def value(self, M: Array) -> Array:
        return np.asarray(self.each(M).mean(axis=-1))

    def gradient(self, M: Array) -> Gradient:
        values, G = self.each_gradient(M)
        return Gradient(float(values.mean()), G / len(values))

    def after_adding(self, M: Array, blocks: Array) -> Array:
        return np.asarray(self.each_after_adding(M, blocks).mean(axis=-1))

    def softened(self, order: float) -> ScenarioCriterion:
        return self
