"""A lower bound on the cost of every tour, to say how far a found one can be from the best."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import minimum_spanning_tree

Array = NDArray[np.float64]

STEPS = 400


def tour_bound(cost: Array, upper: float) -> float:
    """The larger of the assignment bound and the Held–Karp bound, ≤ every tour's cost.

    `cost` (V, V) of directed moves, V ≥ 2, finite; `upper`: cost of a known tour.  Held–Karp is
    taken on min(c_ij, c_ji), which no tour's cost falls below.
    """
    closed = cost + np.diag(np.full(len(cost), 2.0 * upper + 1.0))
    rows, columns = linear_sum_assignment(closed)
    assignment = float(closed[rows, columns].sum())
    return max(assignment, held_karp_bound(np.minimum(cost, cost.T), upper))


def held_karp_bound(cost: Array, upper: float) -> float:
    """max_π min over 1-trees of Σ (c_ij + π_i + π_j) − 2 Σ π_i (Held and Karp 1971).

    A 1-tree is a spanning tree of all nodes but node 0 and two edges at node 0; every tour is
    one, with degree 2 everywhere.  π by subgradient steps in the direction degree − 2, their
    length from `upper` (Polyak), halved when the bound stalls; every step's value is a bound.
    """
    n = len(cost)
    if n == 2:
        return float(2 * cost[0, 1])
    price, best, best_price = np.zeros(n), -np.inf, np.zeros(n)
    scale, stalled = 1.0, 0
    for _ in range(STEPS):
        value, degree = _one_tree(cost + price[:, None] + price[None, :])
        value -= 2 * float(price.sum())
        if value > best:
            best, best_price, stalled = value, price, 0
        else:
            stalled += 1
        slope = degree - 2.0
        if not slope.any():
            break
        if stalled == 10:
            scale, stalled, price = scale / 2, 0, best_price
            continue
        price = price + scale * max(upper - value, 1e-9 * abs(upper)) / float(slope @ slope) * slope
    return best


def _one_tree(cost: Array) -> tuple[float, Array]:
    """Cost and node degrees (V,) of the minimum 1-tree."""
    n = len(cost)
    rest = cost[1:, 1:]
    shift = 1.0 - float(rest.min())  # csgraph reads zeros of a dense matrix as missing edges
    tree = minimum_spanning_tree(rest + shift).tocoo()
    ends = np.argsort(cost[0, 1:], kind="stable")[:2] + 1
    total = float(tree.data.sum()) - shift * (n - 2) + float(cost[0, ends].sum())
    degree = np.bincount(np.concatenate([tree.row, tree.col]) + 1, minlength=n).astype(float)
    degree[ends] += 1
    degree[0] = 2
    return total, degree
