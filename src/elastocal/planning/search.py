"""The search for a plan: relaxation, few starts, all poses polished at once, the bound.

What a polish or an ascent finds joins the pool, on which the relaxation runs again: so the bound
on the pool is one on what was found between its candidates too.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from elastocal.model.chain import finite_ranges, joint_limits
from elastocal.planning.checkpoint import Checkpoint, State
from elastocal.planning.criteria import inverse
from elastocal.planning.exchange import (
    PATIENCE,
    check_determined,
    exact_plan,
    exchange,
    fitted,
    prospects,
    random_plan,
    rounded,
)
from elastocal.planning.execution import Alias, Execution, at_stops, schedule
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.moves import Roadmap, Unreachable, blockers_of, travel_times
from elastocal.planning.plan import Certificate
from elastocal.planning.polish import Continuum, Searches, estimate, polish
from elastocal.planning.relaxation import (
    RIDGE,
    DesignProblem,
    Relaxed,
    balancing,
    check_enough,
    efficiency,
    in_terms,
)
from elastocal.planning.setup import FeasiblePool, Setup
from elastocal.units import Array, BoolArray, IntArray, Progress

POOL = 2000  # candidates where nobody asks for a number
CLOSE, FINE = 1e-3, 1e-4  # gap of the relaxations that lead to the next one, and of the last
# Of Φ: by less do starts differ that end alike, and mirrored poses, which rounding tells apart.
SAME = 1e-4
NEAR = 0.97  # of the bound on the pool: a continuum as near as that is not searched again
REFINED = 3  # times at most
ROUND = 1000  # added to the seed of each of them, beyond the rounds that belong to the effort


@dataclass(frozen=True)
class SearchEffort:
    """`starts` of the search, each polished, and `rounds` in which the continuum is searched for
    poses that the pool lacks.  Without starts the plan is one of the pool's candidates, the best of
    so many `exchanges`."""

    starts: int
    rounds: int
    exchanges: int = 1

    @property
    def in_pool(self) -> SearchEffort:
        return SearchEffort(0, 0, max(self.starts, 1))


EFFORTS = {
    "batch": SearchEffort(starts=0, rounds=0, exchanges=2),
    "quick": SearchEffort(starts=5, rounds=0),
    "normal": SearchEffort(starts=8, rounds=2),
    "thorough": SearchEffort(starts=40, rounds=4),
}


@dataclass(frozen=True)
class Selection:
    """The plan as indices `chosen` (k,) into the `pool`, which has grown; Φ `value`.

    From index `first` on the pool holds what came from polish and the continuum, at its end, once
    the plan is `whole`, the `pinned` poses that stay.  `alias`: what a shift of its readings does,
    once it is in order.
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

    def exchanged(self, pool: FeasiblePool, chosen: IntArray, value: float) -> Selection:
        """Another plan (k,) of Φ = `value`, from another pool that may hold more poses.

        The bounds hold: those of a pool are those of every part of it, and a plan's own poses,
        where they are new, are among those that the continuum's bound is about.
        """
        c = self.certificate
        of_pool, of_continuum = (
            None if share is None else min(share * (self.value / value), 1.0)
            for share in (c.efficiency_pool, c.efficiency_continuum)
        )
        certificate = replace(c, efficiency_pool=of_pool, efficiency_continuum=of_continuum)
        return replace(self, pool=pool, chosen=chosen, value=value, certificate=certificate)


