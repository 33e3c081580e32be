"""Which poses should I measure?  From a cell to a plan."""

from __future__ import annotations

import json
from bisect import bisect_left
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import count
from typing import Literal

import numpy as np
from threadpoolctl import threadpool_limits

from elastocal.cell import Cell
from elastocal.cell_tables import TEST_POSE
from elastocal.identification.identify import identify
from elastocal.identification.knowledge import GaussianPrior
from elastocal.identification.start import Options
from elastocal.measurements import Measurements
from elastocal.messages import (
    InputError,
    InsufficientDataError,
    check_known,
    listed,
    option,
    quoted,
    require,
    rounded,
    saying,
    wish,
)
from elastocal.model.chain import (
    LIMIT_SLACK,
    Chain,
    check_numbers,
    check_posture,
    joint_index,
    joint_limits,
    told,
)
from elastocal.model.effects.base import LEVEL_TOLERANCE
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.manipulator import Model
from elastocal.planning.criteria import CRITERIA, criterion_named
from elastocal.planning.feasibility import CandidateCounts, Feasibility
from elastocal.planning.information import (
    IDENTIFIED,
    Known,
    lacks_noise,
    measured,
    next_number,
    plan_forces,
    with_noise_of,
)
from elastocal.planning.plan import Chance, Gain, Plan, PlanSize, predicted, reasons
from elastocal.planning.poses import (
    Candidates,
    Pins,
    TargetPoses,
    brought,
    check_available,
    draw,
    everywhere,
    joint_space,
    poses_of,
    shares_of,
    test_poses,
)
from elastocal.planning.relaxation import DesignProblem, relax, sized_plans
from elastocal.planning.search import (
    EFFORTS,
    POOL,
    Checkpoint,
    Search,
    SearchEffort,
    Searches,
    State,
    ordered,
)
from elastocal.planning.setup import (
    OPEN,
    Choice,
    FeasiblePool,
    Setup,
    applied,
    chosen_states,
    clocked,
    promised,
    set_up,
    share_within,
    within,
)
from elastocal.units import Array, BoolArray, IntArray, Progress

Effort = Literal["quick", "normal", "thorough", "batch"]


@dataclass(frozen=True)
class DesignOptions:
    """`fixed`: parameters, places or effects held; `prior`: what is known of parameters;
    `done`: measurements that the plan adds to; `curve`: numbers of poses to compare; `notes`:
    sentences on how these came about, for the plan's warnings; `pins`: poses that stay or are
    struck out; `asked`: options in the place of keys of [design]; `hold`: parameters by which no
    plan can predict the test poses are held, as identification holds them, and told."""

    effort: Effort = "normal"
    seed: int = 0
    jobs: int = 1
    fixed: tuple[str, ...] = ()
    prior: GaussianPrior | None = None
    done: Measurements | None = None
    curve: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()
    pins: Pins | None = None
    asked: tuple[str, ...] = ()
    hold: bool = False

    def __post_init__(self) -> None:
        check_known(self.effort, EFFORTS, f"{option('effort')} {quoted(self.effort)} is unknown")
        require(
            self.jobs == -1 or self.jobs >= 1,
            f"{option('jobs')} takes a number of processes, or -1 for all cores; found {self.jobs}",
        )


MOST_POSES = 100  # that a target is sought with


