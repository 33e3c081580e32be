"""A calibrated arm: the cell's model with the parameter values that an identification wrote."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import PlainValidator
from pydantic_core import PydanticCustomError

from elastocal.above import Saved, checked_arguments
from elastocal.cell import Cell
from elastocal.config import Many, Record, Table, checked, is_number, key, keyed
from elastocal.files import read_json
from elastocal.measurements import Measurements
from elastocal.messages import InputError, did_you_mean, listed, option, quoted, require, rounded
from elastocal.model import rigid
from elastocal.model.chain import Chain, finite_ranges, joint_index, joint_limits
from elastocal.model.effects.base import row_inputs
from elastocal.model.effects.catalogue import CATALOGUE, Total, cell_of, effect_of
from elastocal.model.effects.statics import LinkGravity
from elastocal.model.evaluate import BatchFunction
from elastocal.model.manipulator import Model, smooth_groups
from elastocal.units import Array

SCHEMA = "elastocal/identification/1"
SAME = 1e-6  # m, and of directions: two arms of one design differ by nothing
ANEW = "write the result anew with identify"
MOST_BYTES = 200_000_000  # a covariance of 3000 parameters


def _array(*columns: int) -> PlainValidator:
    """The validator of a table of numbers, an array (n, columns) or of whatever shape without
    them; null is NaN where the shape is free."""

    def check(value: object) -> Array:
        try:
            found = np.array(value, dtype=float)
            found = found.reshape(len(found), *columns) if columns else found
        except (TypeError, ValueError, OverflowError):
            found = np.full(1, np.inf)
        if np.isinf(found).any() or (columns and np.isnan(found).any()):
            raise PydanticCustomError("numbers", "numbers")
        return found

    return PlainValidator(check)


Matrix = Annotated[Array, _array()]
Triples = Annotated[Array, _array(3)]


class OpenParameters(Record):
    """The parameters D that the data left open, by `names` (D,), and what they stand for.

    `mixing` (K, D): a deviation of X_D went into the estimates of the K determined parameters as
    mixing · X_D, the least-squares solution of ∂(readings)/∂X_D ≈ ∂(readings)/∂X_K · mixing at the
    poses measured.  `typical` (D,): typical deviations in SI units, 0 where none is known.
    `redundant`: those that no pose under the loads measured tells from the rest: nothing needs to
    be done, it is the model that has one parameter too many.
    """

    more: ClassVar[str] = "ignore"
    names: Many[str] = keyed(takes="a list of names")
    mixing: Matrix = keyed(takes="shares, a row for each parameter of covariance_of")
    typical: Matrix = keyed(takes="a number for each of its names")
    redundant: Many[str] = keyed(takes="a list of names", default=())


class ShownPoses(Record):
    """How sure a fit is where it was measured: of each of `configurations` the standard deviation
    in m of the place predicted from the others is `most` at most."""

    more: ClassVar[str] = "ignore"
    most: float = keyed("largest_std_um")
    configurations: int = keyed()

    def chance(self, beyond: int, n: int) -> float:
        """Probability that so many of n poses or more are less sure than all that were measured,
        were they drawn alike: Π (n − i)/(n + m − i), i < beyond, of any exchangeable numbers."""
        i = np.arange(beyond)
        return float(np.prod((n - i) / (n + self.configurations - i)))

    def to_json(self) -> dict[str, float]:
        return {"largest_std_um": self.most * 1e6, "configurations": self.configurations}


class MeasuredVisits(Record):
    """Where an arm was measured: commanded joints `q` (k, joints) in rad or m, and the `force`
    (k, 3) N at each."""

    more: ClassVar[str] = "ignore"
    q: Matrix = keyed(takes="joints, a row for each visit")
    force: Triples = keyed("force_N", takes="forces, three numbers for each visit")

    def to_json(self) -> dict[str, Any]:
        """JSON-ready; joints to a µrad or µm, forces to a mN."""
        return {
            "q": [[round(float(v), 6) + 0.0 for v in row] for row in self.q],
            "force_N": [[round(float(v), 3) + 0.0 for v in row] for row in self.force],
        }


class Scatter(Record):
    """Covariance (K, K) of the determined parameters where configurations alone err independently
    (CR2), and its degrees of freedom (K,)."""

    more: ClassVar[str] = "ignore"
    covariance: Matrix = keyed(takes="a row for each parameter of covariance_of")
    dof: Matrix = keyed(takes="a number for each parameter of covariance_of")


@dataclass(frozen=True, eq=False)
class Valued:
    model: Model
    x: Array

    @cached_property
    def values(self) -> dict[str, float]:
        return dict(zip(self.model.names, map(float, self.x), strict=True))

    def x_of(self, other: Model) -> Array:
        """The values of the parameters of a model that has some of these."""
        return np.array([self.values[name] for name in other.names])

    @property
    def effects(self) -> list[str]:
        """Active effects in the catalogue's order, link weights included, the load left out."""
        spec = self.model.cell.model
        active = {choice.name for choice in spec.effects}
        if spec.link_gravity:
            active.add(LinkGravity.name)
        return [name for name in CATALOGUE if name in active]

    @property
    def elastic(self) -> bool:
        return any(CATALOGUE[name].elastic for name in self.effects)


