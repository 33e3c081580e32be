"""The search for a plan: relaxation, few starts, all poses polished at once, the bound.

What a polish or an ascent finds joins the pool, on which the relaxation runs again: so the bound
on the pool is one on what was found between its candidates too.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

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
from elastocal.planning.moves import Unreachable, blockers_of
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
# Of Φ: what starts differ by less is where IPOPT stops, and mirrored poses tell apart by rounding.
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
        were, of, read = pool.q[chosen], pool.group[chosen], pool.readings[chosen]

        def make() -> State:
            return {"q": polish(self.problem(pool), self.searches, self.T, were, of, read, fine)}

        q = self.checkpoint.finished(name, make)["q"]
        moved = (q != were).any(axis=1)
        if not moved.any():
            return pool, chosen
        now = chosen.copy()
        now[moved] = len(pool) + np.arange(moved.sum())
        return pool.joined(self.setup.pool(q[moved], of[moved], read[moved])), now

    def _better(self, pool: FeasiblePool, best: IntArray, other: IntArray) -> IntArray:
        return other if self.value(pool, other) < self.value(pool, best) * (1 - SAME) else best

    def _again(self, pool: FeasiblePool, relaxed: Relaxed, gap: float = CLOSE) -> Relaxed:
        """The relaxation on a pool that has grown since."""
        start = np.concatenate([relaxed.weights, np.zeros(len(pool) - len(relaxed.weights))])
        return prospects(self.problem(pool), gap, start)

    def _continuum(self, pool: FeasiblePool, relaxed: Relaxed, seed: int) -> Continuum:
        return estimate(
            self.problem(pool), relaxed.tangent, self.searches, self.T, pool.q, pool.readings,
            ways=self.setup.ways, seed=self.seed + seed, progress=self.progress,
        )  # fmt: skip

    def _widened(
        self, pool: FeasiblePool, relaxed: Relaxed, k: int, found: list[Continuum]
    ) -> FeasiblePool:
        """The pool with the poses of the continuum that the relaxed optimum lacks."""
        state = self.checkpoint.finished(
            f"continuum{k}", lambda: asdict(self._continuum(pool, relaxed, k))
        )
        at = state["q"], state["group"], state["readings"]
        counts = (int(state[name]) for name in ("searched", "ascents"))
        found.append(Continuum(float(state["bound"]), *at, *counts))
        return pool.joined(self.setup.pool(*at)) if len(at[0]) else pool

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
            if new.bound >= NEAR * relaxed.bound or not len(new.q):
                break
            pool = pool.joined(self.setup.pool(new.q, new.group, new.readings))
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
    warnings = []
    if order.gone:
        warnings.append(f"{order.gone} better poses were left out, as no free move reaches them")
    if execution.one_sided:
        told = ", ".join(str(k + 1) for k in execution.one_sided)
        warnings.append(f"approached from one side only, as the other is blocked: {told}")
    return plan, execution, warnings


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
        rules = self.paths.feasibility
        execution = schedule(
            q, at_stops(rules.cell), self.paths,
            loads=setup.information.forces,
            read=readings > 0,
            limits=joint_limits(rules.cell, rules.chain),
            via=plan.pool.q[:: max(len(plan.pool) // VIA, 1)],
            blockers=blockers_of(rules),
            alias=alias,
            paired=rules.cell.model.observe == "deflection",
            seed=search.seed, progress=search.progress,
        )  # fmt: skip
        return plan, execution

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
            some = np.setdiff1d(np.arange(len(problem.blocks)), gone)
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
    off = np.abs(blocks - before).max(axis=(1, 2)) > ROUNDING * np.abs(before).max()
    q = pool.q.copy()
    q[own] = np.where(off[:, None], was, near)
    return replace(plan, pool=replace(pool, q=q))