# Products of matrices of a few dozen rows: more threads of BLAS wait for each other.
@threadpool_limits.wrap(limits=1, user_api="blas")
def design(
    cell: Cell,
    options: DesignOptions | None = None,
    checkpoint: Checkpoint | None = None,
    progress: Progress = lambda message: None,
) -> Plan:
    """The measurement plan that [design] of the cell asks for, with its certificates.  It depends
    on the cell, the options and the seed, not on `options.jobs`, and not on whether the work was
    interrupted and taken up again from `checkpoint`."""
    options, checkpoint = options or DesignOptions(), checkpoint or Checkpoint()
    with saying(given=options.asked):
        read = options.done.marker_names if options.done else ()
        if options.done is not None and lacks_noise(cell):
            progress("noise of the measurements done")
            with suppress(InsufficientDataError):  # then it has to be stated
                found = identify(Model(cell, read), options.done, Options(fixed=options.fixed))
                cell, told = with_noise_of(cell, found)
                options = replace(options, notes=(*options.notes, *told))
        whole, spec = _Design(cell, options, checkpoint, progress), cell.design
        if spec.choose is None and spec.minutes is None:
            return whole.run()
        # An assembled model knows no markers but the cell's, nor the file's names of joints.
        cell = Model(cell, read).cell
        choice = Choice(whole.model, *whole.targets, whole.known, options.seed, progress)
        chosen = None if spec.choose is None else choice.best()
        placed = cell if chosen is None else applied(chosen, cell)

        def plan_of(cell: Cell) -> Plan:
            # Within a time poses come in several numbers.
            own = replace(checkpoint, prefix=f"{cell.design.poses}x{cell.design.repeats}_")
            return replace(_Design(cell, options, own, progress, whole).run(), chosen=chosen)

        return within(choice, placed, plan_of, spec.minutes) if spec.minutes else plan_of(placed)


