"""What the user measured: a checked, frozen table in SI units, its columns, reader and writer.

Beside it, what the noise that is stated for the table or its tracker means for each reading.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from elastocal import tables
from elastocal.above import DataFrame, Result, checked_arguments
from elastocal.files import atomic_writer, open_input, read_text
from elastocal.messages import (
    InputError,
    check_known,
    is_label,
    listed,
    option,
    quoted,
    require,
    rounded,
)
from elastocal.tables import NO_UNIT, Columns, Family, Labels, RawTable, column
from elastocal.units import ANGLE, LENGTH, TIME, Array, BoolArray, IntArray

SI_UNITS = ("m", "rad", "s", "N", "Nm", "C", "")
REQUIRED: dict[str, tuple[tuple[str, ...], ...]] = {
    "position": (("position",),),
    "deflection": (("position",),),
    "pose": (("position",), ("rotation", "quaternion")),
    "distance": (("distance",),),
    "plan": (),
    "targets": (),
}
EXCLUSIVE = (("sigma_cartesian", "sigma_polar"), ("rotation", "quaternion"))
NUMBERED = re.compile(r"(q|torque_|approach_|before_)([1-9][0-9]{0,3})(_[a-zA-Z]+)?", re.ASCII)
PLANS = ("plan", "targets")
PLAN_ONLY = ("level", "order")
# What `compensate` writes beside its commands, which are a plan too.
BESIDE_COMMANDS = ("correction_", "error_", "std_", "within95_", "status")
SINGLE = ("distance", "time", "temperature")  # one number in a row
WHOLE = ("position", "torque", "approach", "before")  # as they stand in the file
DEFAULT_MARKER = "M1"
LEAST_FORCE, LARGEST_FORCE = 1e-6, 1e7  # N
QUATERNION_NORM_TOLERANCE = 1e-3
LARGEST_EXACT_INTEGER = 2.0**53
AT_A_TIME = 50_000  # rows


@dataclass(frozen=True, repr=False, eq=False)
class Measurements(Result):
    """n rows: one per pose, load state, repeat and marker.

    Attributes:
        source: The file's name; `row` (n,) the lines in it, for messages.
        q: Commanded joints (n, joints), in rad or m.
        configuration: Codes (n,) into `configuration_labels`.
        repeat: Number (n,) of the repeat.
        marker: Codes (n,) into `marker_names`.
        force: (n, 3) in N at the load point, in the tracker's frame (z vertical).
        position: (n, 3) in m, in the tracker's frame.
        rotation: Rotation vectors (n, 3) in rad.
        distance: (n,) in m.
        torque: (n, joints) in N m.
        sigma: (n, 3) in m, along what `sigma_frame` says: "cartesian" (x, y, z) or "polar" (range,
            azimuth, elevation, as transverse lengths).
        time: (n,) in s.
        approach: Sides (n, joints) from which joints came, -1, 0 or +1.
        before: Commanded joints (n, joints) of the pose before.
        temperature: (n,) in °C.
        move: Way (n, joints) from the visit before.  No column: found when a table is read, from
            `before` or the order of the visits.
        direction: Sign (n, joints) of each joint's last motion, found likewise.
        joint_kinds: "revolute" or "prismatic" for each joint; none are all revolute.

    Examples:
        >>> data = ec.Model("cell.toml").read("data.csv")
        >>> data
        <Measurements data.csv: 540 rows, 15 configurations, markers M1, M2, M3>
        >>> data.take(data.configuration == 0).position.shape
        (36, 3)
    """

    source: str = field(compare=False)
    row: IntArray = field(compare=False)
    q: Array
    configuration: IntArray
    configuration_labels: tuple[str, ...]
    repeat: IntArray
    marker: IntArray
    marker_names: tuple[str, ...]
    force: Array
    position: Array | None = None
    rotation: Array | None = None
    distance: Array | None = None
    torque: Array | None = None
    sigma: Array | None = None
    sigma_frame: str = "cartesian"
    time: Array | None = None
    approach: Array | None = None
    before: Array | None = None
    temperature: Array | None = None
    move: Array | None = None
    direction: Array | None = None
    joint_kinds: tuple[str, ...] = ()

    @classmethod
    def of_poses(
        cls, source: str, q: Array, force: Array, marker: str = DEFAULT_MARKER, /, **more: Any
    ) -> Measurements:
        """Rows of which only joints and force (n, 3) or (3,) are stated: a configuration for each
        row of q, its one marker; `more` are other columns, and these where they are known."""
        n = len(q)
        known: dict[str, Any] = dict(
            row=np.arange(1, n + 1),
            configuration=np.arange(n),
            configuration_labels=tuple(map(str, range(1, n + 1))),
            repeat=np.zeros(n, dtype=np.int64),
            marker=np.zeros(n, dtype=np.int64),
            marker_names=(marker,),
            force=np.broadcast_to(force, (n, 3)).copy(),
        )
        return cls(source=source, q=q, **(known | more))

    def __len__(self) -> int:
        return len(self.row)

    def _compared(self) -> Mapping[str, Any]:
        return self.columns() | {"": self.kinds}

    def __hash__(self) -> int:
        return hash((len(self), self.q.shape[1], self.marker_names[:1]))

    def __repr__(self) -> str:
        said = f"{len(self)} rows, {len(self.configuration_labels)} configurations"
        return f"<Measurements {self.source}: {said}, markers {', '.join(self.markers_read)}>"

    @property
    def markers_read(self) -> tuple[str, ...]:
        return tuple(self.marker_names[k] for k in np.unique(self.marker))

    @property
    def kinds(self) -> tuple[str, ...]:
        return self.joint_kinds or ("revolute",) * self.q.shape[1]

    def to_dataframe(self) -> DataFrame:
        """The table with the columns of the canonical CSV, one row per reading, in SI units."""
        import pandas as pd

        return pd.DataFrame(self.columns(), copy=False)

    def columns(self) -> dict[str, np.ndarray]:
        """The same as header → (n,) numbers or labels."""
        columns: dict[str, np.ndarray] = {
            "configuration": np.array(self.configuration_labels, dtype=object)[self.configuration],
            "marker": np.array(self.marker_names, dtype=object)[self.marker],
        }
        for family in families(self.kinds).values():
            name, _, frame = family.name.partition("_")  # sigma_polar
            values, stems = getattr(self, name, None), family.units
            if family.is_label or values is None or frame not in ("", self.sigma_frame):
                continue
            if name == "approach":
                values = values.astype(np.int64)
            for stem, numbers in zip(stems, values.reshape(len(self), len(stems)).T, strict=True):
                unit = next(unit for unit in SI_UNITS if unit in stems[stem])
                columns[column(stem, unit)] = numbers
        return columns

    def _repr_html_(self) -> str:
        return str(self.to_dataframe()._repr_html_())

    def take(self, index: NDArray | slice) -> Measurements:
        """The rows `index` (integers, mask or slice) as a table of their own; labels are kept.

        Examples:
            >>> data = ec.Model("cell.toml").read("data.csv")
            >>> data.take(data.marker == 0)
            <Measurements data.csv: 180 rows, 15 configurations, markers M1>
        """
        try:
            one = np.ndim(np.arange(len(self))[index]) != 1
        except IndexError:
            one = True
        require(
            not one,
            f"rows are taken by a mask or a slice of {len(self)} rows, or by a list of their "
            f"numbers from 0; found {quoted(index)}",
        )
        held: dict[str, Any] = {k: v for k, v in vars(self).items() if isinstance(v, np.ndarray)}
        return replace(self, **{name: values[index] for name, values in held.items()})

    def from_neither_side(self) -> Measurements:
        """The table of a session that is not the one fitted: how the arm came to the first visit of
        that, where `direction` is 0, is of no other one."""
        side = self.direction
        return self if side is None else replace(self, direction=np.where(side == 0, NEITHER, side))

    __getitem__ = take  # data[data.marker == 0], data[:90]
    __iter__ = None  # rows have no form of their own


@checked_arguments
def table(
    q: ArrayLike,
    position: ArrayLike | None = None,
    force: ArrayLike | None = None,
    marker: str | Sequence[str] = DEFAULT_MARKER,
    joint_kinds: Sequence[str] = (),
) -> Measurements:
    """Readings that no file states, as a table for the verbs.

    Rows with the same joints are of one configuration; those of the same marker and force there
    are its repeats.

    Args:
        q: Commanded joints (n, joints), in rad or m.
        position: Measured positions (n, 3) in m in the tracker's frame (z vertical).
        force: Forces (n, 3), or (3,) for all rows, in N at the load point; default none.
        marker: The marker of each row, or the one of all.
        joint_kinds: "revolute" or "prismatic" for each joint; none are all revolute.

    Returns:
        The `Measurements`.

    Raises:
        InputError: A shape does not fit; the message names the argument.

    Examples:
        >>> exact = ec.simulate("cell.toml", "plan.csv", noise=False)
        >>> names = [exact.marker_names[k] for k in exact.marker]
        >>> ec.table(exact.q, exact.position, exact.force, marker=names)
        <Measurements table: 45 rows, 15 configurations, markers M1, M2, M3>
    """
    joints = np.array(np.atleast_2d(q), dtype=float)  # what the caller does to q is not ours
    n = len(joints)
    names = [marker] * n if isinstance(marker, str) else list(marker)
    kinds = tuple(joint_kinds)
    pulls = np.zeros((n, 3)) if force is None else np.array(force, dtype=float)
    places = None if position is None else np.array(np.atleast_2d(position), dtype=float)
    for name, given, shapes in (
        ("q", joints, [(n, joints.shape[1])] if joints.size else []),
        ("position", places, [(n, 3)]),
        ("force", pulls, [(n, 3), (3,)]),
        ("marker", np.array(names), [(n,)]),
        ("joint_kinds", np.array(kinds), [(0,), (joints.shape[1],)]),
    ):
        told = f"{option(name)} takes a value for each row of q ({n} joints)"
        if given is not None and given.shape not in shapes:
            raise InputError(f"{told}; found an array of shape {given.shape}")
    configuration, markers = Labels.of(map(tuple, joints.tolist())), Labels.of(names)
    pulls = np.broadcast_to(pulls, (n, 3))
    alike = numbered(configuration.codes, markers.codes, load_states(pulls))
    order = np.argsort(alike, kind="stable")
    repeat = np.empty(n, dtype=np.int64)
    repeat[order] = np.arange(n) - np.searchsorted(alike[order], alike[order])
    return with_moves(Measurements.of_poses(
        "table", joints, pulls, position=places, joint_kinds=kinds, repeat=repeat,
        configuration=configuration.codes, marker=markers.codes, marker_names=markers.names,
        configuration_labels=tuple(map(str, range(1, len(configuration.names) + 1))),
    ))  # fmt: skip


# Visits, and the moves between them

STILL = 1e-4  # rad or m; a joint that moved by less has stayed where it was


def numbered(*columns: NDArray[Any]) -> IntArray:
    """Number (n,) of each row's combination of values in the `columns` (n,), in their order."""
    order = np.lexsort(columns[::-1])
    new = np.zeros(len(order), dtype=bool)
    for values in columns:
        new[1:] |= values[order[1:]] != values[order[:-1]]
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.cumsum(new)
    return number


