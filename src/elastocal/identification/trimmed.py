"""The fit of the majority, whatever the rest says: least trimmed squares and the median's scale."""

from __future__ import annotations

from operator import itemgetter

import numpy as np
from scipy import special

from elastocal.identification.linear_solver import least_norm
from elastocal.units import Array, BoolArray, IntArray


def median_scale(length: Array, size: int) -> float:
    """σ = med|e_i| / median of χ(size): the MAD about zero for size 1; breakdown 50 %.

    `length` (n,) of the observations' residuals.
    """
    return float(np.median(length) / np.sqrt(special.chdtri(size, 0.5)))


STARTS = 500
FINALISTS = 10
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
    rng, need = np.random.default_rng(seed), min(-(-p // size) + 1, n)
    subsets = np.array([rng.choice(n, need, replace=False) for _ in range(starts)])
    shifts, costs = _searched(B3, e2, subsets)
    finalists = [*shifts[np.argsort(costs, kind="stable")[:FINALISTS]], np.zeros(p)]
    return min((_ended(B3, e2, one) for one in finalists), key=itemgetter(1))[0]


def _ended(B: Array, e: Array, shift: Array) -> tuple[Array, float]:
    """Where refits to the half with the smallest residuals end, from `shift`, and the trimmed cost
    there, which never rises."""
    half = (len(e) + len(shift) // e.shape[1] + 1) // 2
    squared, cost = ((e - B @ shift) ** 2).sum(axis=1), np.inf
    for _ in range(100):
        chosen, previous = np.argpartition(squared, half - 1)[:half], cost
        shift = _solve(B[chosen], e[chosen])
        squared = ((e - B @ shift) ** 2).sum(axis=1)
        cost = float(np.sort(squared)[:half].sum())
        if cost >= previous * (1 - 1e-10):
            break
    return shift, cost


def _solve(B: Array, e: Array) -> Array:
    if B.shape[2] == 0:
        return np.zeros(0)
    return least_norm(B.reshape(-1, B.shape[2]), e.ravel(), cond=1e-10, check_finite=False)


def _searched(B: Array, e: Array, subsets: IntArray) -> tuple[Array, Array]:
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


def _solve_normal(products: Array, chosen: IntArray) -> Array:
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


def majority(B: Array, e: Array, size: int, seed: int = 0) -> BoolArray:
    """Observations (n,) that agree with the least trimmed squares fit of the majority.

    Reweighted LTS, repeated: fit to the observations inside the 99 % limit of χ²(size), scale
    from those corrected for the cut, new limit.  Up to one in a hundred clean observations is
    left outside, so this is a suspicion, not a verdict.
    """
    n = len(e) // size
    B3, e2 = B.reshape(n, size, B.shape[1]), e.reshape(n, size)
    limit = special.chdtri(size, 1 - INSIDE)
    # Mean of a χ² variable cut at its 99 % point, per degree of freedom.
    cut = special.chdtr(size + 2, limit) / INSIDE
    squared = ((e2 - B3 @ least_trimmed_squares(B, e, size, seed)) ** 2).sum(axis=1)
    good = squared <= limit * median_scale(np.sqrt(squared), size) ** 2
    for _ in range(50):
        squared = ((e2 - B3 @ _solve(B3[good], e2[good])) ** 2).sum(axis=1)
        updated = squared <= limit * squared[good].mean() / (size * cut)
        if np.array_equal(updated, good) or updated.sum() <= n // 2:
            break
        good = updated
    return good