@dataclass(frozen=True, repr=False, eq=False)
class CalibratedArm(Valued, Saved):
    """A calibrated arm: a model and the parameter values that it predicts with.

    `Calibration.arm` is one, in memory; `read_calibrated` reads one from the files of an earlier
    identification.  `compensate` commands it, `save` writes it for other programs.

    Attributes:
        model: The `Model`.
        x: Values (parameters,) in SI units.  What the data did not determine is held at the value
            the identification predicted with.
        determined: Names of the parameters that the data determined.
        covariance: (determined, determined), theirs.
        source: What it came from: the result file, or the table it was identified with.
        entries: What identify says of each parameter, as in its JSON, in the model's order.
        left: The parameters that the data left open; None in results that do not say.
        lacking: 3-D rms in m of what the model may lack, as far as the readings told.
        loads: (L, 3) N, the forces under which it was measured; none in results that do not say.
        shown: How sure the fit is where it was measured; None in results that do not say.
        visits: The joints and forces measured; None in results that do not say.
        by_prior: Those of `determined` that owe more to a prior than to the readings.
        scatter: What configurations say of them, where no known noise explains the residual.
        doubt: What identify says against its use; empty where nothing speaks against it.

    Examples:
        >>> arm = ec.identify("cell.toml", "data.csv").arm
        >>> arm.pose([0.0, -1.0, 1.0, 0.0, 0.5, 0.0], load=[0, 0, -2600]).shape
        (4, 4)
        >>> arm.values["joint3.compliance"]
        4.1...e-07
    """

    determined: tuple[str, ...]
    covariance: Array
    source: str = field(compare=False)
    entries: tuple[Mapping[str, Any], ...] = ()
    left: OpenParameters | None = None
    lacking: float = 0.0
    loads: Array = field(default_factory=lambda: np.zeros((0, 3)))
    shown: ShownPoses | None = None
    visits: MeasuredVisits | None = field(default=None, compare=False)  # rounded in files
    by_prior: tuple[str, ...] = ()
    scatter: Scatter | None = None
    doubt: str = field(default="", compare=False)

    def __repr__(self) -> str:
        return (
            f"<CalibratedArm {self.model.chain.name}: {len(self.determined)} of {len(self.x)} "
            f"parameters determined, from {self.source}>"
        )

    @property
    def of_campaigns(self) -> tuple[Array, Array]:
        """Covariance and degrees of freedom of what campaigns find: those of `scatter`, else of the
        noise model, normal where an older result states none."""
        if self.scatter is not None:
            return self.scatter.covariance, self.scatter.dof
        dof = {entry["name"]: float(entry.get("dof") or np.inf) for entry in self.entries}
        return self.covariance, np.array([dof.get(name, np.inf) for name in self.determined])

    @property
    def doubted(self) -> list[str]:
        """The same with what it is said of, as a warning beside all that is made of the arm."""
        return [f"{self.source}: {self.doubt}"] * bool(self.doubt)

    def untried(self, force: Array) -> str:
        """In words, where some of the loads (N, 3) are heavier than any measured (kept rounded)."""
        most, asked = (np.linalg.norm(f, axis=1).max(initial=0.0) for f in (self.loads, force))
        told = f"a load of {asked:.4g} N, where {most:.4g} N at most were measured: the springs are"
        told += " taken to yield alike beyond; measure under such a load"
        return told if self.elastic and len(self.loads) and most * 1.001 < asked else ""

    @checked_arguments
    def pose(self, q: ArrayLike, load: ArrayLike | None = None) -> NDArray:
        """The flange's pose in the data's frame, deflections included.

        Args:
            q: Commanded joints (joints,) or (n, joints), in rad or m.
            load: Force (3,) or (n, 3) in N at the load point, in the data's frame; default none.

        Returns:
            T_tracker_flange (4, 4), or (n, 4, 4) where q has rows; NaN without an equilibrium.

        Raises:
            InputError: A shape does not fit, or an effect needs more than joints and load.

        Examples:
            >>> arm = ec.identify("cell.toml", "data.csv").arm
            >>> q = [0.0, -1.0, 1.0, 0.0, 0.5, 0.0]
            >>> sag = arm.pose(q, load=[0, 0, -2600])[2, 3] - arm.pose(q)[2, 3]
            >>> bool(-0.01 < sag < 0)
            True
        """
        return self.model.pose(q, self.x, load)