class Search:
    """What a plan is sought with: the setup, whose parameters y = T z are balanced.

    `plain`: the setup without the poses that stay, where there are some.  Raises
    InsufficientDataError where no plan can determine all parameters.
    """

    def __init__(
        self, setup: Setup, pool: FeasiblePool, searches: Searches, shares: IntArray,
        effort: SearchEffort, seed: int, checkpoint: Checkpoint, progress: Progress, plain: Setup,
    ) -> None:  # fmt: skip
        self.setup, self.searches, self.shares, self.plain = setup, searches, shares, plain
        self.effort, self.seed = effort, seed
        self.checkpoint, self.progress = checkpoint, progress
        whole = setup.problem(pool, shares)
        check_enough(whole)
        self.T = balancing(whole)
        self._last: tuple[FeasiblePool, DesignProblem] | None = None

    def problem(self, pool: FeasiblePool) -> DesignProblem:
        if self._last is None or self._last[0] is not pool:
            self._last = pool, in_terms(self.setup.problem(pool, self.shares), self.T, RIDGE)
        return self._last[1]

    def value(self, pool: FeasiblePool, chosen: IntArray) -> float:
        return self.setup.problem(pool, self.shares).value(chosen)

    def select(self, pool: FeasiblePool) -> Selection:
        """The best plan found and its certificate."""
        first, efforts = len(pool), self.effort
        self.progress(f"relaxation over {len(pool)} candidates")
        relaxed = prospects(self.problem(pool), CLOSE if efforts.starts else FINE)
        begins = self._begins(pool, relaxed)
        best, least, ends = begins[0], np.inf, list[float]()
        for k, chosen in enumerate(begins[: efforts.starts]):
            pool, end = self.polished(pool, chosen, f"start{k}")
            ends.append(self.value(pool, end))
            self.progress(f"start {k + 1} of {efforts.starts}: {min(ends):.6g}")
            if ends[-1] < least * (1 - SAME):
                best, least = end, ends[-1]
        continuum: list[Continuum] = []
        for k in range(efforts.rounds):
            relaxed = self._again(pool, relaxed)
            if self.problem(pool).criterion.certifiable:
                pool = self._widened(pool, relaxed, k + 1, continuum)
            pool, best = self._bettered(pool, best, relaxed, k)
        if efforts.starts:
            relaxed = self._again(pool, relaxed, CLOSE if efforts.rounds else FINE)
            mixed, _ = exact_plan(self.problem(pool), relaxed, warm=best, starts=2, seed=self.seed)
            best = self._better(pool, best, mixed)
        if efforts.rounds:
            pool, best = self.polished(pool, best, "last", fine=True)
        value = self.value(pool, best)
        check_determined(self.setup.problem(pool, self.shares), value)
        certificate = self._certificate(pool, relaxed, value, continuum)
        certificate = replace(certificate, starts=tuple(ends))
        return Selection(pool, best, value, certificate, first)

    def _begins(self, pool: FeasiblePool, relaxed: Relaxed) -> list[IntArray]:
        """Plans to polish: that of exchange, then roundings and random plans in turn."""
        problem, rng = self.problem(pool), np.random.default_rng(self.seed)

        def make() -> State:
            # Where plans are polished, other starts better them more than a longer search here.
            patience = 0 if self.effort.starts else PATIENCE
            found = exact_plan(
                problem, relaxed, starts=self.effort.exchanges, seed=self.seed, patience=patience
            )
            return {"chosen": found[0]}

        found = [self.checkpoint.finished("exchange", make)["chosen"]]
        for k in range(1, self.effort.starts):
            new = random_plan(problem, rng) if k % 2 else rounded(problem, relaxed.weights, rng)
            found.append(new)
        return found

    def polished(
        self, pool: FeasiblePool, chosen: IntArray, name: str, fine: bool = False
    ) -> tuple[FeasiblePool, IntArray]:
        plan = pool.take(chosen)

        def make() -> State:
            return {"q": polish(self.problem(pool), self.searches, self.T, plan, fine)}

        q = self.checkpoint.finished(name, make)["q"]
        moved = (q != plan.q).any(axis=1)
        if not moved.any():
            return pool, chosen
        now = chosen.copy()
        now[moved] = len(pool) + np.arange(moved.sum())
        more = self.setup.pool(q[moved], plan.group[moved], plan.readings[moved])
        return pool.joined(more), now

    def _better(self, pool: FeasiblePool, best: IntArray, other: IntArray) -> IntArray:
        return other if self.value(pool, other) < self.value(pool, best) * (1 - SAME) else best

    def _again(self, pool: FeasiblePool, relaxed: Relaxed, gap: float = CLOSE) -> Relaxed:
        """The relaxation on a pool that has grown since."""
        start = np.concatenate([relaxed.weights, np.zeros(len(pool) - len(relaxed.weights))])
        return prospects(self.problem(pool), gap, start)

    def _continuum(self, pool: FeasiblePool, relaxed: Relaxed, seed: int) -> Continuum:
        return estimate(
            self.problem(pool), relaxed.tangent, self.searches, self.T, pool, self.seed + seed,
            self.progress,
        )  # fmt: skip

    def _widened(
        self, pool: FeasiblePool, relaxed: Relaxed, k: int, found: list[Continuum]
    ) -> FeasiblePool:
        """The pool with the poses of the continuum that the relaxed optimum lacks."""

        def make() -> State:
            c = self._continuum(pool, relaxed, k)
            at = {name: getattr(c.found, name) for name in ("q", "group", "readings")}
            return at | {"figures": [c.bound, c.searched, c.ascents]}

        state = self.checkpoint.finished(f"continuum{k}", make)
        bound, searched, ascents = state["figures"]
        more = self.setup.pool(state["q"], state["group"], state["readings"])
        found.append(Continuum(float(bound), more, int(searched), int(ascents)))
        return pool.joined(more)

    def _bettered(
        self, pool: FeasiblePool, best: IntArray, relaxed: Relaxed, k: int
    ) -> tuple[FeasiblePool, IntArray]:
        """The pool and the better of the plan and those exchanged on the grown pool and polished:
        one begun from the plan, one from the relaxation."""
        problem, relaxed = self.problem(pool), self._again(pool, relaxed)
        plans = [exact_plan(problem, relaxed, warm=w, patience=0)[0] for w in (best, None)]
        for name, chosen in zip((f"warm{k}", f"anew{k}"), plans, strict=True):
            pool, chosen = self.polished(pool, chosen, name)
            best = self._better(pool, best, chosen)
        return pool, best

    def _certificate(
        self, pool: FeasiblePool, relaxed: Relaxed, value: float, found: list[Continuum]
    ) -> Certificate:
        problem = self.problem(pool)
        if not problem.criterion.certifiable:
            return Certificate(len(pool), None, None)
        if len(relaxed.weights) < len(pool):
            relaxed = self._again(pool, relaxed, FINE)
        bound, size = relaxed.bound, len(pool)
        if not self.effort.starts:
            return Certificate(size, bound, efficiency(value, bound))
        # The tangent of the pool's optimum says little of poses far better than the pool's: they
        # join it, and that of the new optimum says more.
        found = [*found, self._continuum(pool, relaxed, ROUND)]
        for k in range(REFINED):
            new = found[-1]
            if new.bound >= NEAR * relaxed.bound or not len(new.found):
                break
            pool = pool.joined(new.found)
            relaxed = self._again(pool, relaxed)
            found.append(self._continuum(pool, relaxed, (k + 2) * ROUND))
        beyond = min(found[-1].bound, bound)
        return Certificate(
            pool=size,
            bound_pool=bound,
            efficiency_pool=efficiency(value, bound),
            bound_continuum=beyond,
            efficiency_continuum=efficiency(value, beyond),
            searched=sum(c.searched for c in found),
            ascents=sum(c.ascents for c in found),
        )


