"""Points and their joint values → the checked measurement table."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.errors import InputError
from elastocal.importing.joining import DEFAULT, Array, Joined, PooledRecords, groups_alike
from elastocal.importing.schema import JoinTable, LoadTable, MappingTable
from elastocal.measurements import Measurements, families, read_measurements
from elastocal.tables import Family, column, csv_text
from elastocal.text import did_you_mean, listed, quoted
from elastocal.units import convert, quantities

GRAVITY = 9.80665  # m/s², standard
UNLOADED = ("none", "unloaded", "0")


def forces_of(
    where: str, points: PooledRecords, loads: Mapping[str, NDArray[np.float64] | LoadTable] | None
) -> NDArray[np.float64] | None:
    """(n, 3) N in the tracker's frame (z up) for each point; None where no load is told.

    A mass m hangs straight down: force (0, 0, -9.80665 m).  The names none, unloaded and 0 mean no
    force unless [loads] says otherwise.  Raises InputError for a load that [loads] does not have,
    and where loads are told both by name and in columns.
    """
    named = points.labels.get("load")
    if named is None:
        if loads and "force_x" not in points.numbers:
            raise InputError(
                f"{where}: [loads] names {listed(loads)}, but no file says which load it belongs "
                "to; give load in [[source]], or a group (?P<load>…) in a pattern"
            )
        return None
    if "force_x" in points.numbers:
        raise InputError(
            f"{points.files[0]}: the load is told by name and in columns force_x …; keep one"
        )
    known = {name: np.zeros(3) for name in UNLOADED}
    for name, stated in (loads or {}).items():
        down = stated.mass_kg * GRAVITY if isinstance(stated, LoadTable) else 0.0
        known[name] = np.array(
            [0.0, 0.0, -down] if isinstance(stated, LoadTable) else list(stated), dtype=float
        ) + 0.0  # no -0.0  # fmt: skip
    for i, name in enumerate(named):
        if name not in known:
            raise InputError(
                f"{points.where(i)}: load {quoted(name)} is not in [loads] of {where}"
                f"{did_you_mean(name, known)}; there are {listed(known)}: add "
                f"{name} = [0, 0, -1000] in N, or {name} = {{ mass_kg = 100 }}"
            )
    return np.array([known[name] for name in named])


SAME_DEG, SAME_MM = 0.05, 0.05
OWN_DEFAULT = {"sigma_cartesian": "um", "sigma_polar": "um"}
WHOLE = re.compile(r"-?[0-9]{1,15}")
LABELS = ("configuration", "repeat", "marker")


@dataclass(frozen=True)
class Assembled:
    """`columns` header → n texts or numbers, in the order of the table; `kinds` per joint.

    `origin` (n,) says file and line of each row; `warnings` are sentences for the preview.
    """

    columns: dict[str, Sequence[str] | NDArray]
    kinds: tuple[str, ...]
    origin: list[str]
    warnings: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.origin)


def assemble(where: str, points: PooledRecords, log: PooledRecords | None, joined: Joined | None,
             mapping: MappingTable) -> Assembled:  # fmt: skip
    """One row per point that has joint values, in the points' order.

    Configurations are those of the names, else of the joint log, else joint values that agree
    within same_pose_deg.  Repeats are numbered in order where the file does not number them.
    Times are counted from the first reading.  Raises InputError where there are no joint values
    or positions, for repeats that are no whole numbers or occur twice, and for unknown loads.
    """
    settings = mapping.join or JoinTable()
    rows = np.arange(len(points)) if joined is None else np.flatnonzero(joined.row >= 0)
    numbers, units = _numbers(points, log, joined, rows)
    n_joints = sum(1 for stem in numbers if stem[0] == "q" and stem[1:].isdigit())
    if not n_joints:
        raise InputError(
            f"{where}: no joint values; map q1_deg … in [source.columns], or add a [[source]] with "
            'role = "joints"'
        )
    kinds = tuple(
        "revolute" if "angle" in quantities(units[f"q{j + 1}"]) else "prismatic"
        for j in range(n_joints)
    )
    forces = forces_of(where, points, mapping.loads)
    if forces is not None:
        for k, axis in enumerate("xyz"):
            numbers[f"force_{axis}"], units[f"force_{axis}"] = forces[rows, k], "N"
    q = np.column_stack([numbers[f"q{j + 1}"] for j in range(n_joints)])
    spread = (log or points).spread(
        settings.same_pose_deg or SAME_DEG, settings.same_pose_mm or SAME_MM
    )
    configuration, warnings = _configurations(points, joined, rows, q, spread)
    columns: dict[str, Sequence[str] | NDArray] = {"configuration": configuration}
    marker = points.labels.get("marker")
    markers = [""] * len(rows) if marker is None else [marker[i] for i in rows]
    force = [tuple(row) for row in np.column_stack(
        [numbers.get(f"force_{a}", np.zeros(len(rows))) for a in "xyz"])]  # fmt: skip
    columns["repeat"] = _repeats(
        points, rows, list(zip(configuration, markers, force, strict=True))
    )
    if marker is not None:
        columns["marker"] = markers
    for family in families(kinds).values():
        if family.name not in LABELS:
            columns |= _family(where, family, numbers, units)
    time = points.time if points.time is not None else _of_log(log, joined)
    if time is not None:
        columns["time_s"] = np.round(time[rows] - time[rows].min(), 6)
    if any(points.names):
        columns["note_point"] = [points.names[i] for i in rows]
    origin = [points.where(int(i)) for i in rows]
    columns["note_source"] = origin
    return Assembled(columns, kinds, origin, tuple(warnings))


def _of_log(log: PooledRecords | None, joined: Joined | None) -> Array | None:
    if log is None or joined is None or log.time is None:
        return None
    return log.time[joined.row]


def _numbers(
    points: PooledRecords, log: PooledRecords | None, joined: Joined | None, rows: NDArray[np.int64]
) -> tuple[dict[str, Array], dict[str, str]]:
    """Columns of the points, and of the joint log those that the points do not have."""
    numbers = {stem: values[rows] for stem, values in points.numbers.items()}
    units = dict(points.units)
    if log is not None and joined is not None:
        for stem, values in log.numbers.items():
            if stem not in numbers:
                numbers[stem], units[stem] = values[joined.row[rows]], log.units[stem]
        for j, unit in enumerate(log.q_units):
            numbers[f"q{j + 1}"], units[f"q{j + 1}"] = joined.q[rows, j], unit
    return numbers, units


def _configurations(
    points: PooledRecords, joined: Joined | None, rows: NDArray[np.int64], q: Array, spread: Array
) -> tuple[list[str], list[str]]:
    stated = points.labels.get("configuration")
    if stated is None and joined is not None:
        stated = joined.pose
    if stated is None:
        kinds, inverse = np.unique(q, axis=0, return_inverse=True)
        first = np.full(len(kinds), len(q))
        np.minimum.at(first, inverse.ravel(), np.arange(len(q)))
        order = np.argsort(first)
        codes = np.empty(len(kinds), dtype=np.int64)
        codes[order] = groups_alike(kinds[order], spread)
        return [str(code + 1) for code in codes[inverse.ravel()]], []
    names = [stated[i] for i in rows]
    _, code = np.unique(np.array(names, dtype=object).astype(str), return_inverse=True)
    low = np.full((code.max() + 1, q.shape[1]), np.inf)
    high = -low
    np.minimum.at(low, code, q)
    np.maximum.at(high, code, q)
    apart = np.any(high - low > spread, axis=1)
    if not apart.any():
        return names, []
    which = list(dict.fromkeys(n for n, c in zip(names, code, strict=True) if apart[c]))
    worst = float((high - low).max())
    return names, [
        f"{len(which)} configurations have rows whose joint values differ by up to {worst:.3g} "
        f"(in the columns' unit): {listed(which, 8)}; if these are different poses, name them apart"
    ]


def _repeats(
    points: PooledRecords, rows: NDArray[np.int64], keys: list[tuple]
) -> NDArray[np.int64]:
    stated = points.labels.get("repeat")
    count: dict[tuple, int] = {}
    seen: dict[tuple, int] = {}
    repeats = np.zeros(len(rows), dtype=np.int64)
    for k, (i, key) in enumerate(zip(rows, keys, strict=True)):
        if stated is None:
            repeats[k] = count.get(key, 0)
            count[key] = int(repeats[k]) + 1
            continue
        text = stated[i]
        if not WHOLE.fullmatch(text):
            raise InputError(f"{points.where(int(i))}: repeat {quoted(text)} is no whole number; "
                             "correct the pattern or the column")  # fmt: skip
        repeats[k] = int(text)
        first = seen.setdefault((*key, int(text)), k)
        if first != k:
            raise InputError(
                f"{points.where(int(i))}: repeat {text} of configuration {key[0]}"
                f"{f', marker {key[1]}' if key[1] else ''} stands in line "
                f"{points.line[rows[first]]} too; leave the repeat out of the pattern to have "
                "shots numbered in order"
            )
    return repeats


def _family(
    where: str, family: Family, numbers: dict[str, Array], units: dict[str, str]
) -> dict[str, Array]:
    """The columns of a family in one unit that the table takes, {} where there is none."""
    present = [stem for stem in family.units if stem in numbers]
    if not present:
        return {}
    chosen: dict[tuple[str, ...], str] = {}
    columns = {}
    for stem in present:
        taken = family.units[stem]
        if taken not in chosen:
            alike = {units[s] for s in present if family.units[s] == taken}
            (only, *more) = sorted(alike)
            general = OWN_DEFAULT.get(family.name) or DEFAULT[quantities(units[stem])[0]]
            chosen[taken] = only if not more and only in taken else general
        columns[column(stem, chosen[taken])] = convert(numbers[stem], units[stem], chosen[taken])
    missing = [stem for stem in family.units if stem not in numbers]
    if missing:
        raise InputError(
            f"{where}: {listed(columns)} without {listed(missing)}; the table needs all columns of "
            f"the {family.meaning}: add them to [source.columns]"
        )
    return columns


def table_text(made: Assembled) -> str:
    """The CSV of docs/file-formats.md; numbers with the digits that read back exactly."""
    return csv_text(made.columns, zip(*map(_texts, made.columns.values()), strict=True))


def _texts(values: Sequence[str] | NDArray) -> Sequence[object]:
    return [repr(v + 0) for v in values.tolist()] if isinstance(values, np.ndarray) else values


def validated(text: str, name: str, made: Assembled, cell: Cell | None) -> Measurements:
    """The table as the reader of `identify` reads it.

    With `cell`, joints, markers and columns must be those that it asks for.  Raises InputError
    as the reader does, about the table `name`.
    """
    kinds = made.kinds
    markers: tuple[str, ...] = ()
    observe = "position" if any(c.startswith("x_") for c in made.columns) else "distance"
    if cell is not None:
        from elastocal.manipulator.choice import load_chain

        kinds = load_chain(cell).kinds
        markers = tuple(cell.tool.markers)
        observe = cell.model.observe
    try:
        return read_measurements(
            f"{name} (not written)",
            joint_kinds=kinds,
            marker_names=markers,
            observe=observe,
            text=text,
        )
    except InputError as error:
        raise InputError(f"{error}{_meant(made, str(error))}") from None


def _meant(made: Assembled, message: str) -> str:
    """Where the line that a message names comes from."""
    found = re.search(r"line (\d+)", message)
    row = int(found[1]) - 2 if found else -1
    return f" (from {made.origin[row]})" if 0 <= row < len(made) else ""
