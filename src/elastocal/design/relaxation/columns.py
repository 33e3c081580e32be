"""Column generation: a small support solved exactly, all other candidates priced against it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from elastocal.design.certificate import tangent_bound
from elastocal.design.criteria.base import Array, Gradient
from elastocal.design.problem import IntArray
from elastocal.design.relaxation.pool import Pool
from elastocal.design.relaxation.restricted import Restricted

MOST_ROUNDS = 200
# The master's gap as a part of the pool's: more would be lost on candidates that will change.
MASTER_PART = 0.1
# Of each level up to 1/ENTERING of its first candidates join per round.
ENTERING = 4
# How far each master starts from its bounds, as a part of the way to even weights.
LEAST_DEPTH, MOST_DEPTH = 1e-3, 0.1
# Weights below this part of the largest leave the support, unless their d is near the margin.
NEGLIGIBLE = 1e-4
# Information in a direction, as a part of that of the whole pool, which counts as none.
UNSEEN = 1e-6


@dataclass(frozen=True)
class Step:
    """One round: Φ of the weights at hand, the best bound so far, candidates in the master."""

    value: float
    bound: float
    support: int

    @property
    def gap(self) -> float:
        """1 − bound/Φ."""
        return max(1.0 - self.bound / self.value, 0.0)


class Master(Protocol):
    """Solves the problem on a few candidates."""

    def __call__(self, task: Restricted, start: Array, accuracy: float) -> tuple[Array, Gradient]:
        """w (k,) with a relative gap of `accuracy`, and a tangent that shows it.

        `start` (k,) is strictly inside the bounds.
        """


def optimise(
    pool: Pool,
    master: Master,
    start: Array,
    sizes: IntArray,
    tolerance: float,
    progress: Callable[[Step], None] | None,
) -> tuple[Array, Gradient, tuple[Step, ...]]:
    """Weights (N,) with 1 − bound/Φ ≤ tolerance, the tangent of the bound, and all rounds.

    `start` (N,) names the first candidates, by weight, `sizes` of each free level.  Ends with a
    wider gap where rounding hides which candidate could still improve the plan.
    """
    problem = pool.problem
    support = pool.best(start, sizes)
    weights = best = start
    value, bound, gap, accuracy = np.inf, 0.0, 1.0, MASTER_PART
    history: list[Step] = []
    for _ in range(MOST_ROUNDS):
        support, task = _regular(pool, support)
        inside = task.inside(weights[support], min(max(gap, LEAST_DEPTH), MOST_DEPTH))
        found, tangent = master(task, inside, accuracy)
        weights = pool.fixed.copy()
        weights[support] = found
        reached = float(problem.criterion.value(pool.information(weights)))
        if reached < value:
            best, value = weights, reached
        d = pool.sensitivity(tangent.G)
        certified = tangent_bound(problem, tangent, d)
        if not history or certified > bound:
            bound, steepest = certified, tangent
        history.append(Step(value, bound, len(support)))
        if progress is not None:
            progress(history[-1])
        gap = history[-1].gap
        margin, least = pool.margins(support, d)
        outside = np.where(d > (1.0 + 0.1 * tolerance) * margin, d, -np.inf)
        outside[support] = -np.inf
        entering = pool.best(outside, np.maximum(sizes // ENTERING, 1))
        finest = accuracy <= 0.1 * tolerance
        if gap <= tolerance or (len(entering) == 0 and finest):
            break
        accuracy = MASTER_PART * (gap if len(entering) else min(gap, accuracy))
        accuracy = max(accuracy, (0.5 if len(entering) else 0.1) * tolerance)
        kept = (task.relative(found) > NEGLIGIBLE) | (d[support] >= (1.0 - gap) * least[support])
        support = np.concatenate([support[kept], entering])
    return best, steepest, tuple(history)


def _regular(pool: Pool, support: IntArray) -> tuple[IntArray, Restricted]:
    """The support with candidates added until it sees every direction that the pool sees.

    Directions that Φ does not count, such as nuisance parameters beside c, draw no weight.
    """
    while True:
        task = pool.restricted(support)
        even = task.inside(np.zeros(len(support)), 1.0)
        M = pool.root @ task.information(even) @ pool.root.transpose(0, 2, 1)
        eigenvalues, U = np.linalg.eigh(M)
        unseen = eigenvalues < UNSEEN
        if not unseen.any():
            return support, task
        rows = (U * unseen[:, None, :]).transpose(0, 2, 1) @ pool.root
        d = pool.sensitivity(rows.transpose(0, 2, 1) @ rows)
        d[support] = -np.inf
        support = np.concatenate([support, pool.best(d, np.ones_like(pool.levels))])