class _Design:
    def __init__(
        self, cell: Cell, options: DesignOptions, checkpoint: Checkpoint, progress: Progress,
        first: _Design | None = None,
    ) -> None:  # fmt: skip
        self.warnings = list(options.notes)
        if cell.model.torque == "measured":
            cell = replace(cell, model=replace(cell.model, torque="computed"))
            self.warnings.append(
                "torques of poses that are not measured yet are computed from load and weights"
            )
        if cell.design.candidates is None and cell.design.taught is None:
            cell = replace(cell, design=replace(cell.design, candidates=POOL))
        self.checkpoint, self.progress, self.options = checkpoint, progress, options
        self.model = Model(cell, options.done.marker_names if options.done else ())
        self._leave_out()
        # What the cell as it stands says of test poses and of measurements holds for others too.
        self.first = first
        self.cell, self.chain = self.model.cell, self.model.chain
        check_cell(self.cell, self.chain)
        _check_criterion(self.model)
        self.forces = plan_forces(self.cell)
        self.space = joint_space(self.cell, self.chain)
        pins = self.options.pins
        self.feasibility = Feasibility(self.cell, self.chain, None if pins is None else pins.struck)
        if (home := self.cell.design.motion.home) is not None:
            met = self.feasibility.blockers(home, home, False)
            motion = wish("motion", f"{cell.source}: [design.motion]")
            require(
                not met,
                f"{motion} home brings {listed(met)} too close to each other; state another home, "
                "or correct the bodies and clearances of [workspace]",
            )

    def _leave_out(self) -> None:
        cell, self.fixed = self.model.cell, self.options.fixed
        done = self.options.done is not None
        effects = dict.fromkeys(c.name for c in cell.model.effects)
        needs = {name: OPEN & set(effect_of(name).needed(cell)) for name in effects}
        functions = tuple(dict.fromkeys(p.effect for p in self.model.parameters if p.shrunk))
        lasting = tuple(c for c in cell.model.effects if not needs[c.name])
        self.whole = self.model.with_effects(lasting) if done and functions else None
        self._drop(
            functions,
            f"the plan holds the smooth functions ({listed(functions)}) at zero: it is made for "
            "the other parameters; to show functions too, measure many poses all over the joints' "
            "ranges",
        )
        open_ = tuple(name for name in effects if needs[name] and name not in functions)
        unknown = tuple(name for name in open_ if done or "temperature" in needs[name])
        table = self.options.done if unknown else None  # times go on behind those of it
        self.dated = None if table is None or table.time is None else table
        self._drop(
            unknown,
            f"the plan is made for the other parameters and holds {listed(unknown)} at nominal: "
            "what drives them is not known before; record times and temperatures, and ask for "
            f"reference poses ({option('reference_every', '10')}), so that identification can tell "
            "them",
        )
        late = tuple(name for name in open_ if name not in unknown)
        self.conditions = (self.model, self.options.fixed) if late else None
        self._drop(
            late,
            f"poses are chosen for the other parameters, as time and order alone show "
            f"{listed(late)}; the intervals count them, at the times and from the sides of "
            "plan.csv: keep its order, and record times",
        )

    def _drop(self, effects: tuple[str, ...], told: str) -> None:
        if not effects:
            return
        self.warnings.append(told)
        before = self.model
        rest = tuple(c for c in before.cell.model.effects if c.name not in effects)
        self.model = before.with_effects(rest)
        held = (n for n in self.options.fixed if self.model.meant_by(n) or not before.meant_by(n))
        self.options = replace(self.options, fixed=tuple(held))

    def run(self) -> Plan:
        plan = self._chosen()
        if self.dated is not None:
            plan = replace(plan, execution=clocked(plan.execution, self.dated))
        if self.conditions is None:
            return plan
        whole, fixed = self.conditions
        known = replace(self.known, fixed=fixed)
        return promised(whole, self.model, plan, self.targets[0], known)

    def _chosen(self) -> Plan:
        progress, options = self.progress, self.options
        pins, pinned_at = options.pins, np.zeros(0, dtype=np.int64)
        if pins is not None and len(pins.q):
            pinned_at = pins.placed(self.feasibility)
        self.pinned = np.bincount(pinned_at, minlength=self.space.n_groups)
        shares = self._shares()
        planned = [self._shares(n) for n in options.curve]
        planned += [shares] if self.cell.design.target is None else []
        targets, region = self.targets
        q, group, counts = self._candidates()
        for wanted in planned:
            check_available(self.cell, np.bincount(group), wanted, self.refused)
        known, stated = self.known, self.first or self
        progress("information of the candidates")
        setup = set_up(
            self.model, q, int((shares + self.pinned).sum()), targets, known,
            region, self.feasibility.seen, stated.model, options.hold,
        )  # fmt: skip
        self.warnings += setup.warnings
        if pins is not None and len(pins.q):
            setup = replace(setup, pinned=setup.pool(pins.q, pinned_at))
        setup, self.states = chosen_states(setup, q, group, shares, progress)
        pool = setup.pool(q, group)
        if cap := self.cell.design.cap:
            state = self.checkpoint.finished(
                "share", lambda: {"share": share_within(setup, pool, shares, cap, progress)}
            )
            setup = replace(setup, share=float(state["share"]))
        searches = Searches(setup, self.space, self.feasibility)
        effort = EFFORTS[options.effort]
        if self.cell.design.candidates is None:  # the plan is one of the poses that were brought
            effort = SearchEffort(starts=0, rounds=0, exchanges=max(effort.starts, 1))

        def sought(shares: IntArray, checkpoint: Checkpoint) -> Search:
            asked = pool, searches, shares, effort, options.seed, checkpoint, progress
            return Search(*asked).select()

        curve = self._curve(setup, pool)
        if self.cell.design.target is None:
            found = sought(shares, self.checkpoint)
        else:
            found, sizes = self._fewest(setup, pool, sought)
            curve = tuple(sorted((*curve, *sizes), key=lambda size: size.poses))
        progress("random plans beside it")
        drawn = setup.problem(pool, found.shares).random_information(options.seed)
        return self._plan(setup, found, counts, targets.source, curve, drawn)

    def _gain(self, setup: Setup, M: Array, q: Array, readings: IntArray) -> Gain | None:
        """Of poses q (N, n) with information M (p, p); of smooth functions, where the cell has
        some, what the readings show of them counts too."""
        options, done, whole = self.options, self.options.done, self.whole
        if done is not None and whole is not None and setup.target_rows is not None:
            self.progress("gain with the smooth functions")
            fixed = tuple(name for name in self.fixed if whole.meant_by(name))
            known = Known(fixed, options.prior, measured(whole, done, fixed))
            sight = self.feasibility.seen
            setup = set_up(whole, q, len(q), self.targets[0], known, sight=sight, hold=True)
            M = setup.gathered(setup.information.blocks(q, readings))
        if done is None or setup.target_rows is None:
            return None
        return Gain.of(setup.target_rows, setup.prior, M, options.seed)

    def _shares(self, n_poses: int | None = None) -> IntArray:
        shares = shares_of(self.cell, n_poses) - self.pinned
        require(
            bool((shares >= 0).all() and shares.any()),
            f"{self.cell.source}: {self.pinned.sum()} poses are to be kept, and "
            f"the plan has no more than {shares_of(self.cell, n_poses).sum()}"
            f"{' with their shares of the levels' if len(shares) > 1 else ''}; ask for more poses",
        )
        return shares

    @cached_property
    def known(self) -> Known:
        options, done = self.options, None if self.first is None else self.first.known.done
        if options.done is not None and done is None:
            self.progress("information of the measurements done")
            done = measured(self.model, options.done, options.fixed)
            if done.note != IDENTIFIED:
                self.warnings.append(f"the plan is made for {done.note}")
        return Known(options.fixed, options.prior, done)

    @cached_property
    def targets(self) -> tuple[TargetPoses, TargetPoses | None]:
        if self.first is not None:
            return self.first.targets
        cell, seed = self.cell, self.options.seed
        # There the arm works, and the tracker need not see it.
        workspace = replace(cell.workspace, visibility=None, load=None)
        at_work = Feasibility(replace(cell, workspace=workspace), self.chain)
        targets = test_poses(cell, self.chain, at_work, seed)
        if "test_poses" not in CRITERIA[cell.design.criterion].needs:
            return targets, None
        return targets, everywhere(cell, self.chain, at_work, seed)

    def _candidates(self) -> tuple[Array, IntArray, CandidateCounts]:
        state = self.checkpoint.finished("candidates", self._drawn)
        names = zip(state["q"], state["names"], strict=False)  # of those brought, which come first
        self.taught = {q.tobytes(): str(name) for q, name in names}
        self.refused = str(state["told"])
        self.warnings += [self.refused] * bool(self.refused)
        return state["q"], state["group"], CandidateCounts(**json.loads(str(state["counts"])))

    def _drawn(self) -> State:
        spec, asked = self.cell.design, (self.feasibility, self.forces)
        lots, names, told, options = list[Candidates](), list[str](), "", self.options
        if spec.taught is not None:
            self.progress(f"checking the poses of {spec.taught}")
            own, names, told = brought(*asked, poses_of(self.model, spec.taught), options.pins)
            lots.append(own)
        if spec.taught is None or spec.candidates is not None:
            self.progress("drawing candidates")
            n = spec.candidates or 1
            lots.append(draw(*asked, n, options.seed, options.jobs, self.progress))
        drawn = Candidates.join(lots)
        found = {"q": drawn.q, "group": drawn.group, "names": np.array(names, dtype=np.str_)}
        return found | {"told": told, "counts": json.dumps(asdict(drawn.counts))}

    def _curve(self, setup: Setup, pool: FeasiblePool) -> tuple[PlanSize, ...]:
        def make() -> State:
            found = sized_plans(
                lambda n: setup.problem(pool, self._shares(n)), self.options.curve,
                self.options.seed, self.progress,
            )  # fmt: skip
            return {str(n): size for n, size in found.items()}

        sizes = self.checkpoint.finished("sizes", make) if self.options.curve else {}
        figure = setup.criterion.figure
        return tuple(
            PlanSize(int(n), figure(value), None if np.isnan(bound) else figure(bound))
            for n, (value, bound) in sizes.items()
        )

    def _fewest(
        self, setup: Setup, pool: FeasiblePool, sought: Callable[[IntArray, Checkpoint], Search]
    ) -> tuple[Search, tuple[PlanSize, ...]]:
        """The fewest poses that meet the target, and the sizes that were tried: the bound tells
        where to begin; as Φ goes about as 1/n, each plan tells what to try next."""
        wanted, figure = self.cell.design.target, setup.criterion.figure
        assert wanted is not None
        metric = [name for name, criterion in CRITERIA.items() if criterion.unit == "µm"]
        require(
            setup.criterion.unit == "µm",
            f"{self.cell.source}: a target in µm goes with the criteria "
            f"{', '.join(metric[:-1])} and {metric[-1]}, not with {setup.criterion.name}; drop it, "
            f"or compare by {option('curve')}",
        )
        target, tried = (wanted * 1e6 / figure(1.0)) ** 2, dict[int, PlanSize]()
        available = np.bincount(pool.group)
        most, low = len(available), max(len(available), int(self.pinned.sum()) + 1)
        while most < MOST_POSES and (shares_of(self.cell, most + 1) <= available).all():
            most += 1
        best, high = None, most + 1  # the fewest are in [low, high), or high

        def problem_of(n: int) -> DesignProblem:
            return setup.problem(pool, self._shares(n))

        n = low + bisect_left(
            range(low, most + 1), True,
            key=lambda n: relax(problem_of(n).balanced(), 1e-3).bound <= target,
        )  # fmt: skip
        if n > most:
            value, _ = sized_plans(problem_of, [most], self.options.seed, self.progress)[most]
            tried[most], low = PlanSize(most, figure(value), None), high
        while low < high:
            try:
                found = sought(self._shares(n), replace(self.checkpoint, prefix=f"{n}_"))
            except (InputError, InsufficientDataError):
                if n == most:
                    raise
                low = n = n + 1
                continue
            bound = found.certificate.bound_pool
            tried[n] = PlanSize(n, figure(found.value), None if bound is None else figure(bound))
            if found.value <= target:
                best, high = found, n
            else:
                low = n + 1
            n = min(max(int(np.ceil(n * found.value / target)), low), high - 1)
        if best is None:
            last = tried[max(tried)]
            told = f"{self.cell.source}: no plan of up to {last.poses} poses meets the target of "
            told += f"{rounded(wanted * 1e6)} µm; the best found reaches {rounded(last.value, 4)}"
            told += " µm: ask for less, measure more repeats, or take a better tracker"
            raise InsufficientDataError(told)
        return best, tuple(tried.values())

    def _plan(
        self, setup: Setup, found: Search, counts: CandidateCounts, targets: str,
        curve: tuple[PlanSize, ...], drawn: Array,
    ) -> Plan:  # fmt: skip
        self.progress("order of execution")
        execution, alias, told = ordered(found)
        self.warnings += told
        pool, chosen = found.whole(found.chosen)
        q, blocks, readings = pool.q[chosen], pool.blocks[chosen], pool.readings[chosen]
        names = self._names(pool, chosen, len(found.pool))
        if few := ", ".join(names[k] for k in execution.one_sided):
            self.warnings.append(f"approached from one side only, as the other is blocked: {few}")
        spec, model, done = self.cell.design, setup.information.model, self.known.done
        M = setup.gathered(blocks)
        without = np.stack([setup.gathered(np.delete(blocks, k, axis=0)) for k in range(len(q))])
        noise, left = model.cell.noise, M
        if alias is not None and noise.drift:
            left = alias.information(M, execution.times(len(q), len(self.forces)), noise)
        seen, numbers = setup.information.seen(q), setup.information.numbers(q, readings)
        numbers += 0 if done is None else done.numbers
        gain = self._gain(setup, M, q, readings)
        figure, bound = setup.criterion.figure, found.certificate.bound_pool
        reported, asked = figure(found.value), np.inf if spec.target is None else spec.target * 1e6
        if reported > asked:  # `ordered` has put others in the place of some
            lost = f"no free move reaches some better poses, so the plan misses {rounded(asked)} µm"
            self.warnings.append(f"{lost}; ask for more ({option('poses')})")
        return Plan(
            model=self.model, criterion=spec.criterion, value=found.value,
            reported=reported, unit=setup.criterion.unit, q=q, forces=self.forces,
            group=pool.group[chosen], levels=self.space.levels,
            level_joint=None if self.space.held is None else f"joint{self.space.held + 1}",
            execution=execution, candidates=counts, certificate=found.certificate,
            predicted=predicted(setup.found, left, numbers),
            reasons=reasons(
                setup.information.names, blocks, M,
                setup.criterion.of_information(without) / found.value,
            ),
            targets=f"test poses: {targets}", seed=self.options.seed, curve=curve,
            polished=int(((chosen >= found.first) & (chosen < len(found.pool))).sum()),
            bound_reported=None if bound is None else figure(bound),
            warnings=tuple(self.warnings), made_for="" if done is None else done.note,
            names=names,
            chance=Chance.of(drawn, found.value, setup.criterion),
            everywhere=setup.everywhere(M, drawn, left), seen=None if seen.all() else seen,
            readings=readings, states=self.states, gain=gain,
        )  # fmt: skip

    def _names(self, pool: FeasiblePool, chosen: IntArray, own: int) -> tuple[str, ...]:
        """Those that stay, behind the `own` ones of the pool, keep theirs; the others are numbered
        after all there have been."""
        pins, q = self.options.pins, pool.q
        labels = self.options.done.configuration_labels if self.options.done else ()
        kept, taken = ((), ()) if pins is None else (pins.names, pins.taken)
        new = count(next_number((*labels, *taken, *self.taught.values())))
        names, read = list[str](), pool.readings > 0
        of_pose: dict[bytes, tuple[str, BoolArray]] = {}  # its name, and where it is read so far
        for i in chosen:
            name = kept[i - own] if i >= own else self.taught.get(q[i].tobytes())
            same, before = of_pose.get(q[i].tobytes(), (None, read[i]))
            if same is not None and not (before & read[i]).any():
                name = same  # in another load state
            elif name is None or name in names:
                name = str(next(new))
            names.append(name)
            of_pose[q[i].tobytes()] = name, read[i] if same is None else before | read[i]
        return tuple(names)


