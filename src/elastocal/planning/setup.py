"""What a design knows before it chooses: parameters, criterion, earlier information."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import optimize

from elastocal.identification.start import fixed_and_free
from elastocal.measurements import STILL
from elastocal.messages import InsufficientDataError, length, listed, wish
from elastocal.model.chain import joint_index
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.planning.criteria import CriterionInputs, ScenarioCriterion, criterion_named, root
from elastocal.planning.execution import Execution
from elastocal.planning.information import (
    Estimable,
    Known,
    PoseInformation,
    Sight,
    estimable,
    evenly,
    marker_sigmas,
    whitened,
)
from elastocal.planning.plan import Everywhere, Plan, Scheduled, predicted, remaining_rms
from elastocal.planning.relaxation import DesignProblem, relax
from elastocal.planning.test_poses import TargetPoses, known_rows
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
    `pinned`: poses that stay, which every problem knows before."""

    information: PoseInformation
    found: Estimable
    inputs: CriterionInputs
    beyond: tuple[Array, Array] | None
    prior: Array
    warnings: tuple[str, ...]
    ways: IntArray
    share: float = 0.0
    pinned: FeasiblePool | None = None

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
        """M (p, p) of a plan's blocks (N, r, p) and what was known before."""
        B = blocks.reshape(-1, blocks.shape[-1])
        return np.asarray(self.prior + B.T @ B)


def set_up(
    model: Model, q: Array, n_poses: int, targets: TargetPoses, known: Known,
    region: TargetPoses | None = None, sight: Sight | None = None, work: Model | None = None,
    hold: bool = False,
) -> Setup:  # fmt: skip
    """The parameters that the candidates q (N, n) show, and the criterion on them.

    `region`: poses all over the joint ranges, which count for the criterion with the share
    `[design] elsewhere`.  `work`: the model at the test poses, where its tool is another one.
    `hold`: parameters by which no plan can predict the test poses are held, not refused; so they
    are of distances, which never show where the arm stands as a whole.
    """
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
    if why and (bias := found.remaining_bias(rows, weight)) >= WORTH_TELLING:
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
    warnings = setup.warnings + told
    return replace(setup, inputs=inputs, beyond=beyond, share=share, warnings=warnings)


# The weight of what lies elsewhere, from the price that the test poses may pay for it.
#
# The relaxed optimum w(s) of Φ = (1 − s) Φ_test + s Φ_elsewhere has Φ_test(w(s)) rising and
# Φ_elsewhere(w(s)) falling with s; all that can be had lies on this curve (both are convex).  Near
# s = 0, where Φ_test is least, it rises with the square of u = s/(1 − s).

MOST = 0.9  # share at most
CLOSE = 0.05  # of the price under the limit: a better share would not be noticed
LOOSE = 1e-3  # gap of the relaxations
SOME = 4000  # candidates


def share_within(
    setup: Setup, pool: FeasiblePool, shares: IntArray, cap: float, progress: Progress
) -> float:
    """The largest share s of the postures elsewhere for which the relaxed optimum is at most
    `cap` worse at the test poses (rms) than it could be; 0 where there are none."""
    if setup.elsewhere_rows is None or not cap:
        return 0.0
    progress(f"weight of the joint ranges, at most {100 * cap:g} % worse at the test poses")
    # As many as tell the share: it hangs on where poses are, not on each of them.
    each = max(SOME // len(shares), 20 * int(shares.max()))
    pool = pool.take(evenly(pool.group, each))
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
    u = optimize.brentq(over, 0.0, most)
    return float(u / (1 + u))


# What time shows.  The order says when each reading is made and from where each joint came, so that
# B holds the columns of drift, warming and hysteresis too.  More parameters never lower Φ: the
# certificate's bound holds for them as well.

# What a pose has only once it stands in an order.
OPEN = frozenset({"time", "temperature", "approach"})


def clocked(execution: Execution) -> Execution:
    """With the time of each stop, in s from the beginning to the middle of its readings, and the
    sign of each joint's last motion on the way to it, 0 where it has not moved yet."""
    motion, stops = execution.motion, []
    last = execution.stops[0].q if motion.home is None else motion.home
    sign = np.zeros(len(last), dtype=np.int64)
    for stop, begun in zip(execution.stops, execution.arrivals, strict=True):
        for q in (*stop.via, stop.q):
            step = q - last
            sign = np.where(np.abs(step) > STILL, np.sign(step), sign).astype(np.int64)
            last = q
        came = sign if stop.approach is None else stop.approach
        stops.append(replace(stop, time=float(begun) + motion.dwell / 2, approach=came))
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
        A = found.on_kept(known_rows(model, targets, x, found)[0])
        R = root(A, targets.weight)
        errors = remaining_rms(R, M), remaining_rms(R[:, own], M[np.ix_(own, own)])
    return replace(plan, predicted=shown, scheduled=Scheduled(tuple(names), *errors))
