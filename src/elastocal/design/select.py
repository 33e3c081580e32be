"""Choosing the poses: relaxation, exchange, polish, and new candidates from the continuum."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from elastocal.design.certificate import efficiency
from elastocal.design.checkpoint import Checkpoint
from elastocal.design.continuum import Continuum, estimate
from elastocal.design.options import EFFORTS, DesignOptions
from elastocal.design.plan import Certificate
from elastocal.design.setup import Pool, Setup
from elastocal.planning.exact_plan import exact_plan
from elastocal.planning.polish import Searches, polish
from elastocal.planning.relaxation import Relaxed, relax

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Selection:
    """The plan as indices `chosen` (k,) into the `pool`, which has grown; Φ `value`.

    From index `first` on the pool holds what came from local searches and the continuum.
    """

    pool: Pool
    chosen: IntArray
    value: float
    certificate: Certificate
    first: int

    @property
    def polished(self) -> int:
        """Poses of the plan that are not candidates of the first pool."""
        return int((self.chosen >= self.first).sum())

    def without(self, lost: IntArray, setup: Setup, shares: IntArray) -> Selection:
        """The best plan found without the candidates `lost`, from what is left of this one.

        The bounds hold: those of a pool are those of every part of it.
        """
        kept = np.setdiff1d(np.arange(len(self.pool)), lost)
        pool = self.pool.take(kept)
        left = np.searchsorted(kept, np.setdiff1d(self.chosen, lost))
        found = exact_plan(setup.problem(pool, shares), warm=left, starts=1)
        c = self.certificate
        worse = self.value / found.value
        certificate = replace(
            c,
            pool=len(pool),
            efficiency_pool=None if c.efficiency_pool is None else c.efficiency_pool * worse,
            efficiency_continuum=None
            if c.efficiency_continuum is None
            else c.efficiency_continuum * worse,
        )
        first = self.first - int((lost < self.first).sum())
        return Selection(pool, found.chosen, found.value, certificate, first)


def select(
    setup: Setup,
    pool: Pool,
    shares: IntArray,
    searches: Searches,
    options: DesignOptions,
    checkpoint: Checkpoint,
    progress: Progress,
    begun: IntArray | None = None,
) -> Selection:
    """The best plan found and its certificates, never worse than the plan `begun`, if given.

    In each round the exact plan is polished off the pool and the continuum is searched for poses
    of larger sensitivity; both join the pool, on which relaxation and exchange run again.  So the
    plan is never worse than that of the first pool, and the bound on the pool is that of the
    grown one.
    """
    first = len(pool)
    search = _Rounds(setup, searches, shares, options, checkpoint, progress)
    relaxed = search.relax(pool)
    chosen = search.exchange(pool, relaxed, begun, 0)
    effort = EFFORTS[options.effort]
    for k in range(1, effort.rounds + 1):
        grown, chosen = search.polish(pool, chosen, k)
        pool = search.widen(grown, relaxed, k)
        relaxed = search.relax(pool)
        chosen = search.exchange(pool, relaxed, chosen, k)
    value = float(setup.criterion.value(setup.gathered(pool.blocks[:, chosen])))
    certificate = search.certificate(pool, relaxed, value)
    return Selection(pool, chosen, value, certificate, first)


@dataclass(frozen=True)
class _Rounds:
    """One step of a round each; what is finished is taken from the checkpoint."""

    setup: Setup
    searches: Searches
    shares: IntArray
    options: DesignOptions
    checkpoint: Checkpoint
    progress: Progress

    def relax(self, pool: Pool) -> Relaxed | None:
        """The relaxed optimum on the pool; None for a criterion without a bound."""
        if not self.setup.criterion.certifiable:
            return None
        self.progress(f"relaxation over {len(pool)} candidates")
        return relax(self.setup.problem(pool, self.shares), progress=self.progress)

    def exchange(
        self, pool: Pool, relaxed: Relaxed | None, warm: IntArray | None, k: int
    ) -> IntArray:
        found = exact_plan(
            self.setup.problem(pool, self.shares),
            relaxed_weights=None if relaxed is None else relaxed.weights,
            tangent=None if relaxed is None else relaxed.tangent,
            warm=warm,
            starts=EFFORTS[self.options.effort].starts,
            seed=self.options.seed,
            jobs=self.options.jobs,
            checkpoint=self.checkpoint.stage(f"exchange{k}"),
            progress=self.progress,
        )
        return found.chosen

    def polish(self, pool: Pool, chosen: IntArray, k: int) -> tuple[Pool, IntArray]:
        """The pool with the polished poses, and the polished plan in it."""
        stage = self.checkpoint.stage(f"polish{k}")
        state = stage.load()
        if state is None:
            problem = self.setup.problem(pool, self.shares)
            done = polish(
                problem, self.searches, pool.q, pool.load, chosen,
                jobs=self.options.jobs, progress=self.progress,
            )  # fmt: skip
            state = {"q": done.q, "moved": done.moved}
            stage.save(state)
        q, moved = state["q"], state["moved"]
        if not moved.any():
            return pool, chosen
        fresh = chosen[moved]
        grown = pool.joined(self.setup.pool(q[moved], pool.load[fresh], pool.group[fresh]))
        now = chosen.copy()
        now[moved] = np.arange(len(pool), len(grown))
        return grown, now

    def widen(self, pool: Pool, relaxed: Relaxed | None, k: int) -> Pool:
        """The pool with the poses of the continuum that the relaxed optimum lacks."""
        if relaxed is None:
            return pool
        stage = self.checkpoint.stage(f"continuum{k}")
        state = stage.load()
        if state is None:
            found = self._continuum(pool, relaxed, k)
            state = {"q": found.q, "load": found.load, "group": found.group}
            stage.save(state)
        if not len(state["q"]):
            return pool
        return pool.joined(self.setup.pool(state["q"], state["load"], state["group"]))

    def _continuum(self, pool: Pool, relaxed: Relaxed, k: int) -> Continuum:
        effort = EFFORTS[self.options.effort]
        # The pool may have grown since: candidates added later have weight 0.
        problem = self.setup.problem(pool, self.shares)
        return estimate(
            problem, relaxed.tangent, self.searches, pool.q, pool.load,
            points=effort.points, starts=effort.ascents, seed=self.options.seed + k,
            jobs=self.options.jobs, progress=self.progress,
        )  # fmt: skip

    def certificate(self, pool: Pool, relaxed: Relaxed | None, value: float) -> Certificate:
        if relaxed is None:
            return Certificate(len(pool), None, None)
        found = self._continuum(pool, relaxed, 0)
        return Certificate(
            pool=len(pool),
            bound_pool=relaxed.bound,
            efficiency_pool=efficiency(value, relaxed.bound),
            bound_continuum=found.bound,
            efficiency_continuum=efficiency(value, min(found.bound, relaxed.bound)),
            searched=found.searched,
            ascents=found.ascents,
        )
