"""Polish: the poses of an exact plan moved off the pool, one after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.design.polish.local_search import search_all
from elastocal.design.polish.objective import PlanValue
from elastocal.design.polish.searches import Searches, distinct, trials
from elastocal.design.problem import DesignProblem
from elastocal.errors import require

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Progress = Callable[[str], None]

ORDER = 20.0  # of the power means that stand for a criterion's kinks while IPOPT searches
SHORTLIST = 200  # candidates by sensitivity among which a pose's further starts are sought
LEAST_GAIN = 1e-8  # relative improvement of Φ that counts as one


@dataclass(frozen=True)
class Step:
    """In sweep `sweep` pose `pose` of the plan moved, and Φ fell from `before` to `after`."""

    sweep: int
    pose: int
    before: float
    after: float


@dataclass(frozen=True)
class Polished:
    """The plan's poses q (k, n) in the order given, Φ before and after, and every step taken.

    `moved` (k,) marks the poses that are no longer the candidates they were.
    """

    q: Array
    before: float
    after: float
    moved: NDArray[np.bool_]
    steps: tuple[Step, ...]


def polish(
    problem: DesignProblem,
    searches: Searches,
    q: Array,
    load: IntArray,
    chosen: IntArray,
    *,
    starts: int = 3,
    sweeps: int = 5,
    tolerance: float = 1e-4,
    jobs: int = 1,
    progress: Progress = lambda message: None,
) -> Polished:
    """The plan `chosen` (k,) of a pool q (N, n), load (N,), improved continuously.

    Block coordinate descent: pose after pose is moved to

        min Φ(M − B_jᵀB_j + B(q)ᵀB(q))   over its level, joint limits and the cell's margins

    by IPOPT, from where it is and from the `starts` best candidates for its place.  Every end,
    and points on the way to it, are evaluated exactly and checked by the cell's own rules; the
    best that passes is taken, so Φ never rises and no rule is broken.  Sweeps end when one gains
    less than `tolerance`.  The result does not depend on `jobs`, the number of processes.

    Raises InputError where starts < 0 or sweeps < 1.
    """
    require(starts >= 0, f"polish needs a number of starts, got {starts}")
    require(sweeps >= 1, f"polish needs at least one sweep, got {sweeps}")
    plan = _Plan(problem, searches, q, load, np.asarray(chosen), starts, jobs)
    before, steps = plan.value, []
    for sweep in range(sweeps):
        progress(f"polishing poses, sweep {sweep + 1}: {problem.criterion.name} {plan.value:.6g}")
        at_start, shortlist = plan.value, plan.shortlist()
        for j in range(len(plan.q)):
            old = plan.value
            if plan.improve(j, shortlist):
                steps.append(Step(sweep, j, old, plan.value))
        if plan.value > at_start * (1 - tolerance):
            break
    moved = (plan.q != q[plan.chosen]).any(axis=1)
    return Polished(plan.q, before, plan.value, moved, tuple(steps))


class _Plan:
    """The plan as it stands: poses `q` (k, n), their blocks, Φ `value`."""

    def __init__(
        self,
        problem: DesignProblem,
        searches: Searches,
        pool: Array,
        load: IntArray,
        chosen: IntArray,
        starts: int,
        jobs: int,
    ) -> None:
        self.problem, self.searches, self.pool, self.load = problem, searches, pool, load
        self.chosen, self.starts, self.jobs = chosen, starts, jobs
        self.smooth = problem.criterion.softened(ORDER)
        self.q = pool[chosen].copy()
        self.blocks = problem.blocks[:, chosen].copy()
        self.value = float(problem.criterion.value(self.information()))

    def information(self, without: int | None = None) -> Array:
        """M (S, p, p) of the plan, or of all its poses but one."""
        kept = [i for i in range(len(self.q)) if i != without]
        B = self.blocks[:, kept]
        return self.problem.prior + np.einsum("snri,snrj->sij", B, B, optimize=True)

    def shortlist(self) -> dict[tuple[int, int], IntArray]:
        """The candidates of largest sensitivity, per group and load state of the plan."""
        G = self.problem.criterion.gradient(self.information()).G
        d = self.problem.sensitivity(G)
        best = {}
        for group, load in {self._kind(j) for j in range(len(self.q))}:
            own = np.flatnonzero((self.problem.group == group) & (self.load == load))
            best[group, load] = own[np.argsort(-d[own], kind="stable")[:SHORTLIST]]
        return best

    def improve(self, j: int, shortlist: dict[tuple[int, int], IntArray]) -> bool:
        """Move pose j if that lowers Φ; says whether it did."""
        group, load = self._kind(j)
        M = self.information(without=j)
        starts = np.vstack([self.q[j], self._others(M, shortlist[group, load])])
        unit = float(self.smooth.value(self.information()))
        search = self.searches.at(self.q[j], load, group)
        goal = PlanValue(self.smooth, M, unit)
        ends = search_all([(search, goal, starts)], self.jobs)
        poses = trials(starts, ends)
        blocks = self.searches.blocks(poses, load)
        values = self.problem.criterion.after_adding(M, blocks)
        better = np.flatnonzero(values < self.value * (1 - LEAST_GAIN))
        better = better[self.searches.feasible(poses[better], load)] if len(better) else better
        if not len(better):
            return False
        best = better[values[better].argmin()]
        self.q[j], self.blocks[:, j], self.value = poses[best], blocks[:, best], float(values[best])
        return True

    def _others(self, M: Array, shortlist: IntArray) -> Array:
        """The best candidates for a place in a plan whose rest has information M."""
        values = self.problem.criterion.after_adding(M, self.problem.blocks[:, shortlist])
        ranked = self.pool[shortlist[np.argsort(values, kind="stable")]]
        return ranked[distinct(ranked, self.starts)]

    def _kind(self, j: int) -> tuple[int, int]:
        candidate = self.chosen[j]
        return int(self.problem.group[candidate]), int(self.load[candidate])
