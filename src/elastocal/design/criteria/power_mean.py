"""The power mean, which turns a maximum into a smooth function that never exceeds it."""

from __future__ import annotations

import numpy as np

from elastocal.design.criteria.base import Array


def power_mean(x: Array, order: float) -> Array:
    """(Σ_i x_i^q / n)^{1/q} (...,) of positive x (..., n), q = `order` ≥ 1; max_i x_i for q = inf.

    It lies between n^{−1/q} max x and max x.  Of degree 1, and for 1/x_i concave in M so is its
    reciprocal, a power mean of exponent −q of the 1/x_i (Hardy, Littlewood & Pólya 1934, ch. 2).
    """
    largest = x.max(axis=-1)
    if order == np.inf:
        return np.asarray(largest)
    # Relative to the largest, no power overflows; where that is inf the mean is inf too.
    scale = np.where(np.isfinite(largest), largest, 1.0)
    ratio = np.minimum(x / scale[..., None], 1.0)
    return np.asarray(largest * (ratio**order).mean(axis=-1) ** (1 / order))


def power_mean_slope(x: Array, order: float) -> Array:
    """∂ mean/∂x_i (..., n); for q = inf the subgradient of the first largest x_i."""
    n = x.shape[-1]
    if order == np.inf:
        return np.asarray(np.arange(n) == x.argmax(axis=-1)[..., None], dtype=float)
    return np.asarray((x / power_mean(x, order)[..., None]) ** (order - 1) / n)