def load_states(force: Array) -> IntArray:
    """Of forces (n, 3) in N, alike to a µN."""
    with np.errstate(over="ignore"):  # of forces beyond all measure
        return numbered(*np.round(force, 6).T)


def visits(table: Measurements) -> IntArray:
    """Number (n,) of each row's visit: its configuration, repeat and force.  Between readings that
    others part in the table and in time, as where one reflector is carried from marker to marker,
    the arm has been elsewhere: those are several."""
    number = numbered(table.configuration, table.repeat, load_states(table.force))
    by_row, run = np.argsort(table.row, kind="stable"), np.zeros(len(table), dtype=np.int64)
    run[by_row[1:]] = np.cumsum(np.diff(number[by_row]) != 0)
    if table.time is None or run.max(initial=0) == number.max(initial=0):
        return number
    order, time = np.lexsort((table.time, number)), np.sort(table.time)
    a, b = order[:-1], order[1:]
    others = np.searchsorted(time, table.time[b]) > np.searchsorted(time, table.time[a], "right")
    apart = (run[a] != run[b]) & others
    run[order] = np.append(0, np.cumsum(apart))
    return numbered(number, run)


def first_of_visit(table: Measurements) -> IntArray:
    """Where in the table (n,) each row's visit begins."""
    visit = visits(table)
    return np.unique(visit, return_index=True)[1][visit]


