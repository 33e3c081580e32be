"""A plan as it was selected, in an order that moves can follow; poses that no move reaches."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from elastocal.model.chain import finite_ranges, joint_limits
from elastocal.planning.checkpoint import Checkpoint, Stage
from elastocal.planning.drift import Alias
from elastocal.planning.exact_plan import repaired
from elastocal.planning.execution import Execution, schedule
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.moves import Blockers, Unreachable
from elastocal.planning.plan import Certificate
from elastocal.planning.setup import FeasiblePool, Setup
from elastocal.planning.time_budget import at_stops
from elastocal.units import Array, IntArray, Progress


@dataclass(frozen=True)
class Selection:
    """The plan as indices `chosen` (k,) into the `pool`, which has grown; Φ `value`.

    From index `first` on the pool holds what came from local searches and the continuum, at its
    end, once the plan is `whole`, the `pinned` poses that stay.
    """

    pool: FeasiblePool
    chosen: IntArray
    value: float
    certificate: Certificate
    first: int
    pinned: int = 0

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

    def without(self, lost: IntArray, setup: Setup, shares: IntArray, stage: Stage) -> Selection:
        """The best plan found without the candidates `lost`, from what is left of this one; what
        `stage` has finished is taken from there.

        The bounds hold: those of a pool are those of every part of it.
        """
        kept = np.setdiff1d(np.arange(len(self.pool)), lost)
        pool = self.pool.take(kept)
        left = np.searchsorted(kept, np.setdiff1d(self.chosen, lost))
        problem = setup.problem(pool, shares)
        state = stage.finished(lambda: {"chosen": repaired(problem, left)})
        chosen = state["chosen"]
        value = float(setup.criterion.value(setup.gathered(pool.blocks[:, chosen])))
        c = self.certificate
        of_pool, of_continuum = (
            None if share is None else share * (self.value / value)
            for share in (c.efficiency_pool, c.efficiency_continuum)
        )
        certificate = replace(
            c, pool=len(pool), efficiency_pool=of_pool, efficiency_continuum=of_continuum
        )
        first = self.first - int((lost < self.first).sum())
        return Selection(pool, chosen, value, certificate, first)


# The order of execution of a selection, and what becomes of poses that no move reaches.

SAME = 1e-9  # of the largest number of the blocks: rounding
MOST_REPLACED = 50  # poses that cannot be reached, before that is said instead
TRIED = 6  # poses of a plan that a candidate must be able to reach one of
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
    lost, unwound, apart = 0, False, False
    while True:
        plan = found.whole(pinned)
        if unwound:
            plan = _unwound(setup, plan, feasibility)
        chosen = plan.chosen
        try:
            execution = _execution(setup, plan.pool, chosen, feasibility, seed, progress)
        except Unreachable as error:
            if not unwound:
                unwound = True
                continue
            own = len(found.pool)
            if lost >= MOST_REPLACED or (chosen[error.poses] >= own).any():
                raise
            lost += len(error.poses)
            progress(f"{lost} poses that no free move reaches are replaced by the best others")
            stage = (checkpoint or Checkpoint()).stage(f"replaced{lost}")
            gone = np.unique(chosen[error.poses])
            if not apart:
                apart = True
                gone = np.union1d(gone, _apart(plan, own, gone, shares, feasibility))
            found = found.without(gone, setup.having(pinned), shares, stage)
            continue
        return plan, execution, _warnings(lost, execution)


def _execution(
    setup: Setup,
    pool: FeasiblePool,
    chosen: IntArray,
    feasibility: Feasibility,
    seed: int,
    progress: Progress,
) -> Execution:
    cell, states = feasibility.cell, setup.information.states
    return schedule(
        pool.q[chosen], at_stops(cell), feasibility,
        loads=states.forces,
        load=pool.load[chosen] if states.chosen else None,
        limits=joint_limits(cell, feasibility.chain),
        via=pool.q[:: max(len(pool) // VIA, 1)],
        blockers=Blockers(feasibility),
        alias=Alias.of(setup, pool, chosen),
        paired=not states.observed.all(),
        seed=seed, progress=progress,
    )  # fmt: skip


def _apart(
    plan: Selection, own: int, gone: IntArray, shares: IntArray, feasibility: Feasibility
) -> IntArray:
    """Candidates among the first `own` of the pool that no free move joins to one of the TRIED
    poses of the plan next to them, those `gone` aside: not to be put in their place.

    None where too few would be left to choose from.
    """
    pool, kept = plan.pool, np.setdiff1d(plan.chosen, gone)
    q = _nearer(feasibility, pool.q)
    open_ = np.setdiff1d(np.arange(own), plan.chosen)
    off = np.abs(q[open_, None] - pool.q[kept]).max(axis=2)
    next_to = np.argsort(off, axis=1)[:, :TRIED]
    loaded = bool(np.any(feasibility.cell.design.loads))
    alone = np.arange(len(open_))
    for k in range(next_to.shape[1]):
        goals = pool.q[kept[next_to[alone, k]]]
        alone = alone[~feasibility.paths_free(q[open_[alone]], goals, loaded)]
    left = np.setdiff1d(np.arange(own), np.append(open_[alone], gone))
    enough = np.bincount(pool.group[left], minlength=len(shares)) >= 2 * shares
    return open_[alone] if enough.all() else open_[:0]


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
