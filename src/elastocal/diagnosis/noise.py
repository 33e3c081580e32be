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
from scipy import linalg, optimize

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
STRIDE, STRIDES = 1.5, 6  # of the logarithms
ENOUGH = 0.01  # change of −2ℓ at which a search ends
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
        keep = ~self.left_out
        return packed * keep.reshape(keep.shape + (1,) * (packed.ndim - 2))


def covariance(data: NoisyData, noise: NoiseValues) -> Array:
    """V (C, m, m); rows left out have unit variance of their own."""
    by_joint = (data.G * noise.joint**2) @ data.G.transpose(0, 2, 1)
    V = noise.factor**2 * data.covariance + by_joint * (data.same_visit + noise.shared**2)
    keep = ~data.left_out
    V = V * (keep[:, :, None] & keep[:, None, :])
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


def project(data: NoisyData, noise: NoiseValues) -> Projection:
    V = covariance(data, noise)
    X, r = data.masked(data.X), data.masked(data.r)
    C, m, p = X.shape
    L = np.linalg.cholesky(V)
    log_det = 2 * float(np.log(np.diagonal(L, axis1=1, axis2=2)).sum())
    inverse: Array = np.asarray(np.linalg.inv(V))
    VX = inverse @ X
    M = X.reshape(-1, p).T @ VX.reshape(-1, p)
    # What no reading shows and the prior leaves wide must not drown in rounding.
    M += np.diag(data.precision + ROUNDING * np.diag(M).max(initial=0.0))
    factor: Array = linalg.cholesky(M, lower=True)
    log_det += 2 * float(np.log(np.diag(factor)).sum()) - float(np.log(data.precision).sum())
    H: Array = linalg.solve_triangular(factor, VX.reshape(-1, p).T, lower=True).T.reshape(C, m, p)
    Vr = (inverse @ r[..., None])[..., 0]
    z = H.reshape(-1, p).T @ r.ravel()
    squares = float(r.ravel() @ Vr.ravel() - z @ z)
    minus_two = log_det + squares + data.n_rows * float(np.log(2 * np.pi))
    beta = linalg.solve_triangular(factor, z, lower=True, trans="T")
    return Projection(inverse, H, Vr - H @ z, beta, -0.5 * minus_two, factor)


def likelihood(data: NoisyData, noise: NoiseValues) -> tuple[float, Array]:
    """−2 log of marginal likelihood times prior, and its slope in the logarithms (2 + joints,)."""
    at = project(data, noise)
    Q = at.inverse - at.H @ at.H.transpose(0, 2, 1) - at.u[:, :, None] * at.u[:, None, :]
    keep = ~data.left_out
    Q = Q * (keep[:, :, None] & keep[:, None, :])
    slope = np.empty(2 + data.G.shape[2])
    slope[0] = 2 * noise.factor**2 * float((Q * data.covariance).sum())
    G = data.G
    by_visit = ((Q * data.same_visit) @ G * G).sum(axis=(0, 1))
    by_block = (Q @ G * G).sum(axis=(0, 1))
    slope[1] = 2 * noise.shared**2 * float(by_block @ noise.joint**2)
    slope[2:] = 2 * noise.joint**2 * (by_visit + noise.shared**2 * by_block)
    prior, prior_slope = log_prior(data.stated, noise)
    return -2 * at.marginal + prior, slope + prior_slope


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


def fit_noise(data: NoisyData, start: NoiseValues | None = None) -> NoiseValues:
    """The most probable noise values, by a quasi-Newton search in their logarithms.

    Where nothing is stated it starts from two ends, unless a start is given.
    """
    if start is not None:
        return _climbed(data, start)
    starts = [NoiseValues.usual(data.G.shape[2])]
    if not data.stated:
        starts.append(_balanced(data))
    ends = [_climbed(data, s) for s in starts]
    return min(ends, key=lambda end: likelihood(data, end)[0])


def _balanced(data: NoisyData) -> NoiseValues:
    """Instrument and joints share the scatter of the data equally.

    From far below it the likelihood is flat in a joint's logarithm, and no climb leaves.
    """
    used = ~data.left_out
    whole = float((data.r[used] ** 2).mean())
    shape = float(np.diagonal(data.covariance, axis1=1, axis2=2)[used].mean())
    moved = np.maximum((data.G[used] ** 2).mean(axis=0), 1e-300)
    joint = np.clip(np.sqrt(0.5 * whole / (len(moved) * moved)), SMALLEST, LARGEST)
    return NoiseValues(float(np.sqrt(0.5 * whole / shape)), joint, SHARED)


def _climbed(data: NoisyData, start: NoiseValues) -> NoiseValues:
    n = data.G.shape[2]

    def cost(theta: Array) -> tuple[float, Array]:
        return likelihood(data, NoiseValues.of_logs(theta))

    spread = STATED_SPREAD if data.stated else UNSTATED_SPREAD
    lower = np.array([-4 * spread, -5.0] + [np.log(SMALLEST)] * n)
    upper = np.array([4 * spread, 2.0] + [np.log(LARGEST)] * n)
    theta = np.clip(start.logs(), lower, upper)
    ftol = ENOUGH / max(abs(cost(theta)[0]), 1.0)
    # Step by step: one long stride of the line search ends where V is singular to rounding.
    for _ in range(STRIDES):
        low, high = np.maximum(lower, theta - STRIDE), np.minimum(upper, theta + STRIDE)
        found = optimize.minimize(
            cost, theta, jac=True, method="L-BFGS-B", bounds=list(zip(low, high, strict=True)),
            options={"maxiter": 60, "ftol": ftol, "gtol": 3e-2},
        )  # fmt: skip
        theta = found.x
        inside = (theta > low) & (theta < high) | (theta == lower) | (theta == upper)
        if inside.all():
            break
    return NoiseValues.of_logs(theta)
