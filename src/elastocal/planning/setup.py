"""What is settled before poses are chosen: parameters, criterion and earlier information, and what
can be chosen besides poses: places of markers, load point and tracker, which loads, and how many
poses and readings within a time.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq, minimize

from elastocal.cell import Cell
from elastocal.identification.start import fixed_and_free
from elastocal.measurements import STILL, Measurements
from elastocal.messages import InsufficientDataError, length, listed, require, rounded, wish
from elastocal.model.chain import joint_index
from elastocal.model.effects.base import Entry, LoadPointMotion, MarkerMotion
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.planning.criteria import (
    CRITERIA,
    CriterionInputs,
    ScenarioCriterion,
    criterion_named,
    root,
)
from elastocal.planning.execution import Execution, at_stops, nearest_first
from elastocal.planning.feasibility import Feasibility, travel_times
from elastocal.planning.information import (
    Estimable,
    Known,
    PoseInformation,
    Sight,
    estimable,
    evenly,
    marker_sigmas,
    plan_forces,
    whitened,
)
from elastocal.planning.plan import (
    LOAD_POINT,
    TRACKER,
    Chosen,
    Everywhere,
    LoadStates,
    Plan,
    Scheduled,
    TimedSize,
    predicted,
    remaining_rms,
)
from elastocal.planning.poses import Candidates, TargetPoses, draw, known_rows, shares_of, sobol
from elastocal.planning.relaxation import DesignProblem, Relaxed, exact_plan, relax
from elastocal.simulation import expand_plan, simulate
from elastocal.units import Array, BoolArray, IntArray, Progress

WORTH_TELLING = 1e-7  # m
SAMPLE = 2000  # poses that show what is visible: more would not change a rank


@dataclass(frozen=True)
class FeasiblePool:
    """Candidates q (N, n), their group (N,), how often each is read in each load state (N, L), and
    blocks (N, r, p)."""

    q: Array
    group: IntArray
    readings: IntArray
    blocks: Array

    def __len__(self) -> int:
        return len(self.q)

    def take(self, kept: IntArray | BoolArray) -> FeasiblePool:
        return FeasiblePool(self.q[kept], self.group[kept], self.readings[kept], self.blocks[kept])

    @classmethod
    def join(cls, lots: Sequence[FeasiblePool]) -> FeasiblePool:
        names = ("q", "group", "readings", "blocks")
        return cls(*(np.concatenate([getattr(lot, name) for lot in lots]) for name in names))


@dataclass(frozen=True)
class Setup:
    """`information` over the kept parameters, `prior` (p, p) scaled, and what the criterion is made
    of: `inputs` of the test poses alone, and `beyond`, ∂position/∂parameters (T, r, p) at poses all
    over the joint ranges and their weights (T,), on which `share` of the criterion's weight lies.
    `ways` (K, L): how a pose may be read, as readings in each load state; each candidate is one.
    `pinned`: poses that stay, which every problem knows before.  `held` (T, r, d): `Estimable`'s at
    the test poses."""

    information: PoseInformation
    found: Estimable
    inputs: CriterionInputs
    beyond: tuple[Array, Array] | None
    prior: Array
    warnings: tuple[str, ...]
    ways: IntArray
    share: float = 0.0
    pinned: FeasiblePool | None = None
    held: Array | None = None

    @cached_property
    def criterion(self) -> ScenarioCriterion:
        inputs = self.inputs
        if self.share and inputs.A is not None and self.beyond is not None:
            own, others = inputs.target_weights(), self.beyond[1]
            inputs = replace(
                inputs,
                A=np.concatenate([inputs.A, self.beyond[0]]),
                weights=np.concatenate([(1 - self.share) * own, self.share * others]),
            )
        return criterion_named(inputs.criterion).of(inputs)

    @cached_property
    def target_rows(self) -> Array | None:
        """R (r, p): |R x| is the rms error at the test poses in m, of a criterion that has some."""
        return None if self.inputs.A is None else root(self.inputs.A, self.inputs.target_weights())

    @cached_property
    def elsewhere_rows(self) -> Array | None:
        return None if self.beyond is None else root(*self.beyond)

    def everywhere(self, M: Array, random: Array, left: Array) -> Everywhere | None:
        """Of a plan's information M (p, p), random plans' (n, p, p), and what a drift leaves of the
        plan's (p, p); None where one of the errors is not known."""
        if self.target_rows is None or self.elsewhere_rows is None:
            return None
        of = self.target_rows, self.elsewhere_rows
        chance = [float(np.median([remaining_rms(R, m) for m in random])) for R in of]
        at, beyond = (value if np.isfinite(value) else None for value in chance)
        e = [remaining_rms(R, K) for K in (M, left) for R in of]
        cap = self.information.model.cell.design.cap
        return Everywhere(e[0], e[1], at, beyond, e[2], e[3], self.share, cap)

    def pool(self, q: Array, group: IntArray, readings: IntArray | None = None) -> FeasiblePool:
        """Candidates q (N, n) read as `readings` (N, L) say, or in each of the ways in turn."""
        if readings is None:
            readings = np.repeat(self.ways, len(q), axis=0)
            q, group = np.tile(q, (len(self.ways), 1)), np.tile(group, len(self.ways))
        return FeasiblePool(q, group, readings, self.information.blocks(q, readings))

    def problem(self, pool: FeasiblePool, shares: IntArray) -> DesignProblem:
        """Of as many stops as the `shares` (L,) of poses take in all load states."""
        shares = shares * self.ways.shape[1] // np.count_nonzero(self.ways[0])
        prior = self.prior if self.pinned is None else self.gathered(self.pinned.blocks)
        source = f"{self.information.model.cell.source}: "
        return DesignProblem(pool.blocks, prior, pool.group, shares, self.criterion, source)

    def gathered(self, blocks: Array) -> Array:
        """M (p, p), with what was known before."""
        B = blocks.reshape(-1, blocks.shape[-1])
        return np.asarray(self.prior + B.T @ B)