# The order of a plan that moves can follow; poses that none reaches are replaced, and polished.

ROUNDING = 1e-9  # of the largest number of the blocks: rounding
TRIED = 6  # poses of the hub one of which a pose put into a plan must be able to reach
LIKELY = 400  # candidates that gain most, of which that is found out
VIA = 200  # candidates through which a blocked move may go
REPLACED = 10  # times at most


def ordered(
    search: Search, found: Selection, pinned: FeasiblePool | None = None
) -> tuple[Selection, Execution, list[str]]:
    """The selection in the order of its levels, its execution, and warnings.

    Poses that no chain of free moves reaches are replaced by the best others, unless they are
    `pinned`, and all poses then polished again, as far as moves reach them there.  Raises
    InsufficientDataError where that does not end.
    """
    order, warnings = _Ordering(search, found, pinned), []
    plan, execution = order.reachable()
    if order.gone:
        plan, execution = order.polished(plan, execution)
        warnings.append(f"{order.gone} better poses were left out, as no free move reaches them")
    if execution.one_sided:
        told = ", ".join(str(k + 1) for k in execution.one_sided)
        warnings.append(f"approached from one side only, as the other is blocked: {told}")
    return plan, execution, warnings


class _Ordering:
    """A plan `found` put in order; `gone` poses of it were unreachable so far.

    The `hub` (k, n): home, and poses of the pool, which free moves join; blocked moves may go
    through them.
    """

    def __init__(self, search: Search, found: Selection, pinned: FeasiblePool | None) -> None:
        self.search, self.found, self.pinned, self.gone = search, found, pinned, 0
        self.paths = _Paths(search.searches.checker)
        self.hub = found.pool.q[:: max(len(found.pool) // VIA, 1)]

    def reachable(self) -> tuple[Selection, Execution]:
        """The plan, or that with others in the place of unreachable poses, in an order."""
        for k in range(REPLACED):
            try:
                return self.put(self.found)
            except Unreachable as error:
                if k == 0:
                    self.found = self._unwound()
                else:
                    self._replace(error)
        return self.put(self.found)

    def put(self, found: Selection) -> tuple[Selection, Execution]:
        search, plan = self.search, found.whole(self.pinned)
        setup, plain = search.setup, search.plain
        q, blocks = plan.pool.q[plan.chosen], plan.pool.blocks[plan.chosen]
        readings = plan.pool.readings[plan.chosen]
        M = plain.gathered(blocks)
        alias = Alias.of(plain.information, q, blocks, M, plain.target_rows, readings)
        rules = self.paths.feasibility
        execution = schedule(
            q, at_stops(rules.cell), self.paths,
            loads=setup.information.forces,
            read=readings > 0,
            limits=joint_limits(rules.cell, rules.chain),
            via=self.hub,
            blockers=blockers_of(rules),
            alias=alias,
            paired=rules.cell.model.observe == "deflection",
            seed=search.seed, progress=search.progress,
        )  # fmt: skip
        return replace(plan, alias=alias), execution

    def polished(self, plan: Selection, execution: Execution) -> tuple[Selection, Execution]:
        found, search = self.found, self.search
        if not search.effort.starts:
            return plan, execution
        pool, chosen = search.polished(found.pool, found.chosen, "replaced")
        value = search.value(pool, chosen)
        with suppress(Unreachable):
            if value < found.value:
                return self.put(found.exchanged(pool, chosen, value))
        return plan, execution

    def _unwound(self) -> Selection:
        """The same postures, whole turns nearer to home, or to the middle of the joint ranges.

        Between an arm's posture and the same a turn on, there is often no way: the floor, or the
        arm itself.  Poses whose information would be another are left as they are.
        """
        rules, pool = self.paths.feasibility, self.found.pool
        chain, home = rules.chain, rules.cell.design.motion.home
        lower, upper = finite_ranges(chain, *joint_limits(rules.cell, chain))
        turn = np.where([kind == "revolute" for kind in chain.kinds], 2 * np.pi, np.inf)
        q = pool.q - np.nan_to_num(
            turn * np.round((pool.q - ((lower + upper) / 2 if home is None else home)) / turn)
        )
        q = np.where((q >= lower) & (q <= upper), q, pool.q)
        off = np.abs(self.search.setup.information.blocks(q, pool.readings) - pool.blocks)
        same = off.max(axis=(1, 2)) <= ROUNDING * np.abs(pool.blocks).max()
        pool = replace(pool, q=np.where(same[:, None], q, pool.q))
        self.hub = pool.q[:: max(len(pool) // VIA, 1)]
        return replace(self.found, pool=pool)

    def _replace(self, error: Unreachable) -> None:
        """In the place of the poses that cannot be reached, and by exchange in that of others, come
        those of the LIKELY candidates of a level that a free move joins to the hub."""
        search, found, pool = self.search, self.found, self.found.pool
        problem, gone = search.problem(pool), found.whole(self.pinned).chosen[error.poses]
        if (gone >= len(pool)).any():
            raise error
        self.gone += len(gone)
        search.progress(f"{self.gone} poses that no free move reaches are replaced by others")
        kept = np.setdiff1d(found.chosen, gone)
        self.hub = self._joined(np.vstack([self.hub, pool.q[kept]]))
        V = inverse(problem.information(found.chosen))
        worth = problem.prices(V @ problem.criterion.slope(V)[1] @ V)
        some = [kept]
        for level, share in enumerate(problem.shares):
            own = np.setdiff1d(np.flatnonzero(problem.group == level), found.chosen)
            ranked, n = own[np.argsort(-worth[own], kind="stable")], 0
            while len(ranked) and n < share:
                tried, ranked = ranked[:LIKELY], ranked[LIKELY:]
                some.append(tried[self._reached(pool.q[tried])])
                n += len(some[-1])
        left = np.sort(np.concatenate(some))
        if (np.bincount(problem.group[left], minlength=len(problem.shares)) < problem.shares).any():
            raise error
        part = problem.restricted(left)
        begun = fitted(part, np.searchsorted(left, kept))
        chosen = left[exchange(part, begun)[0]]
        self.found = found.exchanged(pool, chosen, search.value(pool, chosen))

    @property
    def _loaded(self) -> bool:
        return bool(np.any(self.paths.feasibility.cell.design.loads))

    def _joined(self, q: Array) -> Array:
        """Those of q (N, n) that free moves join, with home where there is one."""
        motion = self.paths.feasibility.cell.design.motion
        points = q if motion.home is None else np.vstack([motion.home, q])
        roadmap = Roadmap(points, travel_times(points, motion.speed), self._loaded, self.paths)
        parts = roadmap.parts(list(range(len(points))))
        return points[parts[0] if motion.home is None else next(p for p in parts if 0 in p)]

    def _reached(self, q: Array) -> BoolArray:
        """(N,): a free move joins the posture q (N, n) to one of the TRIED next to it of the
        hub."""
        next_to = np.argsort(np.abs(q[:, None] - self.hub).max(axis=2), axis=1)
        alone = np.arange(len(q))
        for k in range(min(TRIED, len(self.hub))):
            there = self.hub[next_to[alone, k]]
            alone = alone[~self.paths.paths_free(q[alone], there, self._loaded)]
        return ~np.isin(np.arange(len(q)), alone)


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