def lasting(arm: CalibratedArm) -> tuple[CalibratedArm, tuple[str, ...]]:
    """The arm without smooth functions of the time, which are of one campaign, and their names."""
    model = arm.model
    if not (gone := [group.name for group in smooth_groups(model) if not group.lasting]):
        return arm, ()
    cell = model.cell
    for name in dict.fromkeys(choice.name for choice in cell.model.effects):
        cell = effect_of(name).lasting(cell)
    rest = Model.assembled(model.chain, cell)
    kept = [k for k, name in enumerate(arm.determined) if name in rest.names]
    entries = dict(zip(model.names, arm.entries, strict=True)) if arm.entries else {}
    return replace(
        arm, model=rest, x=arm.x_of(rest), determined=tuple(arm.determined[k] for k in kept),
        covariance=arm.covariance[np.ix_(kept, kept)],
        entries=tuple(entries[name] for name in rest.names if name in entries),
        left=None if arm.left is None else replace(arm.left, mixing=arm.left.mixing[kept]),
    ), tuple(gone)  # fmt: skip


@checked_arguments
def read_calibrated(
    cell_path: str | Path, result_path: str | Path, plugins: bool = False
) -> CalibratedArm:
    """The arm that an earlier identification wrote.

    Args:
        cell_path: The cell file that it was run with.
        result_path: Its result (`Calibration.save`, or the command identify).
        plugins: Run the plug-ins that the cell names, where its model has an effect of theirs.

    Returns:
        The `CalibratedArm`, as `fit.arm` is.

    Raises:
        InputError: A file is invalid, or the result belongs to another model than the cell
            describes; the message names the parameters that differ.

    Examples:
        >>> ec.identify("cell.toml", "data.csv").save("result.json")
        >>> ec.read_calibrated("cell.toml", "result.json")
        <CalibratedArm kuka_kr270_2: 9 of 10 parameters determined, from result.json>
    """
    cell = cell_of(cell_path, plugins or None)
    remedy = "give the file that identify wrote"
    result = read_json(result_path, "result of identify", MOST_BYTES, remedy)
    schema = result.get("schema") if isinstance(result, dict) else None
    told = f"{result_path}: schema is {quoted(schema)}, and {SCHEMA!r} is needed; {remedy}"
    require(schema == SCHEMA, told)
    try:
        stated = checked(_Result, {k: v for k, v in result.items() if v is not None}, result_path)
    except InputError as error:
        raise InputError(f"{error}; {ANEW}") from None
    held: dict[str, float] = {}
    for entry in stated.parameters:
        told = f"{result_path}: parameter '{entry.name}' is listed twice; {ANEW}"
        require(entry.name not in held, told)
        held[entry.name] = entry.held
    # A cell that lists no markers took them from the table; their names stand in the parameters.
    places = (name.rpartition(".")[0] for name in held)
    markers = (place.removeprefix("marker:") for place in places if place.startswith("marker:"))
    model = Model(cell, tuple(dict.fromkeys(markers)), plugins=plugins or None)
    _check_same(model, held, stated.nominal_flange, cell_path, result_path)
    determined = tuple(stated.covariance_of)
    n, lacking = len(determined), (stated.predicted_new_poses_um or {}).get("lack_of_fit", 0.0)
    size, scatter = stated.covariance.size, stated.scatter
    told = f"{result_path}: covariance of {size} numbers for {n} names in covariance_of; {ANEW}"
    require(set(determined) <= set(held) and size == n**2, told)
    alike = scatter is None or (*scatter.covariance.shape, *scatter.dof.shape) == (n, n, n)
    require(alike, f"{result_path}: scatter is not of the names in covariance_of; {ANEW}")
    entries, visits = {e["name"]: e for e in result["parameters"]}, stated.measured_visits
    shape = None if visits is None else (len(visits.force), model.chain.n_joints)
    return CalibratedArm(
        model, np.array([held[name] for name in model.names]), determined,
        stated.covariance.reshape(n, n), str(result_path),
        tuple(entries[name] for name in model.names),
        _left_open(stated.open, model, determined, result_path),
        float(lacking if is_number(lacking) else 0.0) * 1e-6, stated.loads_N.reshape(-1, 3),
        stated.measured_poses,
        visits if visits is not None and len(visits.q) and visits.q.shape == shape else None,
        mostly_prior(stated.prior_share or {}), scatter,
        str((stated.verdict or {}).get("doubt") or ""),
    )  # fmt: skip