def _check_criterion(model: Model) -> None:
    cell = model.cell
    where, asked = cell.source, cell.design.criterion
    needs = criterion_named(asked, wish("criterion", f"{where}: key design.criterion")).needs
    cap = wish("elsewhere_cap", f"{where}: key design.elsewhere_cap")
    require(
        not cell.design.elsewhere_cap or asked == TEST_POSE,
        f'{cap} goes with criterion = "{TEST_POSE}", not with "{asked}"; drop it',
    )
    names = cell.design.combination
    missing = wish("combination", f"{where}: key design.combination")
    require(
        bool(names) or "combination" not in needs,
        f'{missing} is missing; beside criterion = "{asked}" it takes factors by parameter, as in '
        f'combination = {{ "{next(iter(model.names), "joint2.compliance")}" = 1.0 }}',
    )
    for name in names:
        told = f"{wish('combination', f'{where}: [design] combination')} names {quoted(name)}"
        check_known(name, model.names, f"{told}, which is no parameter of the model")


def check_cell(cell: Cell, chain: Chain) -> None:
    where, motion = cell.source, cell.design.motion
    lower, upper = joint_limits(cell, chain)
    levels = wish("levels", f"{where}: [design.levels]")
    for joint, values in cell.design.levels.items():
        i, split = joint_index(joint), cell.model.compliance_levels.get(joint)
        for value in values:
            found = f"{levels} has {joint} at {told(chain, i, value)}"
            require(
                lower[i] - LIMIT_SLACK <= value <= upper[i] + LIMIT_SLACK,
                f"{found}, beyond its limits, {told(chain, i, lower[i])} to "
                f"{told(chain, i, upper[i])}; correct the level or the limits",
            )
            require(
                split is None or min(abs(value - s) for s in split) <= LEVEL_TOLERANCE,
                f"{found}, which is none of its levels in [model.compliance_levels]; give both "
                "the same levels",
            )
    if motion.speed is not None:
        key = f"{where}: key design.motion.speed_" + ("deg_per_s" if motion.degrees else "si")
        check_numbers(chain, key, motion.speed, motion.degrees, one=motion.degrees)
    if motion.home is not None:
        key = f"{where}: key design.motion.home_{'deg' if motion.degrees else 'si'}"
        check_posture(cell, chain, key, motion.home, motion.degrees)
