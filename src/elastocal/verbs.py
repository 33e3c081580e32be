"""The verbs of the front door: design, simulate, identify, diagnose, compensate.

Each takes the model first (or a cell, or the path of one) and its options as keyword arguments;
it checks them, makes the option objects that the packages below work with, and calls them.

Signature and docstring are the one place where an option is declared, for the command line too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, cast

from elastocal.above import checked_arguments, later, shown, whole
from elastocal.messages import InputError, option, quoted, require, saying

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import ArrayLike
    from pandas import DataFrame

    from elastocal.cell import Cell
    from elastocal.cell_tables import Freedom, Motion, TargetBox, TargetPath, TargetPose
    from elastocal.compensation import Compensation, Targets
    from elastocal.diagnosis.diagnosis import Diagnosis
    from elastocal.identification.knowledge import Constraints, GaussianPrior, Knowledge
    from elastocal.identification.result import Calibration
    from elastocal.identification.start import FaultyReadings, IntervalKind, Method
    from elastocal.identification.weighted_problem import WeightKind
    from elastocal.measurements import Measurements
    from elastocal.model.calibrated import CalibratedArm
    from elastocal.model.manipulator import Model
    from elastocal.planning.design import DesignOptions, Effort
    from elastocal.planning.plan import Plan
    from elastocal.units import Array
else:
    globals().update(later(
        "elastocal CalibratedArm Calibration Cell Compensation Diagnosis Knowledge Measurements",
        "elastocal Model Plan",
        "elastocal.cell_tables Freedom Motion TargetBox TargetPath TargetPose",
        "elastocal.compensation Targets",
        "elastocal.identification.knowledge Constraints GaussianPrior",
        "elastocal.identification.start FaultyReadings IntervalKind Method",
        "elastocal.identification.weighted_problem WeightKind",
        "elastocal.planning.design Effort",
        "numpy.random Generator",
        "numpy.typing ArrayLike",
        "pandas DataFrame",
    ))  # fmt: skip

# Each verb imports what it calls: one should not load another, and --help none of them.

AnyModel: TypeAlias = Model | Cell | str | Path
Table: TypeAlias = Measurements | str | Path | DataFrame
Prior: TypeAlias = Mapping[str, Mapping[str, float]] | GaussianPrior
Progress: TypeAlias = Callable[[str], None]
Seed: TypeAlias = int | Generator  # a number has been drawn before a verb runs


@checked_arguments
def design(
    model: AnyModel,
    *,
    poses: int | None = None,
    criterion: str | None = None,
    target: float | None = None,
    minutes: float | None = None,
    curve: Sequence[int] = (),
    fixed: str | Sequence[str] = (),
    augment: Table | None = None,
    keep: str | Path | None = None,
    strike: str | Path | None = None,
    knowledge: Knowledge | str | Path | None = None,
    prior: Literal["none", "typical"] | Prior | None = None,
    effort: Effort = "normal",
    candidates: int | str | Path | Sequence[int | str | Path] | None = None,
    repeats: int | None = None,
    loads: ArrayLike | None = None,
    load_states: Literal["all", "chosen"] | None = None,
    repeatability: float | None = None,
    marker_sigma: Mapping[str, float] | None = None,
    levels: Mapping[str, Sequence[float]] | None = None,
    per_level: Sequence[int] | None = None,
    interest: str | Sequence[str] | None = None,
    combination: Mapping[str, float] | None = None,
    test_poses: ArrayLike | Sequence[TargetPose] | None = None,
    test_path: str | Path | TargetPath | None = None,
    test_box: tuple[ArrayLike, ArrayLike] | TargetBox | None = None,
    elsewhere: float | None = None,
    elsewhere_cap: float | None = None,
    choose: Freedom | None = None,
    motion: Motion | None = None,
    load_changes: int | None = None,
    reference_every: int | None = None,
    seed: Seed = 0,
    jobs: int = 1,
    progress: Progress | None = None,
) -> Plan:
    """Which poses should I measure?

    Candidates that the cell allows; their information by the symbolic model's B; a convex
    relaxation, which bounds every plan; exchange and polish; the order of execution.  What is
    None is as the cell's [design] says, or its default.

    Args:
        model: The model, or a cell, or the path of a cell file.
        poses: Number of poses.
        criterion: What is to become small: "test_pose" (error at the test poses), "D", "A", "E",
            "G", "I", "c", "O1", "O3" or "O5"; default as the cell says.
        target: Find the fewest poses that reach this error, for the criteria test_pose, G and I.
            In m.
        minutes: Find the best numbers of poses and readings within this time.  It stands instead
            of `poses` and `target`.
        curve: Compare numbers of poses, as in 10,15,20,30.
        fixed: Parameter, place or effect to hold as known.
        augment: Existing measurements to extend.
        keep: Poses of an earlier plan that stay: all, or some, as in "plan.csv:1,4".
        strike: Poses of a plan to replace, as in "plan.csv:3,7"; all its others stay.
        knowledge: Knowledge file (TOML) as for identify, whose priors count.  Or a `Knowledge`.
        prior: "typical" takes every parameter's typical size as its prior, "none" none; or what
            is known by name, {"joint2.compliance": {"mean": 2.9e-7, "std": 3e-8}}.
        effort: How hard to search: "quick", "normal", "thorough"; "batch" chooses among the
            candidates as they were drawn.
        candidates: Feasible candidates to draw, over all levels; or a table of poses to choose
            from, or both, as in "taught.csv",500.  In Python ["taught.csv", 500].
        repeats: Readings per pose and load state.
        loads: Forces (L, 3) in N at the load point, in the data's frame.
        load_states: "all" reads each pose in every load state, "chosen" in those where it tells
            most, with as many stops in all.
        repeatability: Standard deviation in m, per direction, of what a configuration's readings
            have in common.
        marker_sigma: Standard deviation in m per marker, instead of the tracker's noise.
        levels: One joint with the values (rad or m) that it is to be measured at.
        per_level: Number of poses of each level.
        interest: Parameters, places or effects that D, A, E and O count.
        combination: Factor by parameter, for the criterion c.
        test_poses: Joints (k, joints) in rad or m where the position must be right.
        test_path: A table (CSV) of such places.
        test_box: Lower and upper corner (3,) in m of a box of such places, in the data's frame.
        elsewhere: Weight of poses all over the joint ranges, a share as 0.2, beside the test poses.
        elsewhere_cap: Loss allowed at the test poses to reduce the error elsewhere, a share as
            0.05, which is the default where no test poses are stated.
        choose: Boxes in which markers, load point and tracker may still be placed before.
        motion: How the arm moves between poses, which decides their order.
        load_changes: Load changes allowed; more reduce the effect of drift; default: the fewest.
        reference_every: Visit a reference pose again after so many stops.
        seed: Seed of all random draws, or a numpy Generator.
        jobs: Processes; -1 for all cores.
        progress: Is told what is done.

    Returns:
        The `Plan`: poses in their order, what they promise, how far from the best they are.

    Raises:
        InputError: Cell and options contradict themselves or each other; the message names the
            keyword or the cell's key.
        InsufficientDataError: No pose is feasible, or none shows a parameter that counts.

    Examples:
        >>> plan = ec.design(
        ...     "cell.toml", poses=6, criterion="D", candidates=100, effort="quick",
        ...     loads=[[0, 0, -2600]], levels={"joint2": np.radians([-25.24, -99.85])},
        ... )
        >>> plan
        <Plan kuka_kr270_2: 6 poses by D, ...>
        >>> plan.save("six.csv")
    """
    asked = {name: given for name, given in locals().items() if name not in ("model", "progress")}
    from elastocal.planning.design import design as run

    return run(*design_request(model, **asked), progress=progress or _silent)


def design_request(
    model: AnyModel, *, curve: Any = (), fixed: Any = (), augment: Any = None, keep: Any = None,
    strike: Any = None, knowledge: Any = None, prior: Any = None, **asked: Any,
) -> tuple[Cell, DesignOptions]:  # fmt: skip
    """The cell with [design] as `asked`, and how to search; options as for `design`.

    Raises InputError that names the keyword.
    """
    from elastocal.model.effects.catalogue import cell_of
    from elastocal.model.manipulator import Model, measurements_of
    from elastocal.planning.design import DesignOptions
    from elastocal.planning.poses import read_pins, shares_of

    cell = model.cell if isinstance(model, Model) else cell_of(model)
    search = {name: asked.pop(name) for name in ("effort", "seed", "jobs") if name in asked}
    if isinstance(prior, str):
        asked["prior"], prior = prior, None
    named = tuple(name for name, given in asked.items() if given is not None)
    with saying(given=named):
        cell = replace(cell, design=_design_of(cell, asked))
        cell.check()
    for number in curve:
        shares_of(cell, whole("curve", number), "curve")  # each level takes a pose
    if asked.get("poses") is not None:
        shares_of(cell, cell.design.poses, "poses")
    files, done = (augment, knowledge, keep, strike), None
    known = None if all(file is None for file in files) else Model(cell)
    if augment is not None and known is not None:
        own = model if isinstance(model, Model) else known
        done = measurements_of(own, augment)
        known = own.with_markers_of(done)
        cell = cell if own is known else replace(cell, tool=known.cell.tool)
    stated, notes = (None, ()) if known is None else _prior_of(knowledge, known)
    require(
        stated is None or prior is None,
        f"{option('prior')} and {option('knowledge')} both state what is known; drop one",
    )
    pins = None
    if known is not None and (keep or strike):
        cell, pins = read_pins(cell, known, keep, strike, asked.get("poses") is not None)
    options = DesignOptions(
        **search, fixed=_names(fixed), done=done, notes=notes, pins=pins, asked=named,
        prior=_gaussian(prior) if stated is None else stated, curve=tuple(sorted({*curve})),
    )  # fmt: skip
    return cell, options


def _design_of(cell: Cell, asked: Mapping[str, Any]) -> Any:
    import numpy as np

    from elastocal import cell_tables as wish
    from elastocal.planning.criteria import criterion_named

    def test_poses(given: Any) -> tuple[TargetPose, ...]:
        require(np.ndim(given) > 0, f"{option('test_poses')} takes joints by pose; found {given}")
        if all(isinstance(pose, wish.TargetPose) for pose in given):
            return tuple(given)
        return tuple(wish.TargetPose(q) for q in np.atleast_2d(np.asarray(given, dtype=float)))

    made: dict[str, Callable[[Any], Any]] = {
        "criterion": lambda name: criterion_named(name, option("criterion")) and name,
        "interest": _names,
        "loads": lambda forces: np.atleast_2d(np.asarray(forces, dtype=float)),
        "test_poses": test_poses,
        "test_path": lambda at: wish.TargetPath(Path(at)) if isinstance(at, str | Path) else at,
        "test_box": lambda box: box if isinstance(box, wish.TargetBox) else wish.TargetBox(*box),
    }
    chosen = {key: _plain(value) for key, value in asked.items() if value is not None}
    chosen = {key: made[key](v) if key in made else v for key, v in chosen.items()}
    if "candidates" in chosen:
        told = f"takes {wish.CANDIDATES}; found {shown(chosen['candidates'])}"
        found = wish.of_candidates(chosen["candidates"])
        require(found is not None, f"{option('candidates')} {told}")
        given, taught = found or (None, None)
        given = None if given is None else whole("candidates", given)
        chosen |= {"candidates": given, "taught": None if taught is None else Path(taught)}
    wishes = [key for key in ("poses", "target", "minutes") if key in chosen]
    told = "a target or a time asks for the number of poses; drop one"
    require(len(wishes) < 2, f"{' and '.join(map(option, wishes))}: {told}")
    if "levels" in chosen:
        chosen.setdefault("per_level", ())
    for key, other in (("elsewhere", "elsewhere_cap"), ("elsewhere_cap", "elsewhere")):
        if key in chosen:
            chosen.setdefault(other, None)
    motion = {k: chosen.pop(k) for k in ("load_changes", "reference_every") if k in chosen}
    if motion:
        chosen["motion"] = replace(chosen.get("motion", cell.design.motion), **motion)
    # What the cell says of the number of poses gives way to what is asked for here.
    number: dict[str, Any] = {"minutes": None} if wishes else {}
    if "poses" in chosen or "minutes" in chosen:
        number |= {"per_level": (), "target": None}
    if chosen.get("per_level"):
        number = {"poses": sum(chosen["per_level"]), "target": None, "minutes": None}
    return replace(cell.design, **(number | chosen))


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(map(_plain, value))
    return value.tolist() if hasattr(value, "tolist") else value


def _prior_of(
    knowledge: Knowledge | str | Path | None, model: Model
) -> tuple[GaussianPrior | None, tuple[str, ...]]:
    from elastocal.identification.knowledge import Constraints

    known = knowledge_of(knowledge)
    if known is None:
        return None, ()
    prior = known.of(model)[1]
    if prior is None:
        raise InputError(
            f"{known.source}: states no prior, and only priors count for a plan; add "
            f'[prior."joint2.compliance"] with mean and std, or leave {option("knowledge")} out'
        )
    left_out = known.physical or known.constraints != Constraints()
    note = (
        f"{known.source}: only its priors count for a plan; bounds, equalities and matrices do not"
    )
    return prior, (note,) if left_out else ()


@checked_arguments
def simulate(
    model: AnyModel,
    plan: Plan | Table | ArrayLike,
    *,
    values: Mapping[str, float] | ArrayLike | None = None,
    draw: float = 0.0,
    load: ArrayLike | None = None,
    repeats: int = 1,
    noise: bool = True,
    seed: Seed = 0,
) -> Measurements:
    """What would I measure, if …?

    Args:
        model: The model, or a cell, or the path of a cell file.
        plan: The poses: a `Plan`, its file, a table, or joints (n, joints) in rad or m.
        values: True parameter values in SI units, by name (the others are nominal) or all of them
            (parameters,).
        draw: Draw true values: typical sizes times this, at random; `values` comes first.
        load: Measure every pose without and with this force (3,) in N at the load point.
        repeats: Readings per pose and load state.
        noise: Whether the readings have the noise that plan or cell state; else they are exact.
        seed: Seed of all random draws, or a numpy Generator.

    Returns:
        The `Measurements`, one row per pose, repeat, load state and marker.

    Raises:
        InputError: A name is unknown, a pose beyond the limits, or without static equilibrium.

    Examples:
        >>> truth = {"joint3.compliance": 3.4e-7}
        >>> data = ec.simulate("cell.toml", "plan.csv", values=truth, load=[0, 0, -2600])
        >>> len(data), data.position.shape
        (90, (90, 3))
        >>> ec.identify("cell.toml", data)["joint3.compliance"].ci95
        (3.3...e-07, 3.4...e-07)
    """
    return simulated(_model(model), plan, values, draw, repeats, noise, seed, load)[0]


def simulated(
    made: Model, plan: Any, values: Any, draw: float, repeats: int, noise: bool, seed: Seed,
    load: ArrayLike | None = None,
) -> tuple[Measurements, Array]:  # fmt: skip
    """What `simulate` gives, and the true values (parameters,) behind it."""
    import numpy as np

    from elastocal.identification.start import check_limits
    from elastocal.measurements import Measurements
    from elastocal.model.effects.base import given_force
    from elastocal.simulation import NOMINAL, draw_errors, expand_plan, values_from
    from elastocal.simulation import simulate as run

    force = given_force(load)
    told = f"{option('draw')} takes a factor of the typical sizes, 0 or more; found {draw:g}"
    require(0 <= draw < float("inf"), told)
    repeats = whole("repeats", repeats)
    if isinstance(plan, str | Path) or hasattr(plan, "iterrows"):
        poses = made.read_plan(plan)
    elif type(plan).__name__ == "Plan":
        poses = plan.table()
    else:
        poses = plan if isinstance(plan, Measurements) else made.table(plan)
    check_limits(made, poses)
    rng = np.random.default_rng(seed)
    rows = expand_plan(poses, tuple(made.cell.tool.markers), repeats, force)
    drawn = draw_errors(made, float(draw), rng) if draw else {}
    if values is None or isinstance(values, Mapping):
        x = values_from(made, drawn | dict(values or {}))
    else:
        x = np.asarray(values, dtype=float)
        require(
            x.shape == (len(made.parameters),) and np.isfinite(x).all(),
            f"{option('values')} takes {len(made.parameters)} finite numbers, one per parameter, "
            f"or some of them by name; found an array of shape {x.shape}",
        )
    of_the_draw = (
        f"those of {option('draw')} are of an arm for the loads that the cell plans ([design] "
        f"loads_N): simulate a load like these, state larger ones there, or give {option('values')}"
    )
    read = run(made, rows, x, rng, noise, of_the_draw if drawn else NOMINAL)
    # Up to here rows are lines of the plan, which messages name.
    return replace(read, row=np.arange(len(read)) + 2), x


@checked_arguments
def identify(
    model: AnyModel,
    data: Table,
    *,
    test: Table | None = None,
    fixed: str | Sequence[str] = (),
    method: Method = "auto",
    noise: str = "auto",
    weights: WeightKind = "auto",
    covariance: ArrayLike | str | Path | None = None,
    intervals: IntervalKind = "auto",
    outliers: FaultyReadings = "auto",
    bounded: bool = False,
    physical: bool = False,
    knowledge: Knowledge | str | Path | None = None,
    prior: Prior | None = None,
    constraints: Constraints | None = None,
    seed: Seed = 0,
    jobs: int = 1,
    progress: Progress | None = None,
) -> Calibration:
    """What are the parameters of my arm, and how sure are we?

    Start by registration; a minimal complete set of parameters; search for faulty readings; then
    by default weights from a noise model whose variances restricted likelihood estimates, and
    intervals that know they are estimated.

    Args:
        model: The model, or a cell, or the path of a cell file.
        data: The readings, or their file.
        test: Independent measurements to test the result on; they are never fitted.
        fixed: Parameter, place or effect to hold at its start.
        method: "auto" ("reml" unless `weights` are stated), "reml", "ols" (eq. 6 of Klimchik et
            al. 2013), "wls" (eq. 10), "eq14", "eq14-residual"; robust: "huber", "l1".
        noise: Noise that reml estimates: "auto", "independent", "axis", "marker", "groups",
            "polar", "stated"; with "+configuration" for deviations common to a configuration.
        weights: Stated noise to take as it is: "none", "rows", "axis", "polar", "covariance".
        covariance: Noise covariance in m² for the weights "covariance": CSV without header, or
            .npy.  Or an array (rows, rows).
        intervals: "auto" (by the method), "classical", "hc0" to "hc3", "cr0" to "cr3" (by
            configuration), "profile".
        outliers: "auto" (exclude, unless they are a tenth or more), "drop", "keep"; they are
            listed in any case.
        bounded: Keep parameters inside their physical bounds, as `physical`.
        physical: No negative compliance, compliance matrices semidefinite.
        knowledge: Prior knowledge: priors, bounds, equalities (TOML).  Or a `Knowledge`.
        prior: What is known by name, {"joint2.compliance": {"mean": 2.9e-7, "std": 3e-8}}.
        constraints: Bounds, equalities and matrices, besides those of `knowledge`.
        seed: Seed of all random draws, or a numpy Generator.
        jobs: Has no effect: nothing is drawn in processes.
        progress: Is told what is done.

    Returns:
        The `Calibration`: estimates with intervals, what could not be known, the calibrated arm.

    Raises:
        InputError: Data contradict robot or cell, or an option is wrong; the message names the
            keyword, or file, line and column.
        InsufficientDataError: The data cannot determine the model; the message says what to
            measure.

    Examples:
        >>> model = ec.Model("cell.toml")
        >>> fit = ec.identify(model, model.read("data.csv"), fixed=["joint1.compliance"])
        >>> fit["joint2.compliance_level1"].identifiable
        True
        >>> fit.save("result.json")
    """
    import numpy as np

    from elastocal.identification.identify import identify as run
    from elastocal.identification.start import Options
    from elastocal.measurements import read_matrix
    from elastocal.model.manipulator import measurements_of

    if isinstance(covariance, str | Path):
        covariance = read_matrix(covariance, "noise covariance")
    require(
        covariance is None or (np.ndim(covariance) == 2 and np.size(covariance) > 0),
        f"{option('covariance')} takes a square matrix in m²; found {quoted(covariance)}",
    )
    matrix = None if covariance is None else np.asarray(covariance, dtype=float)
    options = Options(
        method=method, noise=noise, weights=weights, covariance=matrix, intervals=intervals,
        fixed=_names(fixed), faulty=outliers, seed=cast(int, seed),
    )  # fmt: skip
    known = knowledge_of(knowledge, physical or bounded)
    tell = progress or _silent
    tell("reading")
    made = _model(model)
    table = measurements_of(made, data)
    kept_back = None if test is None else measurements_of(made, test)
    made = made.with_markers_of(*(t for t in (table, kept_back) if t is not None))
    prior = _gaussian(prior)
    if known is not None:
        stated, known_prior = known.of(made)
        constraints = stated if constraints is None else stated + constraints
        require(
            prior is None or known_prior is None,
            f"{option('prior')} and {option('knowledge')} both state a prior; drop one",
        )
        prior = prior or known_prior
    options = replace(options, constraints=constraints, prior=prior)
    used = None
    if made.cell.design.states_test_poses:  # planning takes as long to load as a small fit
        from elastocal.planning.poses import used_poses

        used = used_poses(made.cell, made.chain)
    return run(made, table, options, kept_back, tell, used)


@checked_arguments
def diagnose(
    model: AnyModel,
    data: Table,
    *,
    without: str | Sequence[str] = (),
    false_alarm: float = 0.05,
    extra_poses: int | None = None,
    seed: Seed = 0,
    progress: Progress | None = None,
) -> Diagnosis:
    """Why does the real arm still differ from the model?

    The cell's effects are fitted; noise floor and faulty readings come first; every effect of the
    catalogue at every place, and smooth dependences without a name, are then judged by their
    marginal likelihood; what is claimed has to beat the whole family under sign flips.

    Args:
        model: The model, or a cell, or the path of a cell file.
        data: The readings, or their file.
        without: Effect to exclude.
        false_alarm: Probability that something is claimed where nothing is.
        extra_poses: Where rivals are left, seek the fewest poses, at most this many, that tell
            them apart (`Diagnosis.extra`); None seeks none.
        seed: Seed of all random draws, or a numpy Generator.
        progress: Is told what is done.

    Returns:
        The `Diagnosis`: verdict, effects, candidates, where the gap lies, the budget of the gap.

    Raises:
        InputError: Data contradict robot or cell, or an option is wrong.
        InsufficientDataError: There are too few configurations to tell an effect from noise.

    Examples:
        >>> why = ec.diagnose("cell.toml", "data.csv")
        >>> [step.step for step in why.budget][:2]
        ['base_frame', 'compliance']
        >>> len(why.candidates) > 10, why.gap.nominal > 10 * why.gap.calibrated
        (True, True)
    """
    from elastocal.diagnosis.diagnose import DiagnosisOptions
    from elastocal.diagnosis.diagnose import diagnose as run
    from elastocal.model.manipulator import measurements_of

    options = DiagnosisOptions(cast(int, seed), _names(without), false_alarm)
    if extra_poses is not None:
        whole("extra_poses", extra_poses)
    tell = progress or _silent
    tell("reading")
    made = _model(model)
    table = measurements_of(made, data)
    made = made.with_markers_of(table)
    found = run(made, table, options, tell)
    if extra_poses is None or not found.open:
        return found
    from elastocal.diagnosis.extra_poses import plan_extra

    tell("looking for poses that tell the rivals apart")
    return replace(found, extra=plan_extra(found, extra_poses, cast(int, seed), tell))


@checked_arguments
def compensate(
    arm: CalibratedArm | Calibration,
    targets: Targets | str | Path | DataFrame | ArrayLike,
    *,
    load: ArrayLike | None = None,
    frame: Literal["base", "tracker"] = "base",
    point: str | ArrayLike | None = None,
    near: ArrayLike | None = None,
    seed: Seed = 0,
    progress: Progress | None = None,
) -> Compensation:
    """Which commands put the tool where it has to be?

    Solves the calibrated arm, under its load, for every target within the joint limits, nearest
    to the nominal command where joints or a free rotation leave a choice.

    Args:
        arm: `fit.arm`, or the `Calibration` itself, or what `read_calibrated` gives.
        targets: Positions (n, 3) or (3,) in m of the tool's point, poses (n, 4, 4) or (4, 4) of
            the tool, or a table of targets (CSV, Parquet or a data frame).
        load: Force (3,) in N at the load point, in `frame`, where the table states none.
        frame: Frame of targets and forces: "base" (as identified) or "tracker".
        point: Point of the tool: a marker, or x,y,z in m in the flange frame; default: the load
            point, or the only marker.
        near: Joints (joints,) in rad or m whose posture to begin near.
        seed: Seed of all random draws, or a numpy Generator.
        progress: Is told what is done.

    Returns:
        The `Compensation`: commands, predicted errors before and after, uncertainty, and what
        became of every target.

    Raises:
        InputError: Targets or an option are wrong; the message names the keyword, or file and
            line.

    Examples:
        >>> fit = ec.identify("cell.toml", "data.csv")
        >>> down = [[1.8, 0.0, 0.9], [1.8, 0.2, 0.9]]
        >>> commands = ec.compensate(fit.arm, down, load=[0, 0, -2600])
        >>> commands
        <Compensation kuka_kr270_2: 2 of 2 targets reached>
        >>> bool(commands.before.max() > 1e-3), bool(commands.after.max() < 1e-9)
        (True, True)
    """
    import numpy as np

    from elastocal.compensation import check_frame
    from elastocal.compensation import compensate as run
    from elastocal.model.calibrated import CalibratedArm, tool_point
    from elastocal.model.effects.base import given_force

    arm = arm if isinstance(arm, CalibratedArm) else arm.arm
    force = given_force(load)
    check_frame(frame)
    chain = arm.model.chain
    start = None if near is None else np.asarray(near, dtype=float)
    require(
        start is None or (start.shape == (chain.n_joints,) and np.isfinite(start).all()),
        f"{option('near')} takes {chain.n_joints} joints in rad or m; found {near!r}",
    )
    if point is not None and not isinstance(point, str):
        place = np.asarray(point, dtype=float)
        require(place.shape == (3,), f"{option('point')} takes a marker or three numbers in m")
        point = ",".join(repr(float(v)) for v in place)
    where = tool_point(arm.model.cell, point)
    wanted = _targets(targets, chain.kinds, frame, force)
    return run(arm, wanted, where, start, cast(int, seed), progress or _silent)


def _targets(
    targets: Any, kinds: tuple[str, ...], frame: Literal["base", "tracker"], force: Array | None
) -> Targets:
    import numpy as np

    from elastocal.compensation import Targets, read_targets, targets_at

    if isinstance(targets, Targets):
        return targets
    if isinstance(targets, str | Path) or hasattr(targets, "iterrows"):
        return read_targets(targets, kinds, frame, force)
    found = np.asarray(targets, dtype=float)
    if found.shape in ((3,), (4, 4)):
        found = found[None]
    oriented = found.ndim == 3 and found.shape[1:] == (4, 4)
    right = (oriented or (found.ndim == 2 and found.shape[1] == 3)) and len(found) > 0
    told = "takes positions (n, 3) in m, poses (n, 4, 4) or a file; found"
    require(right, f"{option('targets')} {told} an array of shape {np.shape(targets)}")
    if oriented:
        R, last = found[:, :3, :3], found[:, 3] - [0, 0, 0, 1]
        off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() + np.abs(last).max()
        told = "takes poses whose rotation is a rotation matrix, above a last row of 0 0 0 1"
        require(off < 1e-6 and (np.linalg.det(R) > 0).all(), f"{option('targets')} {told}")
        return targets_at("targets", found[:, :3, 3], found[:, :3, :3], frame, force)
    return targets_at("targets", found, None, frame, force)


@checked_arguments
def effects(cell: AnyModel | None = None) -> DataFrame:
    """The physical effects that can be fitted.

    Args:
        cell: The cell, its file or model, whose arm decides on places and sizes; None takes the
            KR 270 of the demo.

    Returns:
        A row per effect: name, stage, whether the cell has it `on`, what it is, its places, the
        columns that it needs, and its parameters with unit, nominal value and typical size.

    Raises:
        InputError: The cell is wrong.

    Examples:
        >>> found = ec.effects("cell.toml")
        >>> "joint_compliance" in set(found["name"])
        True
    """
    import pandas as pd

    from elastocal.model.manipulator import Model, effect_entries
    from elastocal.simulation import DEMO

    given = DEMO / "cell.toml" if cell is None else cell
    return pd.DataFrame(effect_entries(given.cell if isinstance(given, Model) else given))


def _silent(message: str) -> None:
    """Who asks for no progress is told none."""


def _model(given: AnyModel) -> Model:
    from elastocal.model.manipulator import Model

    return given if isinstance(given, Model) else Model(given)


def knowledge_of(given: Knowledge | str | Path | None, physical: bool = False) -> Knowledge | None:
    from elastocal.identification.knowledge import Knowledge, read_knowledge

    if given is None:
        return Knowledge(physical=True, source=option("physical", True)) if physical else None
    known = given if isinstance(given, Knowledge) else read_knowledge(given)
    return replace(known, physical=known.physical or physical)


def _gaussian(prior: Prior | None) -> GaussianPrior | None:
    from elastocal.identification.knowledge import GaussianPrior

    if prior is None or isinstance(prior, GaussianPrior):
        return prior
    return GaussianPrior.from_dict(prior)


def _names(given: str | Sequence[str]) -> tuple[str, ...]:
    return (given,) if isinstance(given, str) else tuple(given)
