"""The plan on disk: plan.csv, which `simulate` takes and people measure by, and plan.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.design.order.execution import Execution, Stop
from elastocal.errors import InputError, require
from elastocal.files import atomic_write_text
from elastocal.measurements import DEFAULT_MARKER, Measurements, families
from elastocal.tables import column, csv_text
from elastocal.text import is_label, json_text, quoted
from elastocal.units import to_si

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

SCHEMA = "elastocal/plan/1"
# Of degrees and mm: 9e-12 rad and 5e-13 m, and a level of -25.24° reads so.
DIGITS = 9
UNITS = {"revolute": "deg", "prismatic": "mm"}


@dataclass(frozen=True)
class PlanRows:
    """R rows of plan.csv: `configuration` names, `q` (R, n) rad or m, `level` (R,) from 1 on,
    `order` (R,) of execution from 1 on, and where the plan states them `force` (R, 3) N and
    `approach` (R, n) of ±1.  `notes`: further columns for people, passed over when read."""

    configuration: tuple[str, ...]
    q: Array
    level: IntArray
    order: IntArray
    force: Array | None = None
    approach: IntArray | None = None
    notes: Mapping[str, Sequence[str]] | None = None

    def table(self, joint_kinds: Sequence[str]) -> Measurements:
        """What `measurement_reader.read_plan` reads of these rows once they are written."""
        n = len(self.configuration)
        labels = tuple(dict.fromkeys(self.configuration))
        q = np.column_stack(
            [
                to_si(np.round(in_unit(values, kind), DIGITS), UNITS[kind])
                for values, kind in zip(self.q.T, joint_kinds, strict=True)
            ]
        )
        return Measurements(
            source="plan",
            row=np.arange(2, n + 2),
            q=q,
            configuration=np.array([labels.index(name) for name in self.configuration]),
            configuration_labels=labels,
            repeat=np.zeros(n, dtype=np.int64),
            marker=np.zeros(n, dtype=np.int64),
            marker_names=(DEFAULT_MARKER,),
            force=np.zeros((n, 3)) if self.force is None else self.force,
            approach=None if self.approach is None else self.approach.astype(float),
        )


def plan_rows(
    execution: Execution,
    configurations: Sequence[str],
    level: IntArray,
    forces: Array | None = None,
) -> PlanRows:
    """The rows of an execution, sorted by pose, then side of approach, then load state.

    With `forces` (L, 3) N of the load states one row per reading, under its force; without, one
    row per pose and side, to be measured in every load state, with the place in the order of the
    second state as note_order_2, and so on.  `configurations` and `level`: one per pose.  Where a
    pose is approached from both sides, they are two configurations, 7+ (joints moving up to it)
    and 7-: the difference between them is what such a plan is for, not noise of repeats.
    """
    numbered = list(enumerate(execution.stops, start=1))
    readings: dict[tuple[int, int, int], list[tuple[int, Stop]]] = {}
    for k, stop in sorted(numbered, key=lambda s: (s[1].pose, s[1].side, s[1].load)):
        key = (stop.pose, stop.side, -1 if forces is None else stop.load)
        readings.setdefault(key, []).append((k, stop))
    rows = [sorted(row, key=lambda s: s[0]) for row in readings.values()]
    first = [row[0][1] for row in rows]
    sides = ("", "") if first[0].approach is None else ("+", "-")
    most = max(len(row) for row in rows)
    notes = {
        f"note_order_{i + 1}": [str(row[i][0]) if i < len(row) else "" for row in rows]
        for i in range(1, most)
    }
    approach = [stop.approach for stop in first if stop.approach is not None]
    return PlanRows(
        configuration=tuple(configurations[stop.pose] + sides[stop.side] for stop in first),
        q=np.array([stop.q for stop in first]),
        level=np.array([level[stop.pose] for stop in first]),
        order=np.array([row[0][0] for row in rows]),
        force=None if forces is None else forces[[stop.load for stop in first]],
        approach=np.array(approach) if approach else None,
        notes=notes,
    )


def write_plan(path: str | Path, rows: PlanRows, joint_kinds: Sequence[str]) -> None:
    """Write plan.csv, whole or not at all; angles in degrees, travel in mm.

    `measurements.read_plan` reads it back to 1e-11 rad.  Raises InputError for values that
    are not finite, names that cannot stand in a table or repeat, and an unwritable place.
    """
    columns = _columns(rows, joint_kinds)
    for name in rows.configuration:
        if not is_label(name):
            raise InputError(
                f"{path}: configuration name {quoted(name)} cannot stand in a table; use one "
                "line without blanks at its ends"
            )
    keys = list(zip(rows.configuration, *([] if rows.force is None else rows.force.T), strict=True))
    require(len(set(keys)) == len(keys), f"{path}: two rows of the plan have the same name")
    for values in (rows.q, rows.force):
        if values is not None and not np.isfinite(values).all():
            raise InputError(f"{path}: the plan's joint values and forces must be finite")
    atomic_write_text(path, csv_text(columns, zip(*columns.values(), strict=True)))


def _columns(rows: PlanRows, joint_kinds: Sequence[str]) -> dict[str, Sequence[str]]:
    """Header → cells, in the units and names of the measurement table."""
    known = families(joint_kinds)
    columns: dict[str, Sequence[str]] = {"configuration": rows.configuration}
    for stem, kind, values in zip(known["q"].units, joint_kinds, rows.q.T, strict=True):
        columns[column(stem, UNITS[kind])] = [_number(v) for v in in_unit(values, kind)]
    if rows.force is not None:
        for stem, values in zip(known["force"].units, rows.force.T, strict=True):
            columns[column(stem, "N")] = [repr(float(v) + 0.0) for v in values]
    if rows.approach is not None:
        for stem, values in zip(known["approach"].units, rows.approach.T, strict=True):
            columns[stem] = [str(int(v)) for v in values]
    columns["level"] = [str(int(v)) for v in rows.level]
    columns["order"] = [str(int(v)) for v in rows.order]
    return columns | dict(rows.notes or {})


def in_unit(values: Array, kind: str) -> Array:
    """A joint's values in rad or m in the unit of the file."""
    return np.degrees(values) if kind == "revolute" else values * 1e3


def _number(value: float) -> str:
    return repr(round(float(value), DIGITS) + 0.0)


def write_plan_json(path: str | Path, summary: Mapping[str, Any]) -> None:
    """Write plan.json of schema elastocal/plan/1, whole or not at all.

    numpy numbers and arrays become plain ones; numbers that are not finite become null, as JSON
    has none.  Raises InputError where the place cannot be written.
    """
    atomic_write_text(path, json_text({"schema": SCHEMA, **summary}) + "\n")
