"""The noise floor: tracker noise, repeatability of each joint, scatter common to a configuration.

    V = a² Σ_stated + Σ_j s_j² g_j g_jᵀ ∘ (same visit + c² · same configuration)

with g_j = ∂(reading)/∂q_j.  a, s_j and c maximise the likelihood of the residuals with the fitted
parameters β ~ N(0, Λ⁻¹) integrated out,

    −2 ℓ = log|V| + rᵀPr + log|XᵀV⁻¹X + Λ| − log|Λ| + n log 2π,
    P = V⁻¹ − V⁻¹X (XᵀV⁻¹X + Λ)⁻¹ XᵀV⁻¹,

(restricted likelihood where Λ → 0; Patterson and Thompson 1971), times priors that keep what the
data do not show near its usual size.  ∂(−2ℓ)/∂θ = tr(P V_θ) − rᵀP V_θ P r.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.diagnosis.blocks import Blocks

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Logarithms' prior standard deviations.  Stated tracker noise is rarely wrong by more than 1.6
# times; a joint repeats to some 5 µrad on a heavy arm and to 50 on a light one; the joints of an
# arm differ by a factor of two.
STATED_SPREAD, UNSTATED_SPREAD = 0.5, 3.0
REPEATABILITY, REPEATABILITY_SPREAD = 8e-6, 1.5
JOINT_SPREAD = 0.7
SHARED, SHARED_SPREAD = 0.2, 1.2
ROUNDING = 1e-12
SMALLEST, LARGEST = 1e-9, 2e-2  # rad or m: a joint that is exact


@dataclass(frozen=True)
class NoiseValues:
    """`factor` a of the stated noise, `joint` s (joints,) in rad or m, `shared` c."""

    factor: float
    joint: Array
    shared: float

    @classmethod
    def usual(cls, joints: int) -> NoiseValues:
        """What one expects before any reading: noise as stated, joints as good as usual."""
        return cls(1.0, np.full(joints, REPEATABILITY), SHARED)

    def of_instrument(self) -> NoiseValues:
        """The instrument's part alone: joints that repeat exactly."""
        return NoiseValues(self.factor, np.full(len(self.joint), SMALLEST), SHARED)

    def logs(self) -> Array:
        return np.log(np.concatenate([[self.factor, self.shared], self.joint]))

    @classmethod
    def of_logs(cls, theta: Array) -> NoiseValues:
        v = np.exp(theta)
        return cls(float(v[0]), v[2:], float(v[1]))


@dataclass(frozen=True)
class NoisyData:
    """Packed residual r (C, m), nuisance X (C, m, p) with prior precision Λ (p,), and what noise
    is made of: stated covariance (C, m, m), joint columns G (C, m, joints).

    `stated` says whether the covariance is stated or only a shape; `left_out` (C, m) rows do not
    count (padding, faulty readings).
    """

    blocks: Blocks
    r: Array
    X: Array
    precision: Array
    covariance: Array
    G: Array
    same_visit: Array
    left_out: Mask
    stated: bool

    def with_columns(self, extra: Array, precision: Array) -> NoisyData:
        """The same with further columns (C, m, k) and their prior precisions (k,)."""
        X = np.concatenate([self.X, extra], axis=2)
        return replace(self, X=X, precision=np.concatenate([self.precision, precision]))

    def without(self, faulty: Mask) -> NoisyData:
        """The same with the observations where `faulty` (N,) holds left out."""
        padded = np.concatenate([faulty, [True]])[self.blocks.member]
        return replace(self, left_out=np.repeat(padded, self.blocks.size, axis=1))

    @property
    def faulty(self) -> Mask:
        """Observations (N,) that are left out."""
        return self.blocks.unpack(self.left_out[..., None].astype(float))[:, 0, 0] > 0

    @property
    def n_rows(self) -> int:
        return int((~self.left_out).sum())

    def masked(self, packed: Array) -> Array:
        """Rows that do not count set to zero (C, m, …)."""
        if not self.left_out.any():
            return packed
        keep = ~self.left_out
        return packed * keep.reshape(keep.shape + (1,) * (packed.ndim - 2))

    @cached_property
    def counting(self) -> Counting:
        """What is evaluated at many noises, rows that do not count set to zero once."""
        G, keep = self.masked(self.G), ~self.left_out
        both = keep[:, :, None] & keep[:, None, :]
        visit = self.blocks.places.one_hot
        by_visit = (visit[..., None] * G[:, :, None, :]).reshape(*G.shape[:2], -1)
        by_visit = np.ascontiguousarray(by_visit.transpose(0, 2, 1))
        return Counting(
            self.masked(self.r), self.masked(self.X), G, by_visit,
            self.covariance if keep.all() else self.covariance * both,
        )  # fmt: skip


@dataclass(frozen=True)
class Counting:
    """Residual, columns, joint columns, those of each visit by itself (C, visits·joints, m), and
    stated covariance, with zeros where nothing counts."""

    r: Array
    X: Array
    G: Array
    by_visit: Array
    covariance: Array


def covariance(data: NoisyData, noise: NoiseValues) -> Array:
    """V (C, m, m); rows left out have unit variance of their own."""
    of = data.counting
    V = (of.G * noise.joint**2) @ of.G.transpose(0, 2, 1)
    V *= data.same_visit + noise.shared**2
    V += noise.factor**2 * of.covariance
    m = np.arange(V.shape[1])
    V[:, m, m] += data.left_out
    return V


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
        K = np.linalg.cholesky(covariance(data, noise))
        log_det = 2 * float(np.log(np.diagonal(K, axis1=1, axis2=2)).sum())
        root = _inverse(K)
        X, r = root @ data.counting.X, (root @ data.counting.r[..., None])[..., 0]
        flat = X.reshape(-1, X.shape[2])
        alone = log_det + float(np.vdot(r, r)) + data.n_rows * float(np.log(2 * np.pi))
        return cls(root, X, r, flat.T @ flat, flat.T @ r.ravel(), alone)

    def prior(self, precision: Array) -> Array:
        """Λ's diagonal (p,), and a little more: what no reading shows and the prior leaves wide
        must not drown in rounding."""
        return precision + ROUNDING * np.diag(self.M).max(initial=0.0)

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


def _divided(rows: Array, L: Array) -> Array:
    """rows L⁻ᵀ (…, p) of rows (…, p) and a lower triangle L (p, p)."""
    flat = rows.reshape(-1, rows.shape[-1])
    divided = linalg.solve_triangular(L, flat.T, lower=True, check_finite=False).T
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
    Xg = g @ _divided(at.X, L) if many else _divided(g @ at.X, L)
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


def log_prior(stated: bool, noise: NoiseValues) -> tuple[float, Array]:
    """−2 log prior of the logarithms and its slope.

    The joints' logarithms have a common mean that is itself uncertain.
    """
    theta = noise.logs()
    spread = STATED_SPREAD if stated else UNSTATED_SPREAD
    z = np.array([theta[0] / spread, (theta[1] - np.log(SHARED)) / SHARED_SPREAD])
    slope = np.zeros_like(theta)
    slope[:2] = 2 * z / np.array([spread, SHARED_SPREAD])
    joints = theta[2:]
    n = len(joints)
    inverse = np.linalg.inv(JOINT_SPREAD**2 * np.eye(n) + REPEATABILITY_SPREAD**2)
    away = joints - np.log(REPEATABILITY)
    slope[2:] = 2 * inverse @ away
    return float(z @ z + away @ inverse @ away), slope
