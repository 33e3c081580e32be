"""Least trimmed squares: the fit of the majority, whatever the rest says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

Array = NDArray[np.float64]

STARTS = 500
FINALISTS = 10
SEARCH_ROWS = 2000
STEPS = 2  # of every start before the best are chosen
TOGETHER = 100  # starts whose residuals are held at a time
RIDGE = 1e-12
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
    subsets = np.array([rng.choice(len(search), need, replace=False) for _ in range(starts)])
    shifts, costs = _searched(B3[search], e2[search], subsets)
    finalists = shifts[np.argsort(costs, kind="stable")[:FINALISTS]]
    best, best_cost = np.zeros(p), np.inf
    for shift in [*finalists, np.zeros(p)]:
        cost = np.inf
        for _ in range(100):
            previous = cost
            shift, cost = _concentrate(B3, e2, shift)
            if cost >= previous * (1 - 1e-10):
                break
        if cost < best_cost:
            best, best_cost = shift, cost
    return best


def _searched(B: Array, e: Array, subsets: NDArray[np.int64]) -> tuple[Array, Array]:
    """Shifts (starts, p) and trimmed costs (starts,) two steps from `subsets` (starts, need).

    The normal equations of any choice of observations are a sum of those of single ones, so one
    product sets them up for all starts.  They cost half the digits, which a search can spare: the
    finalists go on with B itself.
    """
    n, size, p = B.shape
    scale = np.linalg.norm(B.reshape(-1, p), axis=0)
    scale[scale == 0] = 1.0
    unit = B / scale
    back = unit.transpose(0, 2, 1)
    products = np.concatenate([back @ unit, back @ e[:, :, None]], axis=2).reshape(n, -1)
    half = (n + p // size + 1) // 2
    shifts, costs = np.empty((len(subsets), p)), np.empty(len(subsets))
    for first in range(0, len(subsets), TOGETHER):
        which = slice(first, first + TOGETHER)
        nearest = subsets[which]
        for step in range(STEPS + 1):
            shift = _solve_normal(products, nearest)
            left = e.ravel()[:, None] - unit.reshape(-1, p) @ shift.T
            squared = (left.reshape(n, size, -1) ** 2).sum(axis=1).T  # (starts, n)
            if step < STEPS:
                nearest = np.argpartition(squared, half - 1, axis=1)[:, :half]
        shifts[which] = shift / scale
        costs[which] = np.partition(squared, half - 1, axis=1)[:, :half].sum(axis=1)
    return shifts, costs


def _solve_normal(products: Array, chosen: NDArray[np.int64]) -> Array:
    """Least squares (starts, p) of the `chosen` (starts, k) observations, from their products.

    A ridge keeps a direction that they do not show where it is.
    """
    inside = np.zeros((len(chosen), len(products)))
    np.put_along_axis(inside, chosen, 1.0, axis=1)
    p = int(np.sqrt(products.shape[1]))
    summed = (inside @ products).reshape(len(chosen), p, p + 1)
    normal, right = summed[:, :, :p].copy(), summed[:, :, p:]
    own = np.arange(p)
    normal[:, own, own] += RIDGE * np.maximum(
        np.trace(normal, axis1=1, axis2=2)[:, None], np.finfo(float).tiny / RIDGE
    )
    return np.asarray(np.linalg.solve(normal, right)[..., 0], dtype=np.float64)


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
