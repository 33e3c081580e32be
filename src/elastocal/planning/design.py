"""Which poses should I measure?  From a cell to a plan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.cell.work_cell import Cell
from elastocal.errors import InsufficientDataError, option, require
from elastocal.model.manipulator import Model
from elastocal.planning.candidates import draw, joint_space
from elastocal.planning.criteria import CRITERIA
from elastocal.planning.exact_plan import RandomPlans, random_plans, size_curve
from elastocal.planning.exchange import values_without
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.information import Done, load_states, measured, next_number, readings_each
from elastocal.planning.plan import CandidateCounts, Chance, Plan, PlanSize, predicted, reasons
from elastocal.planning.polish import Searches
from elastocal.planning.search import EFFORTS, Checkpoint, DesignOptions, Selection, ordered, select
from elastocal.planning.setup import (
    FeasiblePool,
    Known,
    Setup,
    check_available,
    most_poses,
    set_up,
    shares_of,
)
from elastocal.planning.test_poses import check_cell, test_poses
from elastocal.text import did_you_mean, listed, quoted
from elastocal.units import Array, IntArray, Progress

MOST_POSES = 100  # that a target is sought with


def design(
    cell: Cell,
    options: DesignOptions | None = None,
    checkpoint: Checkpoint | None = None,
    progress: Progress = lambda message: None,
) -> Plan:
    """The measurement plan that [design] of the cell asks for, with its certificates.

    Candidates from Sobol points that every rule of [workspace] allows; their information from the
    symbolic model; convex relaxation (the bound), exchange, polish; order of execution.  The plan
    depends on the cell, the options and the seed, not on `options.jobs`, and not on whether the
    work was interrupted and taken up again from `checkpoint`.

    Raises InputError where cell and options contradict themselves or each other;
    InsufficientDataError where no pose is feasible, or a parameter that the criterion needs cannot
    be seen.
    """
    return _Design(cell, options or DesignOptions(), checkpoint or Checkpoint(), progress).run()


class _Design:
    """The course of a design; what each step needs of the steps before it."""

    def __init__(
        self, cell: Cell, options: DesignOptions, checkpoint: Checkpoint, progress: Progress
    ) -> None:
        self.warnings = list(options.notes)
        if cell.model.torque == "measured":
            cell = replace(cell, model=replace(cell.model, torque="computed"))
            self.warnings.append(
                "torques of poses that are not measured yet are computed from load and weights"
            )
        self.cell, self.options = cell, options
        self.checkpoint, self.progress = checkpoint, progress
        self.model = Model(cell, options.done.marker_names if options.done else ())
        self.cell = self.model.cell
        self.chain = self.model.chain
        check_cell(self.cell, self.chain)
        _check_criterion(self.model)
        self.states = load_states(self.cell)
        self.space = joint_space(self.cell, self.chain)
        self.feasibility = Feasibility(self.cell, self.chain)

    def run(self) -> Plan:
        progress, options = self.progress, self.options
        shares = shares_of(self.cell)
        planned = [shares_of(self.cell, n) for n in options.curve]
        planned += [shares] if self.cell.design.target is None else []
        targets = test_poses(self.cell, self.chain, self._at_work(), options.seed)
        q, load, group, counts = self._candidates()
        for wanted in planned:
            check_available(self.cell, np.bincount(group), wanted)
        done = None
        if options.done is not None:
            progress("information of the measurements done")
            done = measured(self.model, options.done, options.fixed)
            self.warnings.append(f"B is taken at {done.note}")
        known = Known(options.fixed, options.prior, done)
        progress("information of the candidates")
        setup = set_up(
            self.model, self.states, q, load, int(shares.sum()), targets, known, options.seed
        )
        self.warnings += setup.warnings
        pool = setup.pool(q, load, group)
        curve, shares, begun = self._sizes(setup, pool, shares)
        searches = Searches(setup.information, self.space, self.feasibility, self.feasibility.pairs)
        found = select(setup, pool, shares, searches, options, self.checkpoint, progress, begun)
        progress("random plans beside it")
        drawn = random_plans(setup.problem(pool, shares), options.seed)
        return self._plan(setup, found, shares, counts, targets.source, curve, done, drawn)

    def _at_work(self) -> Feasibility:
        """The rules for test poses: there the arm works, and the tracker need not see it."""
        workspace = replace(self.cell.workspace, visibility=None, load=None)
        return Feasibility(replace(self.cell, workspace=workspace), self.chain)

    def _candidates(self) -> tuple[Array, IntArray, IntArray, CandidateCounts]:
        stage = self.checkpoint.stage("candidates")
        state = stage.load()
        if state is None:
            self.progress("drawing candidates")
            drawn = draw(
                self.cell, self.chain, self.states, self.feasibility,
                self.cell.design.candidates, self.options.seed, self.options.jobs, self.progress,
            )  # fmt: skip
            rules = list(drawn.removed_by)
            state = {
                "q": drawn.q,
                "load": drawn.load,
                "group": drawn.group,
                "tried": np.array([drawn.tried, drawn.feasible]),
                "rules": np.array(rules, dtype=np.str_),
                "removed": np.array([drawn.removed_by[r] for r in rules], dtype=np.int64),
            }
            stage.save(state)
        tried, feasible = (int(v) for v in state["tried"])
        removed = dict(zip(state["rules"].tolist(), state["removed"].tolist(), strict=True))
        counts = CandidateCounts(tried, feasible, removed)
        return state["q"], state["load"], state["group"], counts

    def _sizes(
        self, setup: Setup, pool: FeasiblePool, shares: IntArray
    ) -> tuple[tuple[PlanSize, ...], IntArray, IntArray | None]:
        """The curve of criterion against number of poses, and where there is a target the shares
        that meet it and a plan that does."""
        target, numbers = self.cell.design.target, self.options.curve
        if target is None and not numbers:
            return (), shares, None
        stage = self.checkpoint.stage("sizes")
        state = stage.load()
        if state is None:
            state = self._size_curve(setup, pool, target, numbers)
            stage.save(state)
        reported = setup.criterion.reported
        points = tuple(
            PlanSize(int(n), reported(value)[0], None if np.isnan(b) else reported(b)[0])
            for n, value, b in zip(state["n"], state["value"], state["bound"], strict=True)
        )
        if target is None:
            return points, shares, None
        smallest = int(state["smallest"])
        if not smallest:
            last = points[-1]
            raise InsufficientDataError(
                f"{self.cell.path or self.cell.name}: no plan of up to {last.poses} poses meets "
                f"the target of {target * 1e6:g} µm; the best found reaches {last.value:.4g} µm: "
                "ask for less, measure more repeats, or take a better tracker"
            )
        return points, shares_of(self.cell, smallest), state["plan"]

    def _size_curve(
        self, setup: Setup, pool: FeasiblePool, target: float | None, numbers: tuple[int, ...]
    ) -> dict[str, NDArray]:
        """As `size_curve`: bounds NaN where there are none, `smallest` 0 where none meets."""
        found = size_curve(
            lambda n: setup.problem(pool, shares_of(self.cell, n)),
            numbers,
            None if target is None else self._target(setup, target),
            between=(pool.n_groups, most_poses(self.cell, np.bincount(pool.group), MOST_POSES)),
            starts=EFFORTS[self.options.effort].starts,
            seed=self.options.seed,
            jobs=self.options.jobs,
            progress=self.progress,
        )
        plans = {p.n_poses: p.plan.chosen for p in found.points}
        bounds = [np.nan if p.bound is None else p.bound for p in found.points]
        return {
            "n": np.array([p.n_poses for p in found.points]),
            "value": np.array([p.value for p in found.points]),
            "bound": np.array(bounds),
            "smallest": np.array(found.smallest or 0),
            "plan": plans.get(found.smallest or 0, np.zeros(0, dtype=np.int64)),
        }

    def _target(self, setup: Setup, target: float) -> float:
        """Φ of a target in m."""
        unit_value, unit = setup.criterion.reported(1.0)
        metric = [name for name, criterion in CRITERIA.items() if criterion.unit == "µm"]
        require(
            unit == "µm",
            f"{self.cell.path or self.cell.name}: a target in µm goes with the criteria "
            f"{_joined(metric, 'and')}, not with {self.cell.design.criterion}; drop it, or "
            f"compare by {option('curve')}",
        )
        return (target * 1e6 / unit_value) ** 2

    def _plan(
        self, setup: Setup, found: Selection, shares: IntArray, counts: CandidateCounts,
        targets: str,
        curve: tuple[PlanSize, ...], done: Done | None, drawn: RandomPlans,
    ) -> Plan:  # fmt: skip
        self.progress("order of execution")
        found, execution, told = ordered(
            setup, found, shares, self.feasibility, self.options.seed, self.progress
        )
        self.warnings += told
        pool, chosen = found.pool, found.chosen
        q, load, blocks = pool.q[chosen], pool.load[chosen], pool.blocks[:, chosen]
        spec = self.cell.design
        problem = setup.problem(pool, shares)
        M = setup.gathered(blocks)[0]
        numbers = blocks.shape[1] * blocks.shape[2] * readings_each(self.cell)
        numbers += 0 if done is None else done.numbers
        value, unit = setup.criterion.reported(found.value)
        bound = found.certificate.bound_pool
        return Plan(
            model=self.model,
            criterion=spec.criterion,
            value=found.value,
            reported=value,
            unit=unit,
            q=q,
            load=load,
            forces=self.states.forces,
            group=pool.group[chosen],
            levels=self.space.levels,
            level_joint=None if self.space.held is None else f"joint{self.space.held + 1}",
            execution=execution,
            candidates=counts,
            certificate=found.certificate,
            predicted=predicted(self.model, setup.found, M, numbers),
            reasons=reasons(
                self.model, setup.found, blocks[0], setup.prior[0],
                values_without(problem, chosen), found.value,
            ),
            targets=targets,
            seed=self.options.seed,
            polished=found.polished,
            curve=curve,
            bound_reported=None if bound is None else setup.criterion.reported(bound)[0],
            warnings=tuple(self.warnings),
            first=next_number(self.options.done),
            chance=Chance.of(drawn, found.value, setup.criterion),
        )  # fmt: skip


def _check_criterion(model: Model) -> None:
    """The criterion is known; `[design] combination` is there where it is needed, and names
    parameters."""
    cell = model.cell
    where, asked = cell.path or cell.name, cell.design.criterion
    takes = _joined([f'"{name}"' for name in CRITERIA], "or")
    require(
        asked in CRITERIA,
        f"{where}: key design.criterion takes {takes}; found {quoted(asked)}"
        f"{did_you_mean(asked, CRITERIA)}",
    )
    names = cell.design.combination
    require(
        bool(names) or "combination" not in CRITERIA[asked].needs,
        f'{where}: key design.combination is missing; beside criterion = "{asked}" it takes '
        "factors by parameter, as in "
        f'combination = {{ "{next(iter(model.names), "joint2.compliance")}" = 1.0 }}',
    )
    for name in names:
        require(
            name in model.names,
            f"{where}: [design] combination names {quoted(name)}, which is no parameter of the "
            f"model{did_you_mean(name, model.names)}; there are {listed(model.names)}",
        )


def _joined(names: list[str], word: str) -> str:
    """a, b and c."""
    return f"{', '.join(names[:-1])} {word} {names[-1]}"