MOSTLY = 0.5  # share of its information from which an estimate owes more to the prior


def mostly_prior(shares: Mapping[str, float | None]) -> tuple[str, ...]:
    """Of the estimates with these shares of information by a prior those that owe it more, the
    largest share first; null or NaN where constraints fix a value."""
    known = {name: share for name, share in shares.items() if share is not None and share > MOSTLY}
    return tuple(sorted(known, key=lambda name: -known[name]))


NONE = np.zeros(0)


class _Entry(Table, extra="ignore"):
    name: str = key("a name", ...)
    held: float = key("a number", ...)
    dof: float | None = key("a number")
    combined_with: list[str] | None = key("a list of names")


class _Result(Table, extra="ignore"):
    parameters: list[_Entry] = key("a list of parameters", ...)
    nominal_flange: Annotated[Array, _array(4)] | None = key("3 rows of 4 numbers")
    covariance_of: list[str] = key("a list of names", [])
    covariance: Matrix = key("a square table of finite numbers", NONE)
    open: OpenParameters | None = key("a table of the parameters left open")
    predicted_new_poses_um: dict[str, Any] | None = key("a table")
    loads_N: Triples = key("a list of forces, three numbers each", NONE)
    measured_poses: ShownPoses | None = key("a table")
    measured_visits: MeasuredVisits | None = key("a table")
    prior_share: dict[str, float | None] | None = key("a table of shares")
    scatter: Scatter | None = key("a table")
    verdict: dict[str, Any] | None = key("a table")


def nominal_flange_rows(chain: Chain) -> list[list[float]]:
    """Upper rows (3, 4) of T_base_flange of the nominal arm, all joints at 0.5 rad or 0.5 m: it
    tells a result from that of another robot whose parameters have the same names."""
    (T,) = rigid.nominal_flanges(chain, np.full((1, chain.n_joints), 0.5))
    return [[round(float(v), 9) + 0.0 for v in row] for row in T[:3]]


