"""What `elastocal compensate` reads besides its tables, writes and prints."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from elastocal.errors import InputError
from elastocal.tables import csv_text

if TYPE_CHECKING:
    from elastocal.cell import Array
    from elastocal.compensation.compensate import Compensation
    from elastocal.compensation.table import CorrectionTable, Grid
    from elastocal.manipulator.calibrated import CalibratedArm

GRID_REMEDIES = {
    "limit": "joint limits prevent it: widen [limits], or give a smaller --box or another --near",
    "not reached": "out of reach, or beside a singular posture: give a smaller --box, another "
    "--rotation or another --near",
    "no equilibrium": "no static equilibrium under this load: check --load",
}


def read_near(arm: CalibratedArm, text: str | None) -> Array | None:
    """--near as joints (n,) in rad or m."""
    import numpy as np

    from elastocal.compensation.commands_file import in_file_units
    from elastocal.compensation.point import numbers
    from elastocal.manipulator.limits import joint_limits

    if text is None:
        return None
    chain = arm.model.chain
    n = chain.n_joints
    values = numbers("--near", text, (n,), f"{n} numbers, one per joint, in degrees (or mm)")
    values = values / in_file_units(np.ones(n), chain.kinds)
    lower, upper = joint_limits(arm.model.cell, chain)
    if ((values < lower) | (values > upper)).any():
        j = int(np.argmax((values < lower) | (values > upper)))
        raise InputError(f"--near: joint {j + 1} is beyond its limits; give a posture within them")
    return values


def read_table_grid(arm: CalibratedArm, grid: str, box: str | None, rotation: str | None) -> Grid:
    """The grid that --grid, --box and --rotation ask for."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    from elastocal.compensation.point import numbers
    from elastocal.compensation.table import box_grid, joint_grid

    try:
        counts = tuple(int(part) for part in grid.split(","))
    except ValueError:
        raise InputError(
            f"--grid takes whole numbers, as in 5 or 9,7,7,3,3,1; found '{grid}'"
        ) from None
    if box is None:
        return joint_grid(arm, counts)
    corners = numbers("--box", box, (6,), "x0,y0,z0,x1,y1,z1 in mm in the base frame") / 1e3
    turned = None
    if rotation is not None:
        vector = numbers("--rotation", rotation, (3,), "a rotation vector rx,ry,rz in degrees")
        turned = Rotation.from_rotvec(np.radians(vector)).as_matrix()
    return box_grid(corners[:3], corners[3:], counts, turned)


def commands_of(
    found: Compensation, arm: CalibratedArm, listed: bool, partial: bool
) -> tuple[dict[str, Any], str]:
    """Summary of the commands, with each of them where `listed`, and their table as CSV.

    Raises InsufficientDataError where rows are not reached and `partial` does not allow for that.
    """
    from elastocal.compensation.commands_file import check_reached, commands_csv, summary

    if not partial:
        check_reached(found)
    kinds = arm.model.chain.kinds
    return summary(found, kinds, commands=listed), commands_csv(found, kinds)


def table_of(
    found: CorrectionTable, arm: CalibratedArm, partial: bool
) -> tuple[dict[str, Any], str]:
    """Summary of the correction table, and the table as CSV; refused as `commands_of` is."""
    import numpy as np

    from elastocal.compensation.commands_file import (
        check_status,
        in_file_units,
        joint_columns,
        spread,
    )
    from elastocal.compensation.table import EXACT, FIRST_ORDER

    kinds = arm.model.chain.kinds
    if found.grid.joints:
        heads, points = joint_columns(kinds), in_file_units(found.points, kinds)
    else:
        heads, points = ["x_mm", "y_mm", "z_mm"], found.points * 1e3
    known = np.all(np.isfinite(found.correction), axis=1).tolist()
    plain = tuple(EXACT if good else s for good, s in zip(known, found.status, strict=True))
    # A grid point has no line in any file of the user's: it is named by where it lies.
    named = [f"({', '.join(f'{v:.5g}' for v in p + 0.0)})" for p in points]
    what = f"--table: %d of %d grid points ({', '.join(heads)})"
    if not partial:
        check_status(what, named, plain, EXACT, GRID_REMEDIES)
    heads += ["dx_mm", "dy_mm", "dz_mm"]
    columns = [found.correction[:, :3] * 1e3]
    if found.oriented:
        heads += ["drx_deg", "dry_deg", "drz_deg"]
        columns.append(np.degrees(found.correction[:, 3:]))
    order = np.lexsort(found.points.T[::-1])
    rows = []
    values = np.hstack(columns)
    for i in order:
        cells = [f"{v + 0.0:.7f}" if np.isfinite(v) else "" for v in values[i]]
        rows.append([*(f"{v + 0.0:.9g}" for v in points[i]), *cells, found.status[i]])
    content: dict[str, Any] = {
        "points": len(found.status),
        "exact": found.status.count(EXACT),
        "first_order": found.status.count(FIRST_ORDER),
        "levels": [len(axis) for axis in found.grid.axes],
        "checked_between": len(found.between),
        "error_without_um": spread(found.before[:, 0]),
        "error_with_um": spread(found.between[:, 0]),
    }
    if found.oriented:
        content["rotation_without_urad"] = spread(found.before[:, 1])
        content["rotation_with_urad"] = spread(found.between[:, 1])
    return content, csv_text([*heads, "status"], rows)
