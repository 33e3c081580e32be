"""Data under one noise: what is left of the residual, and how probable the noise is.

With V the noise's covariance and the fitted parameters β ~ N(0, Λ⁻¹) integrated out,

    −2 ℓ = log|V| + rᵀPr + log|XᵀV⁻¹X + Λ| − log|Λ| + n log 2π,
    P = V⁻¹ − V⁻¹X (XᵀV⁻¹X + Λ)⁻¹ XᵀV⁻¹,

(restricted likelihood where Λ → 0; Patterson and Thompson 1971).
∂(−2ℓ)/∂θ = tr(P V_θ) − rᵀP V_θ P r.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.diagnosis.noise import NoiseValues, NoisyData, covariance, log_prior

Array = NDArray[np.float64]

ROUNDING = 1e-12


@dataclass(frozen=True)
class Projection:
    """The data under one noise: V⁻¹ (C, m, m), H = V⁻¹X L⁻ᵀ (C, m, p) with LLᵀ = XᵀV⁻¹X + Λ.

    P = V⁻¹ − HHᵀ; `u` = P r (C, m); `beta` (p,) the posterior mean β̂; `marginal` the log marginal
    likelihood ℓ.
    """

    inverse: Array
    H: Array
    u: Array
    beta: Array
    marginal: float
    factor: Array

    @cached_property
    def spread(self) -> tuple[Array, Array]:
        """V⁻¹e and Hᵀe, (C, m) and (C, p), of residuals e that scatter as the noise does.

        The fit's own residuals are too small, its leverage less than V: u_c has the covariance
        P_cc, so e_c = V_c^½ P_cc^−½ u_c has V_c (Bell and McCaffrey 2002).
        """
        P = self.inverse - self.H @ self.H.transpose(0, 2, 1)
        e = _power(self.inverse, -0.5) @ (_power(P, -0.5) @ self.u[..., None])
        return (self.inverse @ e)[..., 0], (self.H.transpose(0, 2, 1) @ e)[..., 0]

    @property
    def beta_deviation(self) -> Array:
        """L⁻¹ (p, p): the posterior covariance of β is L⁻ᵀL⁻¹."""
        return linalg.solve_triangular(self.factor, np.eye(len(self.factor)), lower=True)


def _power(blocks: Array, exponent: float) -> Array:
    """Symmetric powers of positive definite matrices (C, m, m)."""
    values, vectors = np.linalg.eigh(blocks)
    values = np.maximum(values, ROUNDING * values[:, -1:]) ** exponent
    return np.asarray((vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1))


@dataclass(frozen=True)
class Weighted:
    """The data whitened by one noise V = KKᵀ, whatever the prior of the coefficients: K⁻¹
    (C, m, m), K⁻¹X (C, m, p), K⁻¹r (C, m), M = XᵀV⁻¹X (p, p), z = XᵀV⁻¹r (p,), and the part of
    −2ℓ that stands without X, log|V| + rᵀV⁻¹r + n log 2π."""

    root: Array
    X: Array
    r: Array
    M: Array
    z: Array
    alone: float

    @classmethod
    def of(cls, data: NoisyData, noise: NoiseValues) -> Weighted:
        K = np.asarray(np.linalg.cholesky(covariance(data, noise)), dtype=np.float64)
        log_det = 2 * float(np.log(np.diagonal(K, axis1=1, axis2=2)).sum())
        root = _inverse(K)
        X, r = root @ data.counting.X, (root @ data.counting.r[..., None])[..., 0]
        flat = X.reshape(-1, X.shape[2])
        alone = log_det + float(np.vdot(r, r)) + data.n_rows * float(np.log(2 * np.pi))
        return cls(root, X, r, flat.T @ flat, flat.T @ r.ravel(), alone)

    def prior(self, precision: Array) -> Array:
        """Λ's diagonal (p,), and a little more: what others show as well and the prior leaves wide
        must not drown in rounding.  By each column's own size: a prior must not tighten because
        another column is large."""
        return precision + ROUNDING * np.diag(self.M)

    def factored(self, precision: Array) -> tuple[Array, Array, float]:
        """L of LLᵀ = M + Λ, L⁻¹z, and ℓ, for a prior of precision Λ (p,)."""
        M = self.M + np.diag(self.prior(precision))
        L: Array = linalg.cholesky(M, lower=True, check_finite=False)
        z = linalg.solve_triangular(L, self.z, lower=True, check_finite=False)
        log_det = 2 * float(np.log(np.diag(L)).sum()) - float(np.log(precision).sum())
        return L, z, -0.5 * (self.alone + log_det - float(z @ z))

    def marginal(self, precision: Array) -> float:
        """The log marginal likelihood ℓ alone, for a prior of precision Λ (p,)."""
        return self.factored(precision)[2]

    def projection(self, precision: Array) -> Projection:
        L, z, marginal = self.factored(precision)
        back = self.root.transpose(0, 2, 1)
        H = back @ _divided(self.X, L)
        u = (back @ self.r[..., None])[..., 0] - H @ z
        beta = linalg.solve_triangular(L, z, lower=True, trans="T", check_finite=False)
        return Projection(back @ self.root, H, u, beta, marginal, L)


def _inverse(K: Array) -> Array:
    """K⁻¹ of lower triangles K (C, m, m), by halves: a general inverse takes twice as long."""
    if K.shape[1] == 1:
        return 1 / K
    h = K.shape[1] // 2
    out = np.zeros_like(K)
    out[:, :h, :h] = upper = _inverse(K[:, :h, :h])
    out[:, h:, h:] = lower = _inverse(K[:, h:, h:])
    out[:, h:, :h] = -lower @ (K[:, h:, :h] @ upper)
    return out


def _divided(rows: Array, L: Array, overwrite: bool = False) -> Array:
    """rows L⁻ᵀ (…, p) of rows (…, p) and a lower triangle L (p, p)."""
    flat = rows.reshape(-1, rows.shape[-1])
    # BLAS itself, since scipy's solver hands the rows back column by column.
    divided = linalg.blas.dtrsm(1.0, L, flat.T, lower=1, overwrite_b=overwrite).T
    return np.asarray(divided.reshape(rows.shape))


def project(data: NoisyData, noise: NoiseValues) -> Projection:
    return Weighted.of(data, noise).projection(data.precision)


def posterior(data: NoisyData, noise: NoiseValues) -> float:
    """−2 log of marginal likelihood times prior of the noise."""
    marginal = Weighted.of(data, noise).marginal(data.precision)
    return -2 * marginal + log_prior(data.stated, noise)[0]


def likelihood(data: NoisyData, noise: NoiseValues) -> tuple[float, Array]:
    """−2 log of marginal likelihood times prior, and its slope in the logarithms (2 + joints,).

    The slope wants gᵀQg, Q = P − uuᵀ, of the joints' columns g in every visit and configuration:
    with g̃ = K⁻¹g and ẽ = K⁻¹(r − Xβ̂) it is g̃ᵀg̃ − |L⁻¹X̃ᵀg̃|² − (g̃ᵀẽ)².  What is left of V is
    the instrument's, and tr QV = n − tr (M + Λ)⁻¹M − ẽᵀẽ.
    """
    of, at = data.counting, Weighted.of(data, noise)
    L, z, marginal = at.factored(data.precision)
    beta = linalg.solve_triangular(L, z, lower=True, trans="T", check_finite=False)
    e = at.r - at.X @ beta
    g = of.by_visit @ at.root.transpose(0, 2, 1)
    # Few rows are divided by L rather than many.
    many = g.shape[1] >= g.shape[2]
    Xg = g @ _divided(at.X, L) if many else _divided(g @ at.X, L, overwrite=True)
    J = data.G.shape[2]
    by_visit, by_block = np.zeros(J), np.zeros(J)
    for sign, part in ((1, g), (-1, Xg), (-1, g @ e[..., None])):
        each = part.reshape(len(part), -1, J, part.shape[2])
        together = each.sum(axis=1)
        by_visit += sign * np.einsum("cvjk,cvjk->j", each, each)
        by_block += sign * np.einsum("cjk,cjk->j", together, together)
    inverse = linalg.solve_triangular(L, np.eye(len(L)), lower=True, check_finite=False)
    fitted = len(L) - float((inverse**2 @ at.prior(data.precision)).sum())
    slope = np.empty(2 + J)
    slope[1] = 2 * noise.shared**2 * float(by_block @ noise.joint**2)
    slope[2:] = 2 * noise.joint**2 * (by_visit + noise.shared**2 * by_block)
    slope[0] = 2 * (data.n_rows - fitted - float(np.vdot(e, e))) - slope[2:].sum()
    prior, prior_slope = log_prior(data.stated, noise)
    return -2 * marginal + prior, slope + prior_slope