def with_moves(table: Measurements) -> Measurements:
    """The table with the way the arm came to each visit, by the order of its visits.  `move` (n,
    joints) is the commanded q of the visit minus that of the visit before, in rad or m: by the
    columns `before_1 …` where they are recorded, else with the visits in order of time, or of the
    rows where there is none, which is an assumption (`order_contradicted`).  A visit that moved no
    joint keeps the move before it, and the first has none.  `direction` (n, joints) is the sign of
    each joint's own last motion, 0 where it has not moved yet."""
    n = len(table)
    if n == 0 or table.q.shape[1] == 0:
        return replace(table, move=None, direction=None)
    order = np.arange(n) if table.time is None else np.argsort(table.time, kind="stable")
    number = visits(table)
    begun = np.unique(number[order], return_index=True)[1]
    first = order[np.sort(begun)]  # the row of each visit in their sequence
    q = table.q[first]
    if table.before is not None:
        step = q - table.before[first]
    else:
        step = np.diff(q, axis=0, prepend=q[:1])
    step[np.abs(step) <= STILL] = 0.0
    visit = np.arange(len(step))
    last, own = visit, np.tile(visit[:, None], q.shape[1])
    if table.before is None:
        last = np.maximum.accumulate(np.where(step.any(axis=1), visit, 0))
        own = np.maximum.accumulate(np.where(step != 0, visit[:, None], 0), axis=0)
    place = np.argsort(np.argsort(begun))[number]
    direction = np.sign(np.take_along_axis(step, own, axis=0))
    return replace(table, move=step[last][place], direction=direction[place])


