"""What `elastocal compensate` reads besides its tables, writes and prints."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING, Any

from elastocal.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

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
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*heads, "status"])
    values = np.hstack(columns)
    for i in order:
        cells = [f"{v + 0.0:.7f}" if np.isfinite(v) else "" for v in values[i]]
        writer.writerow([*(f"{v + 0.0:.9g}" for v in points[i]), *cells, found.status[i]])
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
    return content, text.getvalue()


def print_summaries(screen: Console, content: dict[str, Any]) -> None:
    """Errors before and after, uncertainty and warnings, on the terminal."""
    commands, table = content.get("commands"), content.get("table")
    if commands is not None:
        rows = {
            "nominal command": commands["error_before_um"],
            "new command": commands["error_after_um"],
            "standard uncertainty": commands["std_um"],
        }
        _print_spreads(screen, "Position of the tool, predicted", rows)
        for k, command in enumerate(commands.get("commands", ())):
            joints = ", ".join(f"{n} {v:.6f}" for n, v in command.items() if n != "status")
            screen.print(f"target {k + 1}: {joints or command['status']}")
        screen.print(
            f"{commands['reached']} of {commands['n']} targets reached by the {commands['point']}; "
            f"targets in the {commands['frame']} frame.",
            markup=False,  # a marker may be called [red]
        )
        for told in commands["warnings"]:
            screen.print(f"Warning: {told}", markup=False)
    if table is not None:
        rows = {"without the table": table["error_without_um"]}
        rows["with it, interpolated"] = table["error_with_um"]
        title = f"Position of the tool at {table['checked_between']} points between the grid's"
        _print_spreads(screen, title, rows)
        screen.print(
            f"{table['points']} grid points: {table['exact']} exact, {table['first_order']} of "
            "first order (beside singular postures or limits)."
        )


def _length(um: float) -> str:
    from elastocal.report.units import length

    return "< 0.01 µm" if um < 0.01 else length(um * 1e-6)


def _print_spreads(screen: Console, title: str, rows: dict[str, dict[str, Any]]) -> None:
    from elastocal.report.console_table import titled

    shown = titled(title)
    shown.add_column("")
    for head in ("rms", "95 %", "max"):
        shown.add_column(head, justify="right")
    for name, values in rows.items():
        shown.add_row(name, *("–" if v is None else _length(v) for v in values.values()))
    screen.print(shown)
