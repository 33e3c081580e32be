"""Targets: where the tool is to be, and in which frame that is stated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from elastocal.errors import InputError, option, require
from elastocal.measurements import Measurements, read_measurements
from elastocal.model.calibrated_tool import numbers
from elastocal.units import Array

Frame = Literal["base", "tracker"]
FRAMES: tuple[Frame, ...] = ("base", "tracker")


@dataclass(frozen=True)
class Targets:
    """n targets; `table` holds their force (n, 3) N and circumstances, one row each.

    `position` (n, 3) m and `rotation` (n, 3, 3) of the tool, and the forces, stand in `frame`;
    rotation None: any.  `q` (n, joints) is the nominal command, None where it is to be found;
    without a position the tool is to be where the nominal arm has it at q.
    """

    table: Measurements
    frame: Frame
    position: Array | None
    rotation: Array | None
    q: Array | None

    def __len__(self) -> int:
        return len(self.table)

    def place(self, i: int) -> str:
        """Where row i stands, as messages begin: file and line."""
        return f"{self.table.source}, line {self.table.row[i]}"


def read_targets(
    path: str | Path, joint_kinds: tuple[str, ...], frame: Frame, force: Array | None = None
) -> Targets:
    """Targets of a CSV or Parquet file whose columns are those of the measurement table.

    x_mm, y_mm, z_mm with rx_deg … or qw … where the rotation is prescribed, or q1_deg … alone,
    or both: joints are then the nominal command to start from.  force_x_N … and circumstances
    (time_s, approach_1, temperature_C, torque_1_Nm) as far as the model needs them; `force`
    (3,) N acts where the table states none.

    Raises InputError that names file, line, column and the offending text.
    """
    table = read_measurements(path, joint_kinds=joint_kinds, observe="targets")
    q = table.q if table.q.shape[1] else None
    if table.position is None:
        extra = (
            "; a rotation alone is no target" if table.rotation is not None and q is None else ""
        )
        require(
            q is not None and table.rotation is None,
            f"{path}: the columns x_mm,y_mm,z_mm are missing; a target needs its position, or the "
            f"nominal command q1_deg … alone{extra}",
        )
        require(
            frame == "base",
            f"{path}: targets by q1_deg … alone are where the nominal arm has the tool, which "
            f"stands in the base frame; leave {option('frame', 'tracker')} away, or give "
            "x_mm,y_mm,z_mm",
        )
    require(
        len(table.marker_names) == 1,
        f"{path}: targets of the markers {', '.join(table.marker_names[:4])} … in one table; the "
        f"point of the tool is chosen by {option('point')}: split the table by marker",
    )
    if force is not None:
        require(
            not table.force.any(),
            f"{path}: the table has forces of its own; leave {option('load')} away or drop them",
        )
        table = replace(table, force=np.tile(force, (len(table), 1)))
    rotation = table.rotation
    matrices = None if rotation is None else Rotation.from_rotvec(rotation).as_matrix()
    return Targets(table, frame, table.position, matrices, q)


def one_target(text: str, frame: Frame, force: Array | None = None) -> Targets:
    """The target "x,y,z" in mm, or "x,y,z,rx,ry,rz" with a rotation vector in degrees."""
    what = "x,y,z in mm, or x,y,z,rx,ry,rz in mm and degrees (rotation vector)"
    values = numbers(option("target"), text, (3, 6), what)
    position = values[None, :3] / 1e3
    rotation = None
    if len(values) == 6:
        rotation = Rotation.from_rotvec(np.radians(values[None, 3:])).as_matrix()
    return targets_at(option("target"), position, rotation, frame, force)


def targets_at(
    source: str, position: Array | None, rotation: Array | None, frame: Frame,
    force: Array | None = None, q: Array | None = None,
) -> Targets:  # fmt: skip
    """Targets that no table states, all under one `force` (3,) N; errors name `source`."""
    known = position if position is not None else q
    if known is None:
        raise InputError(f"{source}: neither positions nor joints")
    pull = np.zeros(3) if force is None else force
    table = Measurements.of_poses(source, np.zeros((len(known), 0)), pull)
    return Targets(table, frame, position, rotation, q)
