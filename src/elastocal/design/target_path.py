"""A table of test poses: a machining path in joints, or in positions of the tool's point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from elastocal.csv_source import read_csv
from elastocal.errors import InputError, require
from elastocal.measurement_columns import families
from elastocal.measurement_header import NUMBERED, Column, Layout, layout_of
from elastocal.measurement_reader import rotation_column, si_columns
from elastocal.nearest import listed, quoted
from elastocal.parquet_source import read_parquet
from elastocal.raw_table import RawTable

Array = NDArray[np.float64]

WEIGHT = "weight"
TAKEN = ("q", "position", "rotation", "quaternion", "force")
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

    raw = (read_parquet if path.suffix.lower() in (".parquet", ".pq") else read_csv)(path, choose)
    require(
        len(raw.row) <= MOST_POSES,
        f"{raw.source}: {len(raw.row)} poses; a path takes at most {MOST_POSES}; thin it out: "
        "neighbouring poses say the same",
    )
    weight = si_columns(raw, WEIGHT)
    if weight is not None and not (weight > 0).all():
        i = int(np.argmin(weight[:, 0] > 0))
        raise InputError(
            f"{raw.where(i, WEIGHT)}: a weight must be positive; found {weight[i, 0]:.6g}; correct "
            f"it or drop the {raw.noun}"
        )
    return PathTable(
        raw=raw,
        q=si_columns(raw, "q"),
        position=si_columns(raw, "position"),
        rotation=rotation_column(raw),
        force=si_columns(raw, "force"),
        weight=np.ones(len(raw.row)) if weight is None else weight[:, 0],
    )


def _layout(source: str, header: Sequence[str], joint_kinds: Sequence[str]) -> Layout:
    known = [text for text in header if text != WEIGHT]
    require(len(header) - len(known) < 2, f"{source}: column '{WEIGHT}' appears twice; keep one")
    in_joints = any((m := NUMBERED.fullmatch(text)) and m[1] == "q" for text in known)
    columns = _columns(source, known, joint_kinds if in_joints else ())
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
    if len(known) < len(header):
        columns |= {WEIGHT: (Column(WEIGHT, ""),)}
    numbers = tuple(column.header for family in columns.values() for column in family)
    return Layout(columns, (), numbers)


def _columns(
    source: str, header: Sequence[str], joint_kinds: Sequence[str]
) -> dict[str, tuple[Column, ...]]:
    """The families of columns in a header, all of which a path takes."""
    columns: Mapping[str, tuple[Column, ...]]
    columns = layout_of(source, header, joint_kinds, "plan").columns
    for name, family in columns.items():
        if name not in TAKEN and name != "configuration":
            raise InputError(
                f"{source}: column {quoted(family[0].header)} has no meaning in a path; drop it, "
                "or start its name with '#', '_' or 'note' to have it ignored"
            )
    if "q" in columns and ("rotation" in columns or "quaternion" in columns):
        other = columns["rotation" if "rotation" in columns else "quaternion"][0].header
        raise InputError(
            f"{source}: {columns['q'][0].header} … says the rotation too; drop {other} …"
        )
    return {name: family for name, family in columns.items() if name in TAKEN}
