"""Criteria as the largest of smooth pieces, with the derivatives that Newton's method takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.design.criteria.base import Array, Gradient
from elastocal.design.relaxation.terms import Term


@dataclass(frozen=True)
class Pieces:
    """Φ(M) = max_j Φ_j, Φ_j = Σ_t mix_jt φ_t(M_s(t)⁻¹).

    `terms`: one Term per scenario s; the columns of `mix` (J, T) ≥ 0 are their functions in order.
    One row is a smooth criterion (a mean over scenarios), the identity the worst case.
    """

    terms: tuple[Term, ...]
    mix: Array

    def at(self, M: Array) -> Local | None:
        """Φ_j and derivatives at M (S, p, p); None where M is not positive definite."""
        try:
            root = np.linalg.inv(np.linalg.cholesky(M))
        except np.linalg.LinAlgError:
            return None
        V = root.transpose(0, 2, 1) @ root
        slopes = [term.slope(V_s) for term, V_s in zip(self.terms, V, strict=True)]
        values = self.mix @ np.concatenate([value for value, _ in slopes])
        if not np.all(np.isfinite(values)):
            return None
        return Local(self, V, values, [C for _, C in slopes])


@dataclass(frozen=True)
class Local:
    """The pieces at one M: V (S, p, p), `values` Φ_j (J,), C = ∂φ/∂V of each scenario's terms."""

    pieces: Pieces
    V: Array
    values: Array
    C: list[Array]

    def shares(self, mu: Array) -> list[Array]:
        """Σ_j μ_j mix_jt/Φ_j (T_s,) per scenario: how much each term counts in Σ μ_j log Φ_j."""
        counts = np.cumsum([term.count for term in self.pieces.terms])[:-1]
        return list(np.split((mu / self.values) @ self.pieces.mix, counts))

    def slopes(self, A: Array) -> Array:
        """−∂ log Φ_j/∂w_i (J, k) for A (S, k, p, p)."""
        of_terms = []
        for V, C, A_s in zip(self.V, self.C, A, strict=True):
            G = V @ C @ V
            of_terms.append(G.reshape(len(G), -1) @ A_s.reshape(len(A_s), -1).T)
        return np.asarray(self.pieces.mix @ np.concatenate(of_terms)) / self.values[:, None]

    def tangent(self, mu: Array) -> Gradient:
        """Φ_μ = Σ c_j Φ_j ≤ Φ with c_j ∝ μ_j/Φ_j, Σ c_j = 1, and its G.

        1/Φ_μ is concave as 1/Φ is, so the tangent bounds Φ too; at the optimum, where μ are the
        multipliers, it is tight, while a single piece would not be.
        """
        scale = 1.0 / np.sum(mu / self.values)
        shares = self.shares(mu)
        C = np.stack([np.tensordot(c, C, 1) for c, C in zip(shares, self.C, strict=True)])
        return Gradient(float(scale * mu.sum()), scale * (self.V @ C @ self.V))

    def hessian(self, A: Array, mu: Array, slopes: Array) -> Array:
        """Σ_j μ_j ∂² log Φ_j/∂w_i∂w_j (k, k); `slopes` (J, k) as from `slopes`."""
        k = A.shape[1]
        H = -(slopes.T * mu) @ slopes
        for term, share, V, C, A_s in zip(
            self.pieces.terms, self.shares(mu), self.V, self.C, A, strict=True
        ):
            AV = A_s @ V
            G = V @ np.tensordot(share, C, 1) @ V
            # tr(A_i V A_j G): A_i V beside the transpose of A_j G.
            H += 2.0 * AV.reshape(k, -1) @ (A_s @ G).transpose(0, 2, 1).reshape(k, -1).T
            curvature = term.curvature(V, V @ AV)
            if curvature is not None:
                H += share[0] * curvature
        return 0.5 * (H + H.T)
