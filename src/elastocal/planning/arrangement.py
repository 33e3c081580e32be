"""The order of a plan that moves can follow; poses that none reaches are replaced, and polished."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from elastocal.model.chain import finite_ranges, joint_limits
from elastocal.planning.checkpoint import State
from elastocal.planning.criteria import inverse
from elastocal.planning.exchange import exchange, fitted
from elastocal.planning.execution import Alias, Execution, at_stops, schedule
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.moves import Unreachable, blockers_of
from elastocal.planning.search import Search, Selection
from elastocal.planning.setup import FeasiblePool, Setup
from elastocal.units import Array, BoolArray, IntArray, Progress

SAME = 1e-9  # of the largest number of the blocks: rounding
MOST_REPLACED = 50  # poses that cannot be reached, before that is said instead
TRIED = 6  # poses of a plan one of which a pose put into it must be able to reach
LIKELY = 400  # candidates that gain most, of which that is found out
VIA = 200  # candidates through which a blocked move may go


def ordered(
    search: Search, found: Selection, pinned: FeasiblePool | None = None
) -> tuple[Selection, Execution, list[str]]:
    """The selection in the order of its levels, its execution, and warnings.

    Poses that no chain of free moves reaches are replaced by the best others, unless they are
    `pinned`, and all poses then polished again, as far as moves reach them there.  Raises
    InsufficientDataError where that does not end.
    """
    order = _Ordering(search, _Paths(search.searches.checker), pinned)
    plan, execution = order.reachable(found)
    if order.gone:
        plan, execution = order.polished(plan, execution)
    return plan, execution, _warnings(order.gone, execution)


class _Ordering:
    """Plans put in order; `gone` poses of them were unreachable so far."""

    def __init__(self, search: Search, paths: _Paths, pinned: FeasiblePool | None) -> None:
        self.search, self.paths, self.pinned, self.gone = search, paths, pinned, 0
        self.unwound = False
        self.found: Selection | None = None

    def reachable(self, found: Selection) -> tuple[Selection, Execution]:
        """The plan, or that with others in the place of unreachable poses, in an order."""
        shares = self.search.problem(found.pool).shares
        while True:
            try:
                plan, execution = self.put(found)
            except Unreachable as error:
                if not self.unwound:
                    self.unwound = True
                    continue
                pool, whole = found.pool, found.whole(self.pinned)
                gone = np.unique(whole.chosen[error.poses])
                others = np.delete(pool.group, gone[gone < len(pool)])
                few = np.bincount(others, minlength=len(shares)) < shares
                if self.gone >= MOST_REPLACED or (gone >= len(pool)).any() or few.any():
                    raise
                self.gone += len(error.poses)
                self.search.progress(
                    f"{self.gone} poses that no free move reaches are replaced by the best others"
                )
                there = whole.pool.q[np.setdiff1d(whole.chosen, gone)]
                chosen = self.search.checkpoint.finished(
                    f"replaced{self.gone}",
                    lambda: self._replaced(found, gone, there),  # noqa: B023
                )["chosen"]
                kept = np.setdiff1d(np.arange(len(pool)), gone)
                value = self.search.value(pool, chosen)
                first = found.first - int((gone < found.first).sum())
                found = found.exchanged(pool.take(kept), np.searchsorted(kept, chosen), value)
                certificate = replace(found.certificate, pool=len(kept))
                found = replace(found, first=first, certificate=certificate)
                continue
            self.found = found
            return plan, execution

    def put(self, found: Selection) -> tuple[Selection, Execution]:
        search, plan = self.search, found.whole(self.pinned)
        setup = search.setup
        if self.unwound:
            plan = _unwound(setup, plan, self.paths.feasibility)
        q, blocks = plan.pool.q[plan.chosen], plan.pool.blocks[plan.chosen]
        plain, M = search.plain, search.plain.gathered(blocks)
        readings = plan.pool.readings[plan.chosen]
        alias = Alias.of(plain.information, q, blocks, M, plain.target_rows, readings)
        plan = replace(plan, alias=alias)
        return plan, _execution(setup, plan, self.paths, search.seed, search.progress)

    def polished(self, plan: Selection, execution: Execution) -> tuple[Selection, Execution]:
        found, search = self.found, self.search
        if found is None or not search.effort.starts:
            return plan, execution
        pool, chosen = search.polished(found.pool, found.chosen, "replaced")
        value = search.value(pool, chosen)
        if value >= found.value:
            return plan, execution
        try:
            return self.put(found.exchanged(pool, chosen, value))
        except Unreachable:
            return plan, execution

    def _replaced(self, found: Selection, gone: IntArray, there: Array) -> State:
        """What is `chosen` instead of the plan `found` without the candidates `gone`.

        In their place, and by exchange in that of others, come those of the LIKELY candidates of a
        level that a free move joins, as postures, to poses of the plan that are `there`.
        """
        problem, were = self.search.problem(found.pool), found.chosen
        q = _nearer(self.paths.feasibility, found.pool.q)
        kept, pool = np.setdiff1d(were, gone), [were]
        V = inverse(problem.information(were))
        worth = problem.prices(V @ problem.criterion.slope(V)[1] @ V)
        for level, share in enumerate(problem.shares):
            own = np.setdiff1d(np.flatnonzero(problem.group == level), were)
            ranked, n = own[np.argsort(-worth[own], kind="stable")], 0
            while len(ranked) and n < share:
                tried, ranked = ranked[:LIKELY], ranked[LIKELY:]
                pool.append(tried[~_apart(self.paths, q[tried], there)])
                n += len(pool[-1])
        some = np.setdiff1d(np.concatenate(pool), gone)
        if (np.bincount(problem.group[some], minlength=len(problem.shares)) < problem.shares).any():
            # It is said once all have gone.
            some = np.setdiff1d(np.arange(problem.n_candidates), gone)
        part = problem.restricted(some)
        return {"chosen": some[exchange(part, fitted(part, np.searchsorted(some, kept)))[0]]}


class _Paths:
    """The cell's moves, each checked once however often a plan changes around it."""

    def __init__(self, feasibility: Feasibility) -> None:
        self.feasibility = feasibility
        self.known: dict[tuple[object, ...], bool] = {}

    def paths_free(self, q_from: Array, q_to: Array, loaded: bool) -> BoolArray:
        ends = zip(q_from, q_to, strict=True)
        keys = [(*sorted((a.tobytes(), b.tobytes())), loaded) for a, b in ends]
        new = list({key: k for k, key in enumerate(keys) if key not in self.known}.values())
        if new:
            free = self.feasibility.paths_free(q_from[new], q_to[new], loaded)
            self.known.update((keys[k], bool(f)) for k, f in zip(new, free, strict=True))
        return np.array([self.known[key] for key in keys], dtype=bool)