def _left_open(
    stated: OpenParameters | None, model: Model, determined: tuple[str, ...], path: str | Path
) -> OpenParameters:
    """What the result says of the parameters that the data left open; where it says nothing, each
    that was not determined counts by itself."""
    if stated is None:
        rest = [p for p in model.parameters if p.name not in determined and not p.shrunk]
        typical = np.array([p.typical or abs(p.nominal) for p in rest])
        none = np.zeros((len(determined), len(rest)))
        return OpenParameters(tuple(p.name for p in rest), none, typical)
    shape = len(determined), len(stated.names)
    require(
        set(stated.names) <= set(model.names)
        and (stated.mixing.size, stated.typical.size) == (shape[0] * shape[1], shape[1])
        and bool(np.isfinite([*stated.mixing.flat, *stated.typical.flat]).all()),
        f"{path}: open does not say names, typical sizes and shares of the parameters left open; "
        f"{ANEW}",
    )
    mixing, typical = stated.mixing.reshape(shape), stated.typical.ravel()
    return replace(stated, mixing=mixing, typical=typical)


def _check_same(
    model: Model, held: Mapping[str, float], stated: Array | None, cell: str | Path,
    result: str | Path,
) -> None:  # fmt: skip
    absent = [name for name in model.names if name not in held]
    surplus = [name for name in held if name not in set(model.names)]
    both = ("the result lacks", absent), ("the cell has no", surplus)
    told = [f"{what} {listed(names, 4)}" for what, names in both if names]
    here, remedy = np.array(nominal_flange_rows(model.chain)), ""
    if not told and stated is not None:
        require(stated.shape == here.shape, f"{result}: nominal_flange takes 3 rows; {ANEW}")
        off = rounded(float(np.linalg.norm((here - stated)[:, 3])) * 1e3, 4)
        away = f"with every joint at 0.5 rad the flange is {off} mm away"
        told = [f"the nominal robot is another one ({away})"]
        told, remedy = told * bool(np.abs(here - stated).max() > SAME), ", or identify anew"
    why = f"{'; '.join(told)}; give the cell that identify was run with{remedy}"
    require(not told, f"{result} was not identified with {cell}: {why}")


RECORDED = {"torque": "recorded torques"}  # what an effect needs and only a table has


@dataclass(frozen=True)
class Conditions:
    """What the arm is compared under: force (3,) N in the tracker frame at the load point, time in
    s and temperature in °C of the table's columns (None: not stated).  With `visits` poses are
    those within their joints' ranges, and forces theirs."""

    force: Array = field(default_factory=lambda: np.zeros(3))
    time: float | None = None
    temperature: float | None = None
    visits: MeasuredVisits | None = field(default=None, compare=False)  # rounded in files


def unstated_needs(calibrated: CalibratedArm, conditions: Conditions) -> dict[str, list[str]]:
    """By effect of the arm itself what it needs and the conditions do not state."""
    return {
        name: [need for need in CATALOGUE[name].needed(calibrated.model.cell)
               if need in RECORDED or getattr(conditions, need, 0.0) is None]
        for name in calibrated.effects if not CATALOGUE[name].of_the_measurement
    }  # fmt: skip


def arm_with(calibrated: CalibratedArm, names: Collection[str]) -> Valued:
    spec = calibrated.model.cell.model
    spec = replace(
        spec, effects=tuple(choice for choice in spec.effects if choice.name in names),
        link_gravity=spec.link_gravity and LinkGravity.name in names, observe="position",
        torque="computed",
    )  # fmt: skip
    model = calibrated.model.specified(spec)
    return Valued(model, calibrated.x_of(model))


def random_table(model: Model, conditions: Conditions, poses: int, seed: int) -> Measurements:
    cell, chain, visits = model.cell, model.chain, conditions.visits
    rng = np.random.default_rng(seed)
    low, high = finite_ranges(chain, *joint_limits(cell, chain))
    force = conditions.force
    if visits is not None:
        low, high = np.clip([visits.q.min(axis=0), visits.q.max(axis=0)], low, high)
        force = visits.force[np.arange(poses) % len(visits.force)]
    q = rng.uniform(low, high, (poses, chain.n_joints))
    for joint, levels in cell.model.compliance_levels.items():
        q[:, joint_index(joint)] = rng.choice(levels, poses)
    return table_at(model, conditions, q, force, rng)


