"""Least trimmed squares: the fit of the majority, whatever the rest says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

Array = NDArray[np.float64]

STARTS = 500
FINALISTS = 10
SEARCH_ROWS = 2000
INSIDE = 0.99


def least_trimmed_squares(
    B: Array, e: Array, size: int, seed: int = 0, starts: int = STARTS
) -> Array:
    """Shift Δ (columns,) minimising the sum of the smaller half of |e_i − B_i Δ|².

    B (n·size, columns) and e (n·size,) whitened, `size` rows per observation; up to half of the
    observations may be arbitrarily wrong.  FAST-LTS (Rousseeuw and Van Driessen 2006): many
    smallest possible random subsets, concentration steps, the best few run to the end.
    """
    n, p = len(e) // size, B.shape[1]
    if p == 0:
        return np.zeros(0)
    B3, e2 = B.reshape(n, size, p), e.reshape(n, size)
    rng = np.random.default_rng(seed)
    search = np.arange(n) if n <= SEARCH_ROWS else rng.choice(n, SEARCH_ROWS, replace=False)
    need = min(-(-p // size) + 1, n)
    trials = []
    for _ in range(starts):
        subset = rng.choice(search, need, replace=False)
        shift = _solve(B3[subset], e2[subset])
        for _ in range(2):
            shift, cost = _concentrate(B3[search], e2[search], shift)
        trials.append((cost, shift))
    trials.append((np.inf, np.zeros(p)))
    trials.sort(key=lambda t: t[0])
    best, best_cost = np.zeros(p), np.inf
    for _, shift in [*trials[:FINALISTS], trials[-1]]:
        cost = np.inf
        for _ in range(100):
            previous = cost
            shift, cost = _concentrate(B3, e2, shift)
            if cost >= previous * (1 - 1e-10):
                break
        if cost < best_cost:
            best, best_cost = shift, cost
    return best


def _concentrate(B: Array, e: Array, shift: Array) -> tuple[Array, float]:
    """Refit to the half with the smallest residuals; the trimmed cost never rises."""
    squared = ((e - B @ shift) ** 2).sum(axis=1)
    half = (len(e) + len(shift) // e.shape[1] + 1) // 2
    chosen = np.argpartition(squared, half - 1)[:half]
    shift = _solve(B[chosen], e[chosen])
    squared = np.sort(((e - B @ shift) ** 2).sum(axis=1))
    return shift, float(squared[:half].sum())


def _solve(B: Array, e: Array) -> Array:
    if B.shape[2] == 0:
        return np.zeros(0)
    return linalg.lstsq(B.reshape(-1, B.shape[2]), e.ravel(), cond=1e-10, check_finite=False)[0]


def majority(B: Array, e: Array, size: int, seed: int = 0) -> NDArray[np.bool_]:
    """Observations (n,) that agree with the least trimmed squares fit of the majority.

    Reweighted LTS, repeated: fit to the observations inside the 99 % limit of χ²(size), scale
    from those corrected for the cut, new limit.  Up to one in a hundred clean observations is
    left outside, so this is a suspicion, not a verdict.
    """
    n = len(e) // size
    B3, e2 = B.reshape(n, size, B.shape[1]), e.reshape(n, size)
    limit = stats.chi2.ppf(INSIDE, size)
    # Mean of a χ² variable cut at its 99 % point, per degree of freedom.
    cut = stats.chi2.cdf(limit, size + 2) / INSIDE
    squared = ((e2 - B3 @ least_trimmed_squares(B, e, size, seed)) ** 2).sum(axis=1)
    good = squared <= limit * median_scale(squared, size) ** 2
    for _ in range(50):
        shift = _solve(B3[good], e2[good])
        squared = ((e2 - B3 @ shift) ** 2).sum(axis=1)
        scale2 = squared[good].mean() / (size * cut)
        updated = squared <= limit * scale2
        if np.array_equal(updated, good) or updated.sum() <= n // 2:
            break
        good = updated
    return good


def median_scale(squared: Array, size: int) -> float:
    """Standard deviation per row from the median of squared lengths (n,), Gaussian-consistent."""
    return float(np.sqrt(np.median(squared) / stats.chi2.median(size)))
