"""Tuning constants for a given efficiency or breakdown point, computed for the dimension.

Under normal noise the scaled length of an observation of `size` rows follows χ(size).  With
r = e/σ, Ψ(r) = ψ(|r|) r/|r| and J = ∂Ψ/∂r, symmetry gives E J = a·I and E ΨΨᵀ = b·I with

    a = E[ψ′/size + (1 − 1/size) ψ(d)/d],    b = E ψ²/size,

the asymptotic covariance σ² (b/a²)(BᵀB)⁻¹ and the efficiency a²/b (Huber 1981, section 7.6, for
size 1; Maronna 1976 for vectors).  The constant for 95 % is 1.345 (Huber) or 4.685 (bisquare)
for size 1 and grows with the dimension: three components at once are seldom all small.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import integrate, optimize, stats

from elastocal.errors import require
from elastocal.identification.robust.loss import Bisquare, Huber, Loss

Array = NDArray[np.float64]

EFFICIENCY = 0.95


def normal_mean(g: Callable[[Array], Array], size: int, kink: float | None = None) -> float:
    """E g(d) for d ~ χ(size), g smooth except perhaps at `kink`."""
    density = stats.chi(size).pdf
    end = float(stats.chi.isf(1e-17, size))
    edges = [0.0, end] if kink is None or not 0 < kink < end else [0.0, kink, end]
    total = 0.0
    for low, high in pairwise(edges):
        part, _ = integrate.quad(
            lambda d: float(g(np.asarray(d))) * density(d), low, high, epsabs=1e-13, epsrel=1e-12
        )
        total += part
    return total


def normal_moments(loss: Loss) -> tuple[float, float]:
    """a and b of the loss at the normal (see the module); efficiency is a²/b."""
    share = 1 / loss.size
    a = normal_mean(
        lambda d: share * loss.slope(d) + (1 - share) * loss.weight(d), loss.size, loss.kink
    )
    return a, share * normal_mean(lambda d: loss.psi(d) ** 2, loss.size, loss.kink)


def efficiency(loss: Loss) -> float:
    """Asymptotic efficiency at the normal relative to least squares, scale known."""
    a, b = normal_moments(loss)
    return a**2 / b


@lru_cache
def huber(size: int = 1, efficient: float = EFFICIENCY) -> Huber:
    """Huber's loss with the given efficiency at the normal for observations of `size` rows.

    Raises InputError where not even the L1 limit is that inefficient.
    """
    c = _solve(lambda c: efficiency(Huber(size, c)), efficient, 1e-3)
    return Huber(size, c)


@lru_cache
def bisquare(size: int = 1, efficient: float = EFFICIENCY) -> Bisquare:
    """Tukey's bisquare with the given efficiency at the normal for observations of `size` rows."""
    start = breakdown_bisquare(size).c
    return Bisquare(size, _solve(lambda c: efficiency(Bisquare(size, c)), efficient, start / 2))


@lru_cache
def breakdown_bisquare(size: int = 1, breakdown: float = 0.5) -> Bisquare:
    """Bisquare of the S-estimate with E ρ = breakdown · sup ρ at the normal.

    1.5476 for size 1 and breakdown 50 % (Rousseeuw and Yohai 1984).
    """
    require(0 < breakdown <= 0.5, f"a breakdown point lies in (0, 0.5]; found {breakdown}")

    def share(c: float) -> float:
        loss = Bisquare(size, c)
        return 1 - normal_mean(loss.rho, size, c) / loss.largest

    return Bisquare(size, _solve(share, 1 - breakdown, 1e-2))


def _solve(rising: Callable[[float], float], target: float, low: float) -> float:
    """c with rising(c) = target, from `low` upwards."""
    require(
        rising(low) < target < 1,
        f"an efficiency of {target} is out of reach: it must lie between {rising(low):.3g} and 1",
    )
    high = 2 * low
    while rising(high) < target:
        high *= 2
    return float(optimize.brentq(lambda c: rising(c) - target, low, high, xtol=1e-12, rtol=1e-13))