def table_at(
    model: Model, conditions: Conditions, q: Array, force: Array, rng: np.random.Generator
) -> Measurements:
    """The poses q (poses, joints) under `force` (3,) or (poses, 3) N; the last motions are drawn,
    whatever the order of the poses."""
    cell, poses, side = model.cell, len(q), rng.choice([-1.0, 1.0], q.shape)
    stated = {"time": conditions.time, "temperature": conditions.temperature}
    more: dict[str, Any] = {k: np.full(poses, v) for k, v in stated.items() if v is not None}
    return Measurements.of_poses(
        "random poses", q, force, marker_names=tuple(cell.tool.markers)[:1],
        approach=side, direction=side, move=side * rng.uniform(0.1, 1.0, q.shape), **more,
    )  # fmt: skip


@dataclass(frozen=True)
class ToolPoint:
    """`place` (3,) m in the flange frame; with `marker`, the identified place of that marker."""

    place: Array
    marker: str | None
    told: str


def tool_point(cell: Cell, text: str | None) -> ToolPoint:
    """The point that `text` names: a marker, or "x,y,z" in m in the flange frame; without a text
    the cell's `load_point_m`, else its only marker."""
    markers = cell.tool.markers
    if text is None:
        if cell.tool.load_point.any():
            return ToolPoint(cell.tool.load_point, None, "load point")
        require(
            len(markers) == 1,
            f"{cell.source}: which point of the tool is to be at the targets? Give "
            f"{option('point')} with a marker ({listed(markers)}) or with x,y,z in m in the flange "
            "frame, or state [tool] load_point_m",
        )
        text = next(iter(markers))
    if text in markers:
        return ToolPoint(markers[text], text, f"marker {text}")
    here, what = f"{option('point')}: '{text}'", "x,y,z in m in the flange frame"
    if "," not in text:
        hint = f"{did_you_mean(text, markers)}; its markers: {listed(markers)}; or give {what}"
        raise InputError(f"{here} is no marker of the cell{hint}")
    place = numbers(option("point"), text, (3,), what)
    require(np.abs(place).max() <= 10, f"{here} is more than 10 m from the flange; give x,y,z in m")
    return ToolPoint(place, None, f"point {text} m in the flange frame")


def numbers(option: str, text: str, counts: tuple[int, ...], what: str) -> Array:
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        values = np.full(1, np.nan)
    good = len(values) in counts and np.isfinite(values).all()
    require(good, f"{option} takes {what}; found '{text}'")
    return values