NEVER_YET = 1e15  # as the line of a table: after all that were measured
NEITHER = 1e-12  # the side that a joint came from where no move of it is known; 0 is a first visit


def by_rows(table: Measurements) -> Array:
    """The line (n,) at which each row's visit begins, for want of a time; after all lines of a
    campaign where the table has no readings, as poses have that the arm is still to visit."""
    if table.distance is None and (table.position is None or not table.position.any()):
        return np.full(len(table), NEVER_YET)
    return table.row[first_of_visit(table)].astype(np.float64)


FOLLOWING = 3.3  # standard deviations of chance: one joint in a thousand


def poses_in_turn(table: Measurements) -> Array:
    """Joint values (n, joints) of the poses in the order of the rows; what only load, marker or
    repeat tell apart counts once."""
    moves = np.abs(np.diff(table.q, axis=0)).max(axis=1, initial=0.0) > 0
    return table.q[np.append(True, moves)[: len(table)]]


def in_any_order(table: Measurements) -> bool:
    """Whether no joint's value goes with the row: where it does (a grid, a sorted table), what
    changes between rows is not to be told from what depends on the pose.  The correlation of
    successive poses' values; √n ρ is N(0, 1) in random order."""
    q = poses_in_turn(table)
    q = q - q.mean(axis=0)
    square = (q**2).sum(axis=0)
    moved = square > 0
    along = (q[1:] * q[:-1]).sum(axis=0)[moved] / square[moved]
    return bool((np.abs(along) * np.sqrt(len(q)) < FOLLOWING).all())


STEPS = [(10.0**-k, unit) for k in range(5) for unit in ("°", " rad")]
FEWEST_VALUES = 8  # of a finer step all are on a coarser one with a chance of 10 to the minus that


