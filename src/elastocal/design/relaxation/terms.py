"""Smooth increasing functions φ of the covariance V = M⁻¹ (p, p) of one scenario.

Through V they are criteria of M: with C = ∂φ/∂V and A, A' two directions of M,

    ∂φ = −tr(G A),  G = V C V,        ∂²φ = 2 tr(A V A' G) + D²φ[V A V, V A' V],

so a term only states its value, C and the curvature D²φ that it has as a function of V.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from elastocal.design.criteria.base import Array, IntArray


class Term(ABC):
    """One or more functions φ_t(V), t = 1 … T."""

    count: int

    @abstractmethod
    def slope(self, V: Array) -> tuple[Array, Array]:
        """φ (T,) and C (T, p, p)."""

    @abstractmethod
    def curvature(self, V: Array, X: Array) -> Array | None:
        """D²φ[X_i, X_j] (k, k) of directions X (k, p, p) of V; None if φ is linear."""


@dataclass(frozen=True)
class Traces(Term):
    """φ_t = tr(C_t V), C (T, p, p): test poses, A, c, I; several of them for G."""

    C: Array

    @property
    def count(self) -> int:  # type: ignore[override]
        return len(self.C)

    def slope(self, V: Array) -> tuple[Array, Array]:
        return np.einsum("tij,ij->t", self.C, V), self.C

    def curvature(self, V: Array, X: Array) -> None:
        return None


@dataclass(frozen=True)
class Spectral(Term):
    """A function of the eigenvalues λ of V_II, I = `interest` (m,)."""

    interest: IntArray
    count: int = 1

    def slope(self, V: Array) -> tuple[Array, Array]:
        eigenvalues, U = np.linalg.eigh(V[np.ix_(self.interest, self.interest)])
        value, first = self._slope(eigenvalues)
        C = np.zeros((1, *V.shape))
        C[0][np.ix_(self.interest, self.interest)] = (U * first) @ U.T
        return np.array([value]), C

    def curvature(self, V: Array, X: Array) -> Array:
        eigenvalues, U = np.linalg.eigh(V[np.ix_(self.interest, self.interest)])
        turned = U.T @ X[:, self.interest[:, None], self.interest] @ U
        outer, mixed, factor = self._curvature(eigenvalues)
        along = np.einsum("kii,i->k", turned, outer)
        flat = turned.reshape(len(X), -1)
        return np.asarray(factor * np.outer(along, along) + (flat * mixed.ravel()) @ flat.T)

    @abstractmethod
    def _slope(self, eigenvalues: Array) -> tuple[float, Array]:
        """φ and ∂φ/∂λ (m,)."""

    @abstractmethod
    def _curvature(self, eigenvalues: Array) -> tuple[Array, Array, float]:
        """h (m,), K (m, m), f of D²φ[X, Y] = f ⟨h, diag X⟩⟨h, diag Y⟩ + Σ K_ab X_ab Y_ab
        in the eigenbasis of V_II (Daleckii–Krein)."""


@dataclass(frozen=True)
class RootDeterminant(Spectral):
    """φ = det(V_II)^{1/m}: D."""

    def _slope(self, eigenvalues: Array) -> tuple[float, Array]:
        value = float(np.exp(np.mean(np.log(eigenvalues))))
        return value, value / (len(eigenvalues) * eigenvalues)

    def _curvature(self, eigenvalues: Array) -> tuple[Array, Array, float]:
        value, first = self._slope(eigenvalues)
        return first, -value / (len(eigenvalues) * np.outer(eigenvalues, eigenvalues)), 1.0 / value


@dataclass(frozen=True)
class SquaredTraceRoot(Spectral):
    """φ = (tr V_II^{1/2})² = (Σ 1/σ_i)²: O5."""

    def _slope(self, eigenvalues: Array) -> tuple[float, Array]:
        roots = np.sqrt(eigenvalues)
        return float(roots.sum() ** 2), roots.sum() / roots

    def _curvature(self, eigenvalues: Array) -> tuple[Array, Array, float]:
        roots = np.sqrt(eigenvalues)
        mixed = -roots.sum() / (np.outer(roots, roots) * np.add.outer(roots, roots))
        return 0.5 / roots, mixed, 2.0