class CalibratedTool:
    """p(q) and R(q) of the tool's point, at `point` on the tool of the calibrated arm, in the
    data's frame, at the static equilibrium.  What the instrument itself distorts
    (`tracker_distortion`) is no part of where the tool is."""

    def __init__(self, arm: CalibratedArm, point: ToolPoint) -> None:
        self.calibrated, self.point = arm, point
        self.chain, self.cell = arm.model.chain, arm.model.cell
        self.x = arm.x
        self._symbolic = arm.model.symbolic
        own = self._symbolic.arm
        if point.marker is None:
            place, turn = rigid.constant(point.place), ca.SX.eye(3)
        else:
            place, turn = own.markers[point.marker], own.marker_rotation[point.marker]
        position, p, q = rigid.point(own.T_tracker_flange, place), self._symbolic.p, own.q_commanded
        rotation, turned = own.T_tracker_flange[:3, :3] @ turn, ca.SX.sym("turned", 9)
        y = ca.vertcat(position, ca.vec(rotation))
        self._pose = Total(self._symbolic, y, ca.SX.zeros(0, 1))
        self._sensitivity = Total(self._symbolic, position, p)
        tilt = rigid.vector_from_rotation(ca.reshape(turned, 3, 3).T @ rotation)
        y = ca.vertcat(position, rigid.ARM_LENGTH * tilt)
        self._placing = Total(self._symbolic, position, q)
        self._turning = Total(self._symbolic, y, q, (turned,))
        self._tilting = Total(self._symbolic, tilt, p, (turned,))
        frames = [own.T_tracker_base, rigid.transform(turn, place)]
        self._frames = BatchFunction([*own.inputs.values(), p], frames, self._symbolic.backend)

    def rows(self, table: Measurements) -> list[NDArray]:
        """What the model asks of the table's rows, one array per input; joints are put in later."""
        n = len(table)
        levels = self.cell.model.compliance_levels
        q = np.zeros((n, self.chain.n_joints))
        for name, values in levels.items():
            # Any level will do here: `_at` says how the commanded joint stands between them.
            q[:, joint_index(name)] = values[0]
        names = tuple(self._symbolic.arm.markers)
        bare = replace(
            table, q=q, marker=np.zeros(n, dtype=np.int64), marker_names=names[:1],
            rotation=np.zeros((n, 3)), position=None,
        )  # fmt: skip
        return row_inputs(self._symbolic.arm, bare)

    def _at(self, rows: list[NDArray], q: Array) -> list[NDArray]:
        found = dict(zip(self._symbolic.arm.inputs, rows, strict=True)) | {"q": q}
        # A level stands for a gravity compensator's effect, which is a smooth function of the joint
        # (Klimchik et al. 2013, section 5): linear between neighbouring levels, and beyond them the
        # outermost one's.
        for joint, stated in self.cell.model.compliance_levels.items():
            if f"level:{joint}" in found:
                levels, angle = np.sort(stated), q[:, joint_index(joint)]
                hats = np.eye(len(stated))[:, np.argsort(stated)]
                shares = [np.interp(angle, levels, hat) for hat in hats]
                found[f"level:{joint}"] = np.column_stack(shares)
        return list(found.values())

    def poses(self, rows: list[NDArray], q: Array) -> tuple[Array, Array]:
        """Position (n, 3) m and rotation (n, 3, 3) of the tool; NaN without an equilibrium."""
        y = self._pose(self._at(rows, q), self.x)[0]
        return y[:, :3], y[:, 3:].reshape(-1, 3, 3).transpose(0, 2, 1)

    def sensitivity(self, rows: list[NDArray], q: Array, turns: bool = False) -> Array:
        """A (n, 3, parameters) = d(position)/dX in m per unit, at commanded joints q; `turns`: that
        of the rotation in rad."""
        if not turns:
            return self._sensitivity(self._at(rows, q), self.x)[1]
        turned = self.poses(rows, q)[1].transpose(0, 2, 1).reshape(-1, 9)
        return self._tilting(self._at(rows, q), self.x, [turned])[1]

    def errors(
        self, rows: list[NDArray], q: Array, position: Array, rotation: Array | None
    ) -> tuple[Array, Array]:
        """r (n, 3 or 6) in m and dr/dq: p(q) − p*, and rotation vector of R*ᵀR(q) × ARM_LENGTH, of
        `position` (n, 3) m and `rotation` (n, 3, 3), or None for any, in the data's frame."""
        if rotation is None:
            r, slope = self._placing(self._at(rows, q), self.x)
        else:
            turned = rotation.transpose(0, 2, 1).reshape(-1, 9)
            r, slope = self._turning(self._at(rows, q), self.x, [turned])
        r[:, :3] -= position
        return r, slope

    def frames(self, rows: list[NDArray]) -> list[Array]:
        """T_tracker_base (n, 4, 4) as identified, with the drift that the rows' time asks for, and
        T_flange_tool (n, 4, 4).  What moves them with the joints' angles is an error of the arm and
        no part of the frames."""
        x = self.x.copy()
        for group in smooth_groups(self.calibrated.model):
            if group.follows and group.lasting:
                x[group.columns] = 0.0
        return self._frames(*rows, x)
