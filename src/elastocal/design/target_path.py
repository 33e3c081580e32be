"""A table of test poses: a machining path in joints, or in positions of the tool's point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from elastocal.errors import InputError, require
from elastocal.measurements import NUMBERED, families, layout_of, rotation_column
from elastocal.tables import NO_UNIT, Array, Family, Layout, RawTable, read_table
from elastocal.text import listed, quoted

TAKEN = ("q", "position", "rotation", "quaternion", "force")
WEIGHT = Family("weight", "weights", {"weight": NO_UNIT})
MOST_POSES = 10_000


@dataclass(frozen=True)
class PathTable:
    """N poses in SI units: either joints `q` (N, n), or `position` (N, 3) in the data's frame
    and perhaps `rotation` (N, 3), a rotation vector; `force` (N, 3), None where not stated;
    `weight` (N,).  `raw` tells where each row stands in the file."""

    raw: RawTable
    q: Array | None
    position: Array | None
    rotation: Array | None
    force: Array | None
    weight: Array

    def columns(self, family: str) -> tuple[str, ...]:
        """The headers of a family of columns."""
        return tuple(column.header for column in self.raw.layout.columns[family])


def read_path(path: Path, joint_kinds: Sequence[str]) -> PathTable:
    """The poses of a CSV or Parquet (.parquet, .pq) file; columns as in the measurement table.

    q1_deg … for all joints, or x_mm, y_mm, z_mm with rx_deg … or qw … where the rotation is
    prescribed; force_x_N … and weight may be added.  Raises InputError that names file, line,
    column and the offending text.
    """

    def choose(header: Sequence[str]) -> Layout:
        return _layout(str(path), header, joint_kinds)

    raw = read_table(path, choose)
    require(
        len(raw.row) <= MOST_POSES,
        f"{raw.source}: {len(raw.row)} poses; a path takes at most {MOST_POSES}; thin it out: "
        "neighbouring poses say the same",
    )
    weight = raw.si(WEIGHT.name)
    if weight is not None:
        raw.check(WEIGHT.name, weight > 0, "a weight must be positive")
    return PathTable(
        raw=raw,
        q=raw.si("q"),
        position=raw.si("position"),
        rotation=rotation_column(raw),
        force=raw.si("force"),
        weight=np.ones(len(raw.row)) if weight is None else weight[:, 0],
    )


def _layout(source: str, header: Sequence[str], joint_kinds: Sequence[str]) -> Layout:
    in_joints = any((m := NUMBERED.fullmatch(text)) and m[1] == "q" for text in header)
    kinds = joint_kinds if in_joints else ()
    layout = layout_of(source, header, kinds, "plan", extra=(WEIGHT,))
    columns = {n: cs for n, cs in layout.columns.items() if n in (*TAKEN, WEIGHT.name)}
    for name, family in layout.columns.items():
        if name not in columns and name != "configuration":
            raise InputError(
                f"{source}: column {quoted(family[0].header)} has no meaning in a path; drop it, "
                "or start its name with '#', '_' or 'note' to have it ignored"
            )
    if in_joints and ("rotation" in columns or "quaternion" in columns):
        other = columns["rotation" if "rotation" in columns else "quaternion"][0].header
        raise InputError(
            f"{source}: {columns['q'][0].header} … says the rotation too; drop {other} …"
        )
    if in_joints and "position" in columns:
        raise InputError(
            f"{source}: {columns['q'][0].header} … and {columns['position'][0].header} … say the "
            "same in two ways; keep the joints or the positions"
        )
    if not in_joints and "position" not in columns:
        joints = next(iter(families(joint_kinds)["q"].units), "q1")
        raise InputError(
            f"{source}: the columns {joints}_deg … or x_mm,y_mm,z_mm are missing; a path needs "
            f"the joints or the positions of its poses; found {listed(header, 12)}"
        )
    numbers = tuple(column.header for family in columns.values() for column in family)
    return Layout(columns, (), numbers)
