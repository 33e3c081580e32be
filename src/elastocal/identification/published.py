"""The estimators of Klimchik et al. 2013, exactly as published.

They are here to be reproduced and compared with; `identify` is what to use.  What they are worth
is measured in experiment_design/kr270_reproduction.  Symbols as in the paper: B (rows, parameters),
Δp (rows,), W = diag(w), Σ = diag(σ).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from elastocal.identification.least_squares import orthogonal
from elastocal.messages import InputError
from elastocal.units import Array, IntArray

SMALLEST = 1e-9  # m, below any tracker's resolution: σ_i of zero has no inverse
SIGMA_0 = 10e-6  # m, the tracker's claimed precision, σ₀ of eq. (14)


@dataclass(frozen=True, eq=False)
class PublishedFit:
    """X̂ (parameters,), its stated covariance (parameters, parameters) and the weights w (rows,).

    `residual` (rows,) is Δp − B X̂.  `converged`: of `eq14`, whether values and intervals have
    settled.
    """

    method: str
    x: Array
    covariance: Array
    weights: Array
    residual: Array
    converged: bool = True

    @property
    def std(self) -> Array:
        """Stated standard deviations (parameters,); the paper's intervals are ±3 of them."""
        return np.sqrt(np.diag(self.covariance))


def ols(B: Array, dp: Array, sigma: Array | None = None) -> PublishedFit:
    """Ordinary least squares, eq. (6).

    Covariance by eq. (7), s² (BᵀB)⁻¹ with s² = rss/(rows − parameters), or, where `sigma`
    (rows,) is given, by the sandwich of eq. (8), (BᵀB)⁻¹ BᵀΣ²B (BᵀB)⁻¹.
    """
    found = replace(wls(B, dp, np.ones(np.shape(dp)), sigma), method="ols")
    if sigma is not None:
        return found
    s2 = float(found.residual @ found.residual) / (len(dp) - len(found.x))
    return replace(found, covariance=s2 * found.covariance)


def wls(B: Array, dp: Array, weights: Array, sigma: Array | None = None) -> PublishedFit:
    """Weighted least squares, eq. (10), minimising Σ (w_i (B X − Δp)_i)² (eq. 9).

    Covariance by eq. (11), (BᵀW²B)⁻¹ BᵀW²Σ²W²B (BᵀW²B)⁻¹, with the σ given; without σ by the
    corrected eq. (13), (BᵀΣ⁻²B)⁻¹ with σ = 1/w, which is what (11) becomes where WΣ = I.
    """
    B, dp = _finite("B", B, 2), _finite("dp", dp, 1)
    if len(dp) != len(B):
        raise InputError(f"dp must have shape ({len(B)},), as B has {len(B)} rows; got {dp.shape}")
    w = _positive("weights", weights, len(dp))
    (Q, V), x = orthogonal(w[:, None] * B), np.zeros(B.shape[1])
    for _ in range(3):  # refined twice
        x = x + V @ (Q.T @ (w * (dp - B @ x)))
    covariance = V @ V.T
    if sigma is not None:
        middle = B * (w**2 * _positive("sigma", sigma, len(dp)))[:, None]
        covariance = covariance @ (middle.T @ middle) @ covariance
    return PublishedFit("wls", x, covariance, w, dp - B @ x)


def eq14_weights(sigma: Array, sigma_0: float = SIGMA_0, lam: float = 1.0) -> Array:
    """w_i = σ₀ / (σ₀ + λ σ_i), eq. (14); σ₀ keeps a lucky σ_i of zero from ruling the fit."""
    if sigma_0 <= 0 or lam <= 0:
        raise InputError(f"eq. (14) needs positive σ₀ and λ; found {sigma_0} and {lam}")
    return sigma_0 / (sigma_0 + lam * np.asarray(sigma, dtype=float))


def group_sigma(residual: Array, group: IntArray) -> Array:
    """σ_i (rows,) as the standard deviation of the residuals in the row's group.

    A group is a configuration in one direction: 3 markers × 6 repeats give 18 values.
    Raises InputError where a group has a single value.
    """
    count = np.bincount(group)
    if (count[count > 0] < 2).any():
        raise InputError("σ by group needs at least two readings per configuration and direction")
    mean = np.bincount(group, residual) / np.maximum(count, 1)
    squared = np.bincount(group, (residual - mean[group]) ** 2)
    return np.sqrt(squared / np.maximum(count - 1, 1))[group]


def eq14(
    B: Array, dp: Array, group: IntArray | None = None, *, sigma_0: float = SIGMA_0,
    lam: float = 1.0, iterations: int = 30, tolerance: float = 1e-6,
) -> list[PublishedFit]:  # fmt: skip
    """WLS with the weights of eq. (14), iterated until values and intervals settle.

    They have settled (`converged` of the last entry) where no value and no stated standard
    deviation moves by a share of `tolerance`; after so many `iterations` it ends in any case.

    σ_i comes from the groups (`group` (rows,) given), or from each residual itself, σ_i = |e_i|,
    which is what the paper's figures need.  The first entry is OLS with eq. (8), each following
    one uses the residuals of its predecessor; the last is the result.  Stated covariance: eq. (13)
    with those σ_i, (BᵀΣ⁻²B)⁻¹, as the paper's intervals are: a reading that the fit happens to
    pass through counts as known exactly, which is why they are far too small per residual.
    """
    first = ols(B, dp)
    if group is not None:
        if np.shape(group) != first.residual.shape:
            raise InputError(
                f"group takes a label per row of B, ({len(first.residual)},); got shape "
                f"{np.shape(group)}"
            )
        group = np.unique(group, return_inverse=True)[1].ravel()

    def sigma_of(found: PublishedFit) -> Array:
        residual = found.residual
        return np.abs(residual) if group is None else group_sigma(residual, group)

    history = [ols(B, dp, np.maximum(sigma_of(first), SMALLEST))]
    method = "eq14 per residual" if group is None else "eq14 by group"
    for _ in range(iterations):
        before, sigma = history[-1], sigma_of(history[-1])
        stated = wls(B, dp, 1 / np.maximum(sigma, SMALLEST)).covariance
        now = wls(B, dp, eq14_weights(sigma, sigma_0, lam))
        now = replace(now, method=method, covariance=stated, converged=False)
        history.append(now)
        moved = np.abs(now.x - before.x) / np.maximum(np.abs(now.x), 1e-300)
        widened = np.abs(now.std - before.std) / now.std
        if len(history) > 2 and max(moved.max(), widened.max()) < tolerance:
            history[-1] = replace(now, converged=True)
            break
    return history


def _finite(name: str, values: Array, dimensions: int) -> Array:
    array = np.asarray(values, dtype=float)
    if array.ndim != dimensions or 0 in array.shape or not np.isfinite(array).all():
        shape = "(rows, parameters)" if dimensions == 2 else "(rows,)"
        raise InputError(f"{name} must be finite numbers {shape}; got shape {array.shape}")
    return array


def _positive(name: str, values: Array, n: int) -> Array:
    checked = np.asarray(values, dtype=float)
    if checked.shape != (n,) or not (np.isfinite(checked) & (checked > 0)).all():
        raise InputError(f"{name} must be {n} positive finite numbers; got shape {checked.shape}")
    return checked
