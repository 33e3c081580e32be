"""Plans built up or cut down pose by pose, each time by the one that matters most or least."""

from __future__ import annotations

import numpy as np

from elastocal.design.exact.contribution import values_without
from elastocal.design.exact.exchange import best_addition
from elastocal.design.exact.pool import admissible
from elastocal.design.exact.regular import RIDGES, is_regular, log_det_gain, ridge
from elastocal.design.problem import DesignProblem, IntArray


def greedy_plan(problem: DesignProblem, begun: IntArray | None = None) -> IntArray:
    """A plan (n_poses,), sorted: `begun` extended, each time by the pose that lowers Φ most.

    While the information is singular and Φ infinite, the pose that raises the determinant most
    above a vanishing ridge.  The plan may still be singular: see `regular_plan`.
    """
    chosen = np.empty(0, dtype=np.int64) if begun is None else begun
    extra = RIDGES[-1] * ridge(problem)
    while len(chosen) < problem.n_poses:
        taken = np.bincount(problem.group[chosen], minlength=len(problem.shares))
        open_groups = np.flatnonzero(problem.shares > taken)
        into = np.sort(np.concatenate([admissible(problem, chosen, int(g)) for g in open_groups]))
        M = problem.prior + problem.sum_of(chosen)
        best = best_addition(problem, M, into) if is_regular(M) else None
        if best is None:
            best = into[np.argmax(log_det_gain(M + extra, problem.blocks[:, into]))]
        chosen = np.sort(np.append(chosen, best))
    return chosen


def fitted(problem: DesignProblem, chosen: IntArray) -> IntArray:
    """A plan (n_poses,), sorted, of these shares from one of others.

    Where a group holds more than its share, the poses that Φ misses least go; then `greedy_plan`
    fills up.  Where no share is smaller than before the result is therefore never worse.
    """
    chosen = np.sort(chosen)
    while True:
        taken = np.bincount(problem.group[chosen], minlength=len(problem.shares))
        surplus = np.flatnonzero((taken > problem.shares)[problem.group[chosen]])
        if not len(surplus):
            return greedy_plan(problem, chosen)
        least = surplus[np.argmin(values_without(problem, chosen)[surplus])]
        chosen = np.delete(chosen, least)
