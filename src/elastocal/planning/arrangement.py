"""A plan as it was selected, in an order that moves can follow; poses that no move reaches."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from elastocal.model.chain import finite_ranges, joint_limits
from elastocal.planning.checkpoint import Checkpoint, State
from elastocal.planning.drift import Alias
from elastocal.planning.exact_plan import repaired, restrict
from elastocal.planning.execution import Execution, schedule
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.moves import Blockers, Unreachable
from elastocal.planning.plan import Certificate
from elastocal.planning.selection import DesignProblem
from elastocal.planning.setup import FeasiblePool, Setup
from elastocal.planning.time_budget import at_stops
from elastocal.units import Array, BoolArray, IntArray, Progress


@dataclass(frozen=True)
class Selection:
    """The plan as indices `chosen` (k,) into the `pool`, which has grown; Φ `value`.

    From index `first` on the pool holds what came from local searches and the continuum, at its
    end, once the plan is `whole`, the `pinned` poses that stay.  `alias`: what a shift of its
    readings does, once it is in order.
    """

    pool: FeasiblePool
    chosen: IntArray
    value: float
    certificate: Certificate
    first: int
    pinned: int = 0
    alias: Alias | None = None

    @property
    def polished(self) -> int:
        """Poses of the plan that are not candidates of the first pool."""
        own = self.chosen < len(self.pool) - self.pinned
        return int((own & (self.chosen >= self.first)).sum())

    def whole(self, pinned: FeasiblePool | None) -> Selection:
        """With the poses that stay, in the order of the levels, so that the table reads like
        Table 2; of a level those that stay come first."""
        pool, chosen, n = self.pool, np.sort(self.chosen), 0
        if pinned is not None:
            pool, n = pool.joined(pinned), len(pinned)
            chosen = np.append(np.arange(len(self.pool), len(pool)), chosen)
        chosen = chosen[np.argsort(pool.group[chosen], kind="stable")]
        return replace(self, pool=pool, chosen=chosen, pinned=n)

    def without(self, gone: IntArray, chosen: IntArray, setup: Setup) -> Selection:
        """The plan `chosen` (k,) without the candidates `gone`, which leave the pool.

        The bounds hold: those of a pool are those of every part of it.
        """
        kept = np.setdiff1d(np.arange(len(self.pool)), gone)
        value = float(setup.criterion.value(setup.gathered(self.pool.blocks[:, chosen])))
        c = self.certificate
        of_pool, of_continuum = (
            None if share is None else share * (self.value / value)
            for share in (c.efficiency_pool, c.efficiency_continuum)
        )
        certificate = replace(
            c, pool=len(kept), efficiency_pool=of_pool, efficiency_continuum=of_continuum
        )
        first = self.first - int((gone < self.first).sum())
        own = np.searchsorted(kept, chosen)
        return Selection(self.pool.take(kept), own, value, certificate, first)


# The order of execution of a selection, and what becomes of poses that no move reaches.

SAME = 1e-9  # of the largest number of the blocks: rounding
MOST_REPLACED = 50  # poses that cannot be reached, before that is said instead
TRIED = 6  # poses of a plan one of which a pose put into it must be able to reach
LIKELY = 400  # candidates that gain most, of which that is found out
VIA = 200  # candidates through which a blocked move may go


def ordered(
    setup: Setup,
    found: Selection,
    shares: IntArray,
    feasibility: Feasibility,
    seed: int,
    progress: Progress,
    checkpoint: Checkpoint | None = None,
    pinned: FeasiblePool | None = None,
) -> tuple[Selection, Execution, list[str]]:
    """The selection in the order of its levels, its execution, and warnings.

    Poses that no chain of free moves reaches are replaced by the best others, unless they are
    `pinned`.  Raises InsufficientDataError where that does not end.
    """
    lost, unwound, paths = 0, False, _Paths(feasibility)
    while True:
        plan = found.whole(pinned)
        if unwound:
            plan = _unwound(setup, plan, feasibility)
        chosen = plan.chosen
        try:
            plan = replace(plan, alias=Alias.of(setup, plan.pool, chosen))
            execution = _execution(setup, plan, paths, seed, progress)
        except Unreachable as error:
            if not unwound:
                unwound = True
                continue
            gone = np.unique(chosen[error.poses])
            others = np.delete(found.pool.group, gone[gone < len(found.pool)])
            few = np.bincount(others, minlength=len(shares)) < shares
            if lost >= MOST_REPLACED or (gone >= len(found.pool)).any() or few.any():
                raise
            lost += len(error.poses)
            progress(f"{lost} poses that no free move reaches are replaced by the best others")
            stage = (checkpoint or Checkpoint()).stage(f"replaced{lost}")
            state = stage.finished(
                partial(
                    _replaced, setup.having(pinned).problem(found.pool, shares), found.chosen, gone,
                    _nearer(feasibility, found.pool.q), plan.pool.q[np.setdiff1d(chosen, gone)],
                    paths,
                )
            )  # fmt: skip
            found = found.without(gone, state["chosen"], setup.having(pinned))
            continue
        return plan, execution, _warnings(lost, execution)


class _Paths:
    """The cell's moves, each checked once however often a plan changes around it."""

    def __init__(self, feasibility: Feasibility) -> None:
        self.feasibility = feasibility
        self.known: dict[tuple[object, ...], bool] = {}

    def paths_free(self, q_from: Array, q_to: Array, loaded: bool) -> BoolArray:
        """As `Feasibility.paths_free`, of moves (M, n)."""
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
    cell, states = feasibility.cell, setup.information.states
    return schedule(
        pool.q[chosen], at_stops(cell), paths,
        loads=states.forces,
        load=pool.load[chosen] if states.chosen else None,
        limits=joint_limits(cell, feasibility.chain),
        via=pool.q[:: max(len(pool) // VIA, 1)],
        blockers=Blockers(feasibility),
        alias=plan.alias,
        paired=not states.observed.all(),
        seed=seed, progress=progress,
    )  # fmt: skip


def _replaced(
    problem: DesignProblem, were: IntArray, gone: IntArray, q: Array, there: Array, paths: _Paths
) -> State:
    """What is `chosen` instead of the plan `were` without the candidates `gone`.

    In their place, and by exchange in that of others, come those of the LIKELY candidates of a
    level that a free move joins, as postures q (N, n), to poses of the plan that are `there`.
    """
    kept, pool = np.setdiff1d(were, gone), [were]
    worth = problem.sensitivity(problem.criterion.gradient(problem.prior + problem.sum_of(were)).G)
    for level, share in enumerate(problem.shares):
        own = np.setdiff1d(np.flatnonzero(problem.group == level), were)
        ranked, found = own[np.argsort(-worth[own], kind="stable")], 0
        while len(ranked) and found < share:
            tried, ranked = ranked[:LIKELY], ranked[LIKELY:]
            pool.append(tried[~_apart(paths, q[tried], there)])
            found += len(pool[-1])
    some = np.setdiff1d(np.concatenate(pool), gone)
    if (np.bincount(problem.group[some], minlength=len(problem.shares)) < problem.shares).any():
        some = np.setdiff1d(np.arange(problem.n_candidates), gone)  # it is said once all have gone
    return {"chosen": some[repaired(restrict(problem, some), np.searchsorted(some, kept))]}


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
    blocks, before = setup.information.blocks(near, pool.load[own]), pool.blocks[:, own]
    off = np.abs(blocks - before).max(axis=(0, 2, 3)) > SAME * np.abs(before).max()
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