def _execution(
    setup: Setup, plan: Selection, paths: _Paths, seed: int, progress: Progress
) -> Execution:
    feasibility, pool, chosen = paths.feasibility, plan.pool, plan.chosen
    cell = feasibility.cell
    return schedule(
        pool.q[chosen], at_stops(cell), paths,
        loads=setup.information.forces,
        read=pool.readings[chosen] > 0,
        limits=joint_limits(cell, feasibility.chain),
        via=pool.q[:: max(len(pool) // VIA, 1)],
        blockers=blockers_of(feasibility),
        alias=plan.alias,
        paired=cell.model.observe == "deflection",
        seed=seed, progress=progress,
    )  # fmt: skip


def _apart(paths: _Paths, q: Array, there: Array) -> BoolArray:
    """(N,): no free move joins the posture q (N, n) to one of the TRIED next to it of those that
    are `there` (k, n)."""
    loaded = bool(np.any(paths.feasibility.cell.design.loads))
    next_to = np.argsort(np.abs(q[:, None] - there).max(axis=2), axis=1)
    alone = np.arange(len(q))
    for k in range(min(TRIED, len(there))):
        alone = alone[~paths.paths_free(q[alone], there[next_to[alone, k]], loaded)]
    return np.isin(np.arange(len(q)), alone)


def _nearer(feasibility: Feasibility, q: Array) -> Array:
    """Postures q (N, n) whole turns nearer to home, or to the middle of the joint ranges."""
    chain = feasibility.chain
    lower, upper = finite_ranges(chain, *joint_limits(feasibility.cell, chain))
    home = feasibility.cell.design.motion.home
    middle = (lower + upper) / 2 if home is None else home
    turning = np.array([kind == "revolute" for kind in chain.kinds])
    near = q - np.where(turning, 2 * np.pi * np.round((q - middle) / (2 * np.pi)), 0.0)
    return np.where((near >= lower) & (near <= upper), near, q)


def _unwound(setup: Setup, plan: Selection, feasibility: Feasibility) -> Selection:
    """The same postures, whole turns nearer to home, or to the middle of the joint ranges.

    Between an arm's posture and the same a turn on, there is often no way: the floor, or the arm
    itself.  Poses whose information would be another, and those that stay, are left as they are.
    """
    pool = plan.pool
    own = plan.chosen[plan.chosen < len(pool) - plan.pinned]
    was = pool.q[own]
    near = _nearer(feasibility, was)
    blocks, before = setup.information.blocks(near, pool.readings[own]), pool.blocks[own]
    off = np.abs(blocks - before).max(axis=(1, 2)) > SAME * np.abs(before).max()
    q = pool.q.copy()
    q[own] = np.where(off[:, None], was, near)
    return replace(plan, pool=replace(pool, q=q))


def _warnings(lost: int, execution: Execution) -> list[str]:
    warnings = []
    if lost:
        warnings.append(f"{lost} better poses were left out, as no free move reaches them")
    if execution.one_sided:
        told = ", ".join(str(k + 1) for k in execution.one_sided)
        warnings.append(f"approached from one side only, as the other is blocked: {told}")
    return warnings