def set_up(
    model: Model, q: Array, n_poses: int, targets: TargetPoses, known: Known,
    region: TargetPoses | None = None, sight: Sight | None = None, work: Model | None = None,
    hold: bool = False,
) -> Setup:  # fmt: skip
    """The parameters that the candidates q (N, n) show, and the criterion on them.  `region`: poses
    all over the joint ranges, which count with the share `[design] elsewhere`.  `work`: the model
    at the test poses, where its tool is another one.  `hold`: parameters by which no plan can
    predict the test poses are held, not refused; so they are of distances, which never show where
    the arm stands as a whole."""
    spec, hold = model.cell.design, hold or model.observe == "distance"
    x = model.nominal if known.done is None else known.done.x
    free, every = fixed_and_free(model, known.fixed), np.arange(len(model.parameters))
    raw = PoseInformation(model, x, every, np.ones(len(every)), sight)
    held = [joint_index(name) for name in spec.levels]
    level = np.unique(q[:, held], axis=0, return_inverse=True)[1].ravel()
    some = q[evenly(level, -(-SAMPLE // (int(level.max()) + 1)))]
    table = raw.rows(some)
    sizes = model.sizes(model.regressor(table, x, None, observe(table, model.observe)).B)
    # Some poses, which weigh as much as those of the plan.
    B = raw.blocks(some).reshape(-1, len(sizes)) * sizes * np.sqrt(n_poses / len(some))
    found, prior = estimable(model, known, free, B, sizes)
    kept = found.columns
    information = replace(raw, columns=kept, sizes=sizes[kept])
    # The unit of [design] combination: that of its parameters, "" where they differ.
    units = {p.unit for p in model.parameters if p.name in spec.combination}
    setup = Setup(
        information, found,
        CriterionInputs(
            spec.criterion, len(kept), found.interest,
            combination=found.combination, unit=units.pop() if len(units) == 1 else "",
            n_poses=n_poses, names=information.names, sizes=information.sizes,
        ),
        None, prior, () if hold else found.unseen, information.everything,
    )  # fmt: skip
    if "test_poses" not in criterion_named(spec.criterion).needs:
        return setup
    return _aimed(setup, model if work is None else work, targets, region, hold)


def _aimed(
    setup: Setup, at_work: Model, targets: TargetPoses, region: TargetPoses | None, hold: bool
) -> Setup:
    information, found = setup.information, setup.found
    model, T = information.model, len(targets.q)
    share = model.cell.design.elsewhere or 0.0
    both, weight = targets, targets.weight
    if region is not None:
        both = TargetPoses.together([targets, region], targets.source)
        weight = np.concatenate([(1 - share) * weight, share * region.weight])
    x = information.x + (at_work.nominal - model.nominal)
    rows, told = known_rows(at_work, both, x, found)
    weak = [model.names[c] for c in found.structure.kept if c not in found.columns]
    lost = [model.names[c] for c in found.unpredictable(rows)] if hold else []
    why = [f"so many poses show less of {listed(weak)} than their noise"] * bool(weak)
    why += [f"no poses tell {listed(lost)} from the rest, or show them"] * bool(lost)
    held = found.held(rows)
    if why and (bias := np.sqrt(weight @ (held**2).sum(axis=(1, 2)))) >= WORTH_TELLING:
        told += (
            f"{'; '.join(why)}; identification holds what it cannot see, and typical deviations "
            f"of that move the test points by {length(bias)} rms, which the criterion "
            "does not count",
        )
    inputs = replace(setup.inputs, A=found.on_kept(rows[:T], hold), weights=targets.weight)
    beyond = None
    if region is not None:
        # None where no plan could make the position at all of them certain.
        with suppress(InsufficientDataError):
            beyond = found.on_kept(rows[T:], hold), region.weight
    if share and beyond is None:
        raise InsufficientDataError(
            f"{wish('elsewhere', f'{model.cell.source}: [design] elsewhere')} asks for poses all "
            "over the joint ranges, but the rules allow none, or no plan can make all of them "
            "certain; leave it out"
        )
    told, held = setup.warnings + told, held[:T]
    return replace(setup, inputs=inputs, beyond=beyond, share=share, warnings=told, held=held)


# The weight of what lies elsewhere, from the price that the test poses may pay for it.
#
# The relaxed optimum w(s) of Φ = (1 − s) Φ_test + s Φ_elsewhere has Φ_test(w(s)) rising and
# Φ_elsewhere(w(s)) falling with s; all that can be had lies on this curve (both are convex).  Near
# s = 0, where Φ_test is least, it rises with the square of u = s/(1 − s).

MOST = 0.9  # share at most
CLOSE = 0.05  # of the price under the limit: a better share would not be noticed
LOOSE = 1e-3  # gap of the relaxations
ENOUGH = 4000  # candidates


def share_within(
    setup: Setup, pool: FeasiblePool, shares: IntArray, cap: float, progress: Progress
) -> float:
    """The largest share s of the postures elsewhere for which the relaxed optimum is at most `cap`
    worse at the test poses (rms) than it could be."""
    if setup.elsewhere_rows is None or not cap:
        return 0.0
    progress(f"weight of the joint ranges, at most {100 * cap:g} % worse at the test poses")
    # As many as tell the share: it hangs on where poses are, not on each of them.
    pool = pool.take(evenly(pool.group, max(ENOUGH // len(shares), 20 * int(shares.max()))))
    problem = replace(setup, share=0.0).problem(pool, shares)
    own, T = problem.criterion, problem.balancing()
    alone = relax(problem.balanced(T), LOOSE)
    weights, price = alone.weights, ((1 + cap) ** 2 - 1) * alone.value

    def over(u: float) -> float:
        nonlocal weights
        other = replace(problem, criterion=replace(setup, share=u / (1 + u)).criterion)
        weights = relax(other.balanced(T), LOOSE, weights).weights
        paid = (float(own.of_information(problem.at(weights))) - alone.value) / price
        return 0.0 if 1 - CLOSE <= paid <= 1 else paid - 1 + CLOSE / 2

    most = MOST / (1 - MOST)
    if over(most) <= 0:
        return MOST
    u = brentq(over, 0.0, most)
    return float(u / (1 + u))


# What time shows.  The order says when each reading is made and from where each joint came, so that
# B holds the columns of drift, warming and hysteresis too.  More parameters never lower Φ: the
# certificate's bound holds for them as well.

# What a pose has only once it stands in an order.
OPEN = frozenset({"time", "temperature", "approach"})


def clocked(execution: Execution, done: Measurements | None = None) -> Execution:
    """With the time of each stop, in s from the beginning, or the last of those `done`, to the
    middle of its readings, and the sign of each joint's last motion on the way to it, 0 where it
    has not moved yet, where those done say it."""
    motion, stops = execution.motion, []
    start = 0.0 if done is None or done.time is None else float(done.time.max())
    plain = done is not None and done.approach is None
    last = execution.stops[0].q if motion.home is None else motion.home
    sign = np.zeros(len(last), dtype=np.int64)
    for stop, begun in zip(execution.stops, execution.arrivals, strict=True):
        for q in (*stop.via, stop.q):
            step = q - last
            sign = np.where(np.abs(step) > STILL, np.sign(step), sign).astype(np.int64)
            last = q
        came = sign if stop.approach is None and not plain else stop.approach
        stops.append(replace(stop, time=start + begun + motion.dwell / 2, approach=came))
    return replace(execution, stops=tuple(stops))


def promised(model: Model, without: Model, plan: Plan, targets: TargetPoses, known: Known) -> Plan:
    """The plan with times and sides, and what it promises of all parameters of the `model` with
    effects of time and approach, of which the model `without` lacks some."""
    spec = model.cell.design
    plan = replace(plan, model=model, execution=clocked(plan.execution))
    rows = expand_plan(plan.table(), tuple(model.cell.tool.markers), spec.repeats)
    x = model.nominal
    table = marker_sigmas(model.cell, simulate(model, rows, x, 0, noise=False))
    B, raw = whitened(model, table, x)
    sizes = model.sizes(raw)
    found, prior = estimable(model, known, fixed_and_free(model, known.fixed), B * sizes, sizes)
    kept = found.columns
    B = B[:, kept] * sizes[kept]
    M = B.T @ B + prior
    own = np.isin([model.names[c] for c in kept], without.names)
    shown = predicted(found, M, len(B))
    names = dict.fromkeys(p.effect for p in model.parameters if p.name not in without.names)
    errors: tuple[float | None, float | None] = (None, None)
    with suppress(InsufficientDataError):
        R = root(found.on_kept(known_rows(model, targets, x, found)[0]), targets.weight)
        errors = remaining_rms(R, M), remaining_rms(R[:, own], M[np.ix_(own, own)])
    return replace(plan, predicted=shown, scheduled=Scheduled(tuple(names), *errors))


# What can be chosen besides poses.
#
# The relaxed optimum Φ*(z) = min_w Φ(Σ w_i A_i(z)) over weights w is what the best plan at places z
# can reach at most.  It is made small over w and z in turn: at weights w the places by L-BFGS-B
# (Byrd, Lu, Nocedal & Zhu 1995) within their boxes, at places z the weights by the certified
# relaxation, on candidates that the cell's rules allow there.  Both steps lower the same Φ, and
# where neither does ∂Φ*/∂z = ∂Φ/∂z|_w (envelope theorem) vanishes or points out of the boxes.

STARTS = 8  # places drawn in the boxes, besides those that the cell states
SEARCHED, COMPARED = 400, 2000  # candidates while searching, and for the figures that are told
ROUNDS = 8  # of weights and places in turn, at most
GAIN = 3e-3  # relative, of Φ, below which a round is the last one
STEP = 1e-6  # of a box, for differences of B, which has twelve digits
DIGITS = 6  # of a place in m: more cannot be built
USED = 1e-4  # of the largest weight: candidates that count while places move
MOST_CHOICES = 100  # of loads


@dataclass(frozen=True)
class Boxes:
    """Places that may move: `names` (k,), their `lower` and `upper` corners (k, 3) m."""

    names: tuple[str, ...]
    lower: Array
    upper: Array

    @classmethod
    def of(cls, cell: Cell) -> Boxes:
        freedom = cell.design.choose
        assert freedom is not None
        every = freedom.markers | {LOAD_POINT: freedom.load_point, TRACKER: freedom.tracker}
        boxes = {name: box for name, box in every.items() if box is not None}
        corners = np.array(list(boxes.values())).reshape(-1, 2, 3)
        return cls(tuple(boxes), corners[:, 0], corners[:, 1])

    def places(self, cell: Cell) -> Array:
        tool = cell.tool
        known = tool.markers | {LOAD_POINT: tool.load_point, TRACKER: cell.tracker.position}
        return np.array([known[name] for name in self.names]).reshape(-1, 3)

    def at(self, unit: Array) -> Array:
        """Places (k, 3) of a point (3 k,) of the unit cube."""
        return self.lower + unit.reshape(-1, 3) * (self.upper - self.lower)

    def placed(self, cell: Cell, places: Array) -> Cell:
        at = dict(zip(self.names, np.round(places, DIGITS), strict=True))
        point = at.pop(LOAD_POINT, cell.tool.load_point)
        tracker = replace(cell.tracker, position=at.pop(TRACKER, cell.tracker.position))
        tool = replace(cell.tool, load_point=point, markers=cell.tool.markers | at)
        return replace(cell, tool=tool, tracker=tracker)


class RelaxedPoint(NamedTuple):
    cell: Cell
    setup: Setup
    pool: FeasiblePool
    relaxed: Relaxed
    share: float


@dataclass(frozen=True)
class Choice:
    """`work` is the model of the cell as it stands, whose test poses `targets` (and `region`) are
    what every choice is judged by."""

    work: Model
    targets: TargetPoses
    region: TargetPoses | None
    known: Known
    seed: int
    progress: Progress

    def best(self) -> Chosen:
        cell = self.work.cell
        where, freedom = cell.source, cell.design.choose
        named = wish("choose", f"{where}: [design.choose]")
        assert freedom is not None
        require(
            CRITERIA[cell.design.criterion].certifiable,
            f"{named} compares relaxed optima, which criterion "
            f"{cell.design.criterion} has none of; choose another criterion",
        )
        require(
            self.known.done is None,
            f"{named} moves what measurements were made with; leave it out where "
            "a plan adds to some",
        )
        boxes = Boxes.of(cell)
        loads = self._loads(freedom.loads)
        found = self._placed(boxes, loads) if boxes.names else loads
        if found is None:
            raise InsufficientDataError(
                f"{where}: no choice within [design.choose] gives a plan; widen the boxes"
            )
        self.progress("comparing what was chosen with the cell as it stands")
        before, after = (self.relaxed(c, COMPARED) for c in (cell, found.cell))
        stated = boxes.places(cell)
        inside = bool(((boxes.lower <= stated) & (stated <= boxes.upper)).all())
        no_worse = before and after and before.relaxed.value <= after.relaxed.value
        if after is None or (no_worse and inside and freedom.loads is None):
            found, after = found._replace(cell=cell), before
        assert after is not None
        criterion = after.setup.criterion
        places = np.stack([boxes.places(cell), boxes.places(found.cell)], axis=1)
        return Chosen(
            places=dict(zip(boxes.names, places, strict=True)),
            loads=None if freedom.loads is None else found.cell.design.loads,
            before=None if before is None else criterion.figure(before.relaxed.value),
            after=criterion.figure(after.relaxed.value), unit=criterion.unit,
            share=(None if before is None else before.share, after.share),
            candidates=len(after.pool),
        )  # fmt: skip

    def _loads(self, most: int | None) -> RelaxedPoint | None:
        cell, given = self.work.cell, self.work.cell.design.loads
        if most is None or given is None:
            return self.relaxed(cell)
        heavy = np.flatnonzero(given.any(axis=1))
        sets = list(combinations(heavy, min(most, len(heavy))))
        require(
            len(sets) <= MOST_CHOICES,
            f"{cell.source}: {len(sets)} choices of {most} of {len(heavy)} loads; state "
            f"fewer loads, up to {MOST_CHOICES} choices of them",
        )
        hung = ([i for i in range(len(given)) if i in k or i not in heavy] for k in sets)
        return self._least("loads,", [_with_loads(cell, given[some]) for some in hung])

    def _placed(self, boxes: Boxes, begun: RelaxedPoint | None) -> RelaxedPoint | None:
        cell = self.work.cell if begun is None else begun.cell
        draws = sobol(3 * len(boxes.names), np.random.default_rng(self.seed)).random(STARTS)
        starts = [boxes.places(cell).clip(boxes.lower, boxes.upper), *map(boxes.at, draws)]
        best = self._least("places, start", [boxes.placed(cell, at) for at in starts])
        if best is None:
            return None
        for k in range(ROUNDS):
            here, there = boxes.places(best.cell), self._moved(boxes, best)
            self.progress(f"choosing places, round {k + 1}")
            # All the way, or a part of it where the rules leave too little there.
            way = (self.relaxed(boxes.placed(cell, here + part * (there - here)))
                   for part in (1.0, 0.5, 0.25))  # fmt: skip
            found = (p for p in way if p is not None and p.relaxed.value < best.relaxed.value)
            if (better := next(found, None)) is None:
                break
            gain, best = 1 - better.relaxed.value / best.relaxed.value, better
            if gain < GAIN:
                break
        return best

    def _least(self, what: str, cells: list[Cell]) -> RelaxedPoint | None:
        points = []
        for k, cell in enumerate(cells):
            self.progress(f"choosing {what} {k + 1} of {len(cells)}")
            points.append(self.relaxed(cell))
        found = (point for point in points if point is not None)
        return min(found, key=lambda point: point.relaxed.value, default=None)

    def _moved(self, boxes: Boxes, point: RelaxedPoint) -> Array:
        """The places (k, 3) that lower Φ most at the weights of `point`, sought in units of the
        boxes.  One model serves all of them: places on the tool are its parameters."""
        setup, pool, w = point.setup, point.pool, point.relaxed.weights
        used, information = np.flatnonzero(w > USED * w.max()), setup.information
        here, on_tool = boxes.places(point.cell), [name != TRACKER for name in boxes.names]
        motions: list[tuple[Entry, str]] = [
            (LoadPointMotion(), LoadPointMotion.at)
            if name == LOAD_POINT
            else (MarkerMotion(), f"marker:{name}")
            for name in boxes.names
            if name != TRACKER
        ]
        mobile = Model.assembled(information.model.chain, point.cell, motions)

        def value(unit: Array) -> float:
            model, places = copy(mobile), boxes.at(unit)
            model.cell = boxes.placed(point.cell, places)  # of which the noise asks the tracker
            x = np.concatenate([information.x, (places - here)[on_tool].ravel()])
            there = replace(information, model=model, x=x)
            B = there.blocks(pool.q[used], pool.readings[used])
            M = setup.gathered(B * np.sqrt(w[used])[:, None, None])
            return float(np.log(setup.criterion.of_information(M)))

        width = np.maximum(boxes.upper - boxes.lower, np.finfo(float).tiny)
        unit = ((here - boxes.lower) / width).clip(0.0, 1.0).ravel()
        how = {"maxiter": 20, "eps": STEP, "ftol": 1e-4}
        limits = [(0.0, 1.0)] * len(unit)
        return boxes.at(minimize(value, unit, method="L-BFGS-B", bounds=limits, options=how).x)

    def draw(self, cell: Cell, candidates: int = SEARCHED) -> Candidates:
        return draw(Feasibility(cell, self.work.chain), plan_forces(cell), candidates, self.seed)

    def relaxed(
        self, cell: Cell, drawn: Candidates | int = SEARCHED, read: BoolArray | None = None
    ) -> RelaxedPoint | None:
        """The relaxed optimum of a cell on candidates drawn, or so many, `read` in load states
        (K, L) that were chosen before; None where it leaves something open."""
        chain, shares = self.work.chain, shares_of(cell)
        try:
            rules = Feasibility(cell, chain)
            drawn = self.draw(cell, drawn) if isinstance(drawn, int) else drawn
            model = Model.assembled(chain, replace(cell, model=self.work.cell.model))
            setup = set_up(
                model, drawn.q, int(shares.sum()), self.targets, self.known, self.region,
                rules.seen, self.work,
            )  # fmt: skip
            if read is not None:
                setup = replace(setup, ways=cell.design.repeats * read)
            else:
                setup, _ = chosen_states(setup, drawn.q, drawn.group, shares, self.progress)
            pool, tried = setup.pool(drawn.q, drawn.group), drawn.counts
            relaxed = relax(setup.problem(pool, shares).balanced(), GAIN / 10)
        except InsufficientDataError:
            return None
        return RelaxedPoint(cell, setup, pool, relaxed, tried.feasible / tried.tried)


def applied(chosen: Chosen, cell: Cell) -> Cell:
    cell = Boxes.of(cell).placed(cell, np.array([after for _, after in chosen.places.values()]))
    return cell if chosen.loads is None else _with_loads(cell, chosen.loads)


def _with_loads(cell: Cell, loads: Array) -> Cell:
    return replace(cell, design=replace(cell.design, loads=loads))


REPEATS = (1, 2, 3, 4, 6, 8, 12, 16, 24)
WORSE = 2  # numbers of repeats in a row that are worse than fewer: more are not tried
TRIES = 3  # plans within a time


def within(choice: Choice, cell: Cell, plan_of: Callable[[Cell], Plan], minutes: float) -> Plan:
    """The best of TRIES plans: moves take longer than was thought, or leave time for a pose."""
    asked, found = minutes, list[Plan]()
    for _ in range(TRIES):
        sizes, fit = _sizes(choice, cell, asked)
        told = tuple(replace(size, minutes=size.minutes * minutes / asked) for size in sizes)
        found.append(replace(plan_of(fit.cell), timed=told))
        took = found[-1].execution.total / 60
        if took <= minutes < took * (1 + 1 / len(found[-1])):
            break
        asked *= minutes / took
    best = min(found, key=lambda plan: (max(plan.execution.total / 60, minutes), plan.value))
    took = best.execution.total / 60
    more = (f"the plan takes {took:.0f} minutes, as its moves are longer than was thought",)
    return replace(best, warnings=best.warnings + more * (took > minutes))


class _Fit(NamedTuple):
    """How many parameters a plan determines, its Φ, what it is, the cell that asks for its stops,
    and in which states (K, L) candidates are read."""

    kept: int
    value: float
    size: TimedSize
    cell: Cell
    read: BoolArray


def _sizes(choice: Choice, cell: Cell, minutes: float) -> tuple[tuple[TimedSize, ...], _Fit]:
    spec, drawn, found = cell.design, choice.draw(cell), list[_Fit]()
    # Where a reading takes no time nothing says how many of them there may be.
    for repeats in REPEATS if spec.motion.reading > 0 else (spec.repeats,):
        choice.progress(f"within {rounded(minutes, 4)} minutes: {repeats} readings each")
        read = found[-1].read if found else None
        with suppress(InsufficientDataError):
            found.append(_fitting(choice, cell, minutes, drawn, repeats, read))
        values = [fit.value for fit in found]
        if len(found) > WORSE and min(values[-WORSE:]) > min(values):
            break
    if not found:
        raise InsufficientDataError(
            f"{cell.source}: no plan that determines the parameters takes "
            f"{rounded(minutes, 4)} minutes or less; allow more time, or lower dwell_s, reading_s "
            "and load_change_s of [design.motion] where they are too high"
        )
    # A plan that holds more parameters errs less in the others, but not in all.
    best = min(found, key=lambda fit: (-fit.kept, fit.value))
    return tuple(fit.size for fit in found if fit.kept == best.kept), best


def _fitting(
    choice: Choice, cell: Cell, minutes: float, drawn: Candidates, repeats: int,
    read: BoolArray | None,
) -> _Fit:  # fmt: skip
    """As many poses as fit, candidates being `read` in load states that were chosen before; an
    error where there is none."""
    # What poses read twice would take, more poses may have.
    motion = replace(cell.design.motion, extra_time=cell.design.motion.longer)
    spec = replace(cell.design, per_level=(), repeats=repeats, minutes=None, motion=motion)

    def sized(poses: int) -> Cell:
        return replace(cell, design=replace(spec, poses=poses))

    everything = np.ones((len(drawn.q), len(plan_forces(cell))), dtype=np.int64)
    poses = bisect_left(
        range(1, len(drawn.q) + 1), True,
        key=lambda n: _minutes(sized(n), drawn.q[:n], everything[:n]) > minutes,
    )  # fmt: skip
    point = choice.relaxed(sized(poses), drawn, read) if poses else None
    if point is None:
        raise InsufficientDataError("too little time, or something stays open")
    problem = point.setup.problem(point.pool, shares_of(point.cell))
    problem.check_enough()
    chosen, phi = exact_plan(problem.balanced(), point.relaxed)
    took = _minutes(point.cell, point.pool.q[chosen], point.pool.readings[chosen])
    # Where a load is not hung there is time for more; Φ goes about as one over their number.
    more = max(int(poses * minutes / took), 1) / poses
    value = point.setup.criterion.figure(phi / more)
    size = TimedSize(round(len(chosen) * more), repeats, took * more, value)
    whole, read = sized(round(poses * more)), point.setup.ways > 0
    return _Fit(len(problem.prior), phi / more, size, whole, read)


def _minutes(cell: Cell, q: Array, readings: IntArray) -> float:
    """About how long the poses q (N, n) take, each read in the load states that have `readings`
    (N, L), on a short way without obstacles."""
    motion, read = at_stops(cell), readings > 0
    heavy = int((np.any(plan_forces(cell) != 0, axis=1) & read.any(axis=0)).sum())
    changes = (motion.load_changes or heavy + 1) if heavy else 0
    home = q[:1] if motion.home is None else motion.home[None]
    waiting = read.sum() * motion.dwell * (2 if motion.both_directions else 1)
    travel = 0.0
    for visited, states in zip(*np.unique(read.T, axis=0, return_counts=True), strict=True):
        cost = travel_times(np.vstack([home, q[visited]]), motion.speed)
        ring = [0, *nearest_first(cost), 0]
        travel += states * cost[ring[:-1], ring[1:]].sum()
    total = waiting + travel + changes * motion.load_change
    return float(total * (1 + motion.longer) / 60)


# In which load states each pose is read: in all of them, or each where it tells most.
#
# With a pose read in one load state as a candidate, the relaxation weighs poses and load states
# together: it has as many stops as the poses have in all load states, shared out anew.  Each load
# takes changes by hand, each of which is worth Δ/a stops (Δ s of a change, a s of a stop): with Φ
# of order 1/stops, a choice of loads that saves c changes of n stops is as good, in the same time,
# as Φ n / (n + c Δ/a).  Loads that are used least are left out one by one, the best choice is kept.

# Of Φ, 1 % of an error, by which a choice must be better: the same poses in all load states are
# simpler to measure, and a noise that is stated is not known to that.
SIMPLER = 0.02
SOME = 1000  # poses that the choice is made on


def single_ways(information: PoseInformation) -> IntArray:
    """Ways (K, L) to read a pose in one load state: of deflections in one and unloaded."""
    ways = information.everything * np.eye(len(information.forces), dtype=np.int64)
    if information.model.cell.model.observe == "deflection":
        ways[1:, 0] = ways[0, 0]
        ways = ways[1:]
    return ways


def chosen_states(
    setup: Setup, q: Array, group: IntArray, shares: IntArray, progress: Progress
) -> tuple[Setup, LoadStates | None]:
    """With the ways (K, L) in which candidates q (N, n) are best read, and why, where the cell asks
    for a choice of them."""
    information, cell = setup.information, setup.information.model.cell
    if cell.design.load_states != "chosen":
        return setup, None
    require(
        not cell.noise.configuration or cell.model.observe == "deflection",
        f"{cell.source}: [noise] configuration_um says that a pose's readings share an "
        'error in all load states, which only load_states = "all" counts with; drop one of them',
    )
    ways = single_ways(information)
    if len(ways) == 1:
        one = "a deflection takes its reading without load and that under the only one"
        return setup, LoadStates("all", one if ways.sum() > 1 else "there is one load state")
    progress("load states of the poses")
    few = np.arange(0, len(q), max(len(q) // SOME, 1))

    def relaxed(ways: IntArray) -> tuple[float, Array]:
        own = replace(setup, ways=ways)
        problem = own.problem(own.pool(q[few], group[few]), shares).balanced()
        weights = relax(problem, GAIN / 3).weights
        value = float(problem.criterion.of_information(problem.at(weights)))
        return value, weights.reshape(len(ways), -1).sum(axis=1)

    motion, loaded = at_stops(cell), (information.forces != 0).any(axis=1)
    crossed, _ = relaxed(information.everything)
    stops = float(shares.sum() * len(loaded))
    # Nothing but travel may take time; that is not told here.
    worth = motion.load_change / max(motion.dwell * (2 if motion.both_directions else 1), 1.0)
    kept, best, least = np.arange(len(ways)), ways, np.inf
    while True:
        value, weight = relaxed(ways[kept])
        heavy = (ways[kept] > 0)[:, loaded].any(axis=1)
        saved = (loaded.sum() - heavy.sum()) * worth
        if value * stops / (stops + saved) < least:
            best, least = ways[kept], value * stops / (stops + saved)
        if heavy.sum() < 2:
            break
        kept = np.delete(kept, np.flatnonzero(heavy)[np.argmin(weight[heavy])])
    figures = setup.criterion.figure(crossed), setup.criterion.figure(least)
    if least > (1 - SIMPLER) * crossed:
        why = "choosing them for each pose would hardly lower the error"
        return setup, LoadStates("all", why, *figures)
    return replace(setup, ways=best), LoadStates("chosen", "", *figures)