def rounded_joints(table: Measurements, turning: BoolArray) -> tuple[float, str] | None:
    """The standard deviation (rad) that rounding gives each of the `turning` joints' values, a
    step over √12, and the coarsest decimal step that they are on; None where they are on none."""
    q = table.q[:, turning]
    if not q.size or max(len(np.unique(column)) for column in q.T) < FEWEST_VALUES:
        return None
    for step, unit in STEPS:
        steps = (np.degrees(q) if unit == "°" else q) / step
        if np.abs(steps - np.round(steps)).max() < 1e-6:
            size = np.radians(step) if unit == "°" else step
            return float(size / np.sqrt(12)), f"{step:g}{unit}"
    return None


def told_of_rounding(table: Measurements, turning: BoolArray, scatter: Array) -> str | None:
    """That joint values were rounded, where that is as much as the joints scatter by (k,)."""
    found = rounded_joints(table, turning)
    if found is None or not found[0] / 2 < np.sqrt(np.mean(np.square(scatter))) < 2 * found[0]:
        return None
    return (
        f"The joint values are rounded to {found[1]}, {rounded(found[0] * 1e6)} µrad rms, which is "
        "what the joints seem to scatter by: record them with more decimals."
    )


DAY = 86_400.0  # s


def past_midnight(table: Measurements) -> list[str]:
    """That times which ascend fall back once by half a day or more, as those of a clock do."""
    fall = -np.diff([] if table.time is None else table.time)
    back = np.flatnonzero(fall > 0)
    if len(back) != 1 or not DAY / 2 < fall[back[0]] < DAY:
        return []
    return [
        f"{table.source}: the times fall back by {fall[back[0]] / 3600:.3g} h at line "
        f"{table.row[back[0] + 1]}, as a clock's do at midnight: add {DAY:g} s from there on, as "
        "drifts and jumps are looked for in the order of the times"
    ]


# Share of the visits at which a joint that came from one side, by the order of the visits, was
# recorded as come from there: fewer, beyond chance, and the order is not that of the campaign.
AGREEING, BEYOND_CHANCE = 0.9, 1e-3


def order_contradicted(table: Measurements) -> str | None:
    """That the recorded sides (`approach_1 …`) are not those of the order of the visits, where it
    is so: a table that was split, sorted or thinned, or poses that were overshot."""
    if table.approach is None or table.before is not None:
        return None
    found = with_moves(table).direction if table.direction is None else table.direction
    if found is None:
        return None
    first = np.unique(first_of_visit(table))
    recorded, ordered = np.sign(table.approach[first]), np.sign(found[first])
    told = (recorded != 0) & (ordered != 0)
    if not told.any():
        return None
    share = float((recorded[told] == ordered[told]).mean())
    # The joints of a visit agree or not together.
    n = int(told.any(axis=1).sum())
    from scipy.special import bdtr  # slow to import, seldom asked for

    if bdtr(round(share * n), n, AGREEING) > BEYOND_CHANCE:
        return None
    return (
        f"{table.source}: from which side the joints came, by approach_1 …, is in {share:.0%} of "
        "the visits what the order of the rows says: the order is not that of the campaign"
    )


