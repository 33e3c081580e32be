"""Robust scale of the lengths of whitened residuals, consistent at the normal."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from elastocal.errors import require
from elastocal.identification.robust.loss import Bisquare, Huber
from elastocal.identification.robust.tuning import normal_mean, normal_moments

Array = NDArray[np.float64]


@lru_cache
def median_length(size: int) -> float:
    """Median of χ(size); 0.6745 for size 1."""
    return float(stats.chi.median(size))


def median_scale(length: Array, size: int) -> float:
    """σ = med|e_i| / median of χ(size): the MAD about zero for size 1; breakdown 50 %.

    `length` (n,) of the observations' residuals.
    """
    return float(np.median(length)) / median_length(size)


@lru_cache
def _beta(loss: Huber) -> float:
    return normal_moments(loss)[1]


def proposal_2(length: Array, size: int, p: int = 0, c: float | None = None) -> float:
    """Huber's proposal 2: σ with Σ ψ(|e_i|/σ)² = (n·size − p) E ψ²/size (Huber 1964, 1981).

    `length` (n,), `p` fitted parameters, `c` of Huber's ψ, by default 2.5 for size 1 and the
    same probability beyond it for other sizes.
    """
    tail = float(stats.chi.isf(stats.chi.sf(2.5, 1), size)) if c is None else c
    loss = Huber(size, tail)
    beta = _beta(loss) * (len(length) * size - p)

    def excess(scale: float) -> float:
        return float((loss.psi(length / scale) ** 2).sum()) - beta

    # Σ min(d, c)² never exceeds n c²: with too few degrees of freedom there is no solution.
    return _root(excess, length)


def m_scale(length: Array, loss: Bisquare, p: int = 0) -> float:
    """M-scale of the S-estimate: σ with Σ ρ(|e_i|/σ) = (n − p/size) E ρ.

    `length` (n,); n − p/size counts observations less what the `p` parameters use up, which
    takes most of the small-sample bias away (Maronna and Yohai 2010).  0 where so many lengths
    are zero that every σ > 0 is too large.
    """
    target = expected_rho(loss) * (len(length) - p / loss.size)

    def excess(scale: float) -> float:
        return float(loss.rho(length / scale).sum()) - target

    return _root(excess, length)


@lru_cache
def expected_rho(loss: Bisquare) -> float:
    """E ρ(d) at the normal."""
    return normal_mean(loss.rho, loss.size, loss.c)


def _root(excess: Callable[[float], float], length: Array) -> float:
    """Scale at which the falling `excess` crosses zero, 0 where it is negative throughout."""
    require(bool(length.size), "a scale needs at least one residual")
    largest = float(length.max())
    positive = length[length > 0]
    if not positive.size or excess(float(positive.min()) * 1e-3) <= 0:
        return 0.0
    high = largest
    while excess(high) > 0:
        high *= 2
    low = float(positive.min()) * 1e-3
    return float(optimize.brentq(excess, low, high, xtol=1e-300, rtol=1e-13, maxiter=500))