def families(joint_kinds: Sequence[str]) -> dict[str, Family]:
    numbered = list(enumerate(joint_kinds, start=1))

    def per_joint(stem: str, revolute: tuple[str, ...], prismatic: tuple[str, ...]) -> dict:
        return {
            f"{stem}{i}": prismatic if kind == "prismatic" else revolute for i, kind in numbered
        }

    sigma, cartesian = ("um", "mm", "m"), ("sigma_x", "sigma_y", "sigma_z")
    polar = ("sigma_range", "sigma_azimuth", "sigma_elevation")
    same = dict.fromkeys
    known = (
        Family("configuration", "configuration", {"configuration": NO_UNIT}, is_label=True),
        Family("repeat", "repeat", {"repeat": NO_UNIT}),
        Family("marker", "marker", {"marker": NO_UNIT}, is_label=True),
        Family("q", f"positions of the {len(numbered)} joints", per_joint("q", ANGLE, LENGTH[:2])),
        Family("force", "forces", same(("force_x", "force_y", "force_z"), ("N",))),
        Family("position", "positions", same("xyz", LENGTH)),
        Family("rotation", "rotation vector", same(("rx", "ry", "rz"), ANGLE)),
        Family("quaternion", "quaternion", same(("qw", "qx", "qy", "qz"), NO_UNIT)),
        Family("distance", "distances", {"distance": LENGTH[:2]}),
        Family("torque", "joint torques", per_joint("torque_", ("Nm",), ("N",))),
        Family("sigma_cartesian", "Cartesian sigmas", same(cartesian, sigma)),
        Family("sigma_polar", "polar sigmas", same(polar, sigma)),
        Family("time", "time", {"time": TIME}),
        Family("approach", "approach directions", per_joint("approach_", NO_UNIT, NO_UNIT)),
        Family("before", "joints of the pose before", per_joint("before_", ANGLE, LENGTH[:2])),
        Family("temperature", "temperature", {"temperature": ("C",)}),
    )
    return {family.name: family for family in known}


def in_file_units(values: Array, kinds: Sequence[str]) -> Array:
    """Joints (…, n) in rad or m as files have them: degrees, and mm of a prismatic joint."""
    return values * np.where([kind == "revolute" for kind in kinds], 180 / np.pi, 1e3)


def joint_columns(kinds: Sequence[str], before: str = "") -> list[str]:
    """q1_deg …, q3_mm for a prismatic joint, each after `before`."""
    units = ["deg" if kind == "revolute" else "mm" for kind in kinds]
    return [column(f"{before}q{i}", unit) for i, unit in enumerate(units, start=1)]


def columns_of(
    source: str, header: Sequence[str], joint_kinds: Sequence[str], observe: str,
    extra: Sequence[Family] = (),
) -> Columns:  # fmt: skip
    """What the columns of a table mean; `observe` decides what must be there, `extra` are families
    that this table may have besides."""
    known = families(joint_kinds) | {family.name: family for family in extra}
    joints = [("q",)] if joint_kinds and observe != "targets" else []
    what = "a plan" if observe in PLANS else f'observe = "{observe}" in the cell file'
    return tables.match_columns(
        source, header, known, (*joints, *REQUIRED[observe]), f"{what} needs", EXCLUSIVE,
        lambda text: observe in PLANS and (text in PLAN_ONLY or text.startswith(BESIDE_COMMANDS)),
        lambda text: _wrong_joint(text, known),
    )  # fmt: skip


def _wrong_joint(text: str, known: Mapping[str, Family]) -> str | None:
    numbered = NUMBERED.fullmatch(text)
    if not numbered or any(numbered[1] + numbered[2] in f.units for f in known.values()):
        return None
    n = len(known["q"].units)
    told = f"column {quoted(text)} is of joint {numbered[2]}, but the robot has {n} joints"
    return f"{told}; drop it, or use the cell of the right robot"


READING = re.compile("[xyz]_|d[xyz]_|dist")  # headers of what is measured


def read_measurements(
    path: str | Path | DataFrame, *, joint_kinds: tuple[str, ...],
    marker_names: tuple[str, ...] = (), observe: str = "position", text: str | None = None,
) -> Measurements:  # fmt: skip
    """The measurements of a CSV or Parquet (.parquet, .pq) file or a data frame, in SI units.

    `joint_kinds`: "revolute" or "prismatic" per joint of the robot; `marker_names`: the cell's
    markers, () if it names none; `observe`: "position", "deflection", "pose" or "distance",
    which decides the columns that must be there, or "plan" or "targets", which ask for none; of a
    plan `level` and `order`, which a designed one has, are passed over.
    Quaternions become rotation vectors.  With `text` the table is that CSV text, and `path` only
    its name.
    """
    if not isinstance(path, str | Path):
        text, path = path.to_csv(index=any(path.index.names)), "DataFrame"

    def choose(header: Sequence[str]) -> Columns:
        planned = {"configuration", "level", "order"} <= set(header)
        if planned and observe not in ("plan", "targets") and not any(map(READING.match, header)):
            raise InputError(
                f"{path}: this is a plan, which has no readings yet; give the measurements of its "
                f"poses (a new plan takes poses of this one by {option('keep')})"
            )
        return columns_of(str(path), header, joint_kinds, observe)

    raw = tables.read_table(path, choose, text=text)
    numeric = (name for name, own in raw.columns.items() if not own[0].is_label)
    found = {name: values for name in numeric if (values := raw.si(name)) is not None}
    for name, (good, rule) in RULES.items():
        if name in found:
            raw.check(name, good(found[name]), rule)
    # A plan without the column is of all markers.
    marker = _marker(raw, marker_names if observe not in PLANS or "marker" in raw.labels else ())
    columns: dict[str, Any] = {name: found[name] for name in WHOLE if name in found}
    columns |= {name: found[name][:, 0] for name in SINGLE if name in found}
    for frame in ("cartesian", "polar"):
        if (sigma := found.get(f"sigma_{frame}")) is not None:
            columns |= {"sigma": sigma, "sigma_frame": frame}
    if "repeat" in found:
        columns["repeat"] = found["repeat"][:, 0].astype(np.int64)
    if configuration := raw.labels.get("configuration"):
        columns |= {"configuration": configuration.codes,
                    "configuration_labels": configuration.names}  # fmt: skip
    force = found.get("force", np.zeros(3))
    # What a subtraction or rotation leaves of no load; scaled by it, numbers overflow.
    force = np.where(np.linalg.norm(force, axis=-1, keepdims=True) < LEAST_FORCE, 0.0, force)
    table = Measurements.of_poses(
        str(path), found.get("q", np.zeros((len(raw.row), 0))), force, row=raw.row,
        marker=marker.codes, marker_names=marker.names, rotation=rotation_column(raw),
        joint_kinds=joint_kinds if "q" in found else (), **columns,
    )  # fmt: skip
    if observe != "targets":  # a path may pass a place twice
        _check_duplicates(raw, table)
    return with_moves(table)


# Family → which of its values are right, and what a message says of others.
RULES: dict[str, tuple[Callable[[Array], np.ndarray], str]] = {
    "force": (lambda v: np.abs(v) <= LARGEST_FORCE, "no arm carries a force this large"),
    "distance": (lambda v: v > 0, "a distance must be positive"),
    "approach": (lambda v: np.isin(v, (-1.0, 0.0, 1.0)), "an approach direction is -1, 0 or 1"),
    "repeat": (
        lambda v: (v == np.round(v)) & (np.abs(v) <= LARGEST_EXACT_INTEGER),
        "a repeat is a whole number",
    ),
    **dict.fromkeys(
        ("sigma_cartesian", "sigma_polar"),
        (lambda v: v > 0, "a standard deviation must be positive"),
    ),
}


def rotation_column(raw: RawTable) -> Array | None:
    """Rotation vectors (n, 3) in rad from rx … or the quaternion, None where there is neither."""
    quaternion = raw.si("quaternion")
    if quaternion is None:
        return raw.si("rotation")
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(quaternion, axis=1)
    off = ~(np.abs(norm - 1.0) <= QUATERNION_NORM_TOLERANCE)
    if off.any():
        i = int(np.argmax(off))
        raise InputError(
            f"{raw.where(i, 'qw')}: the quaternion's norm is {norm[i]:.6g}, not 1; check the "
            "order qw, qx, qy, qz and the digits"
        )
    from scipy.spatial.transform import Rotation  # slow to import, seldom asked for

    vectors: Array = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_rotvec()
    return vectors


def _marker(raw: RawTable, known: tuple[str, ...]) -> Labels:
    labels = raw.labels.get("marker")
    if labels is None:
        if len(known) > 1:
            raise InputError(
                f"{raw.source}: no marker column, but the cell has the markers {listed(known)}; "
                "add a column marker that says which one each row measures"
            )
        return Labels(np.zeros(len(raw.row), dtype=np.int64), known or (DEFAULT_MARKER,))
    if not known:
        return labels
    for code, name in enumerate(labels.names):
        where = raw.where(int(np.argmax(labels.codes == code)), "marker")
        told = f"{where}: {quoted(name)} is no marker of the cell"
        check_known(name, known, told, "its markers:")
    return Labels(np.array([known.index(name) for name in labels.names])[labels.codes], known)


def _check_duplicates(raw: RawTable, table: Measurements) -> None:
    if "configuration" in raw.labels:
        key = [table.configuration, table.repeat, table.marker, *table.force.T]
        what = "the same configuration, repeat, marker and force"
    else:
        key = [*raw.numbers.values(), *(labels.codes for labels in raw.labels.values())]
        what = "the same values in all columns"
    number = numbered(*key)
    earliest = np.unique(number, return_index=True)[1][number]
    repeated = earliest < np.arange(len(number))
    if repeated.any():
        i = int(np.argmax(repeated))
        first = int(earliest[i])
        raise InputError(
            f"{raw.source}: {raw.noun}s {raw.row[first]} and {raw.row[i]} have {what}; drop one, "
            "or number true repetitions in a `repeat` column"
        )


def write_measurements(measurements: Measurements, path: str | Path) -> None:
    """Write the table as CSV, or Parquet where the ending says so (.parquet, .pq); it reads back
    bit for bit.  Whole or not at all."""
    for name in (*measurements.configuration_labels, *measurements.marker_names):
        told = "cannot stand in a table; use one line without blanks at its ends"
        require(is_label(name), f"label {quoted(name)} {told}")
    columns = measurements.columns()
    for header, values in columns.items():
        finite = values.dtype == object or np.isfinite(values).all()
        require(finite, f"{path}: the numbers of {header} to write are not all finite")
    if Path(path).suffix.lower() in tables.PARQUET:
        return tables.write_parquet(path, columns)
    # A few at a time as numbers of Python, which are written with the shortest digits that read
    # back exactly.
    pieces = (slice(start, start + AT_A_TIME) for start in range(0, len(measurements), AT_A_TIME))
    rows = (zip(*(v[some].tolist() for v in columns.values()), strict=True) for some in pieces)
    with atomic_writer(path) as handle:
        tables.write_csv(handle, columns, chain.from_iterable(rows))


def read_matrix(path: str | Path, what: str) -> Array:
    if Path(path).suffix.lower() == ".npy":
        remedy = "save the matrix with numpy.save, or as CSV"
        with open_input(path, what, tables.MOST_BYTES) as handle:
            try:
                # Mapped, so that a header which states more numbers than there are reads nothing.
                found = np.lib.format.open_memmap(handle.name, mode="r")
            except (ValueError, EOFError, OSError, OverflowError, SyntaxError, TypeError) as error:
                raise InputError(f"{path}: not a matrix of numbers ({error}); {remedy}") from None
        if found.dtype.kind not in "fiu" or not np.isfinite(found).all():
            raise InputError(f"{path}: holds {found.dtype}, not finite numbers; {remedy}")
        return np.array(found, dtype=float)
    lines = enumerate(read_text(path, what, tables.MOST_BYTES).splitlines(), start=1)
    rows = [(n, [cell.strip() for cell in line.split(",")]) for n, line in lines if line.strip()]
    require(rows, f"{path}: empty file; a {what} is a square table of numbers")
    width = len(rows[0][1])
    for number, cells in rows:
        told = f"{len(cells)} numbers, the first line has {width}; a {what} is a square table"
        require(len(cells) == width, f"{path}, line {number}: {told} without a header")
    columns = {i: f"no. {i + 1}" for i in range(width)}
    if problem := tables.first_bad_cell(str(path), rows, columns, False):
        raise problem
    return np.array([cells for _, cells in rows], dtype=np.float64)
