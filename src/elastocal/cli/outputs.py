"""What the commands write and print: results, diagnoses, compensated commands, imports."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from elastocal.errors import InputError
from elastocal.files import atomic_write_text
from elastocal.identification.result import Calibration
from elastocal.importing.assemble import Imported
from elastocal.importing.records import Understood
from elastocal.report.formatting import counted, printable
from elastocal.report.terminal import titled
from elastocal.saving import save_residuals
from elastocal.tables import csv_text
from elastocal.text import json_text, listed

if TYPE_CHECKING:
    from elastocal.compensation.compensate import Compensation
    from elastocal.compensation.correction_table import CorrectionGrid, CorrectionTable
    from elastocal.diagnosis.diagnosis import Diagnosis
    from elastocal.model.calibrated import CalibratedArm
    from elastocal.model.manipulator import Model
    from elastocal.report.page import Published
    from elastocal.units import Array

# Writing an identification's result: JSON, residual table, report.


def write_results(
    result: Calibration,
    output: Path | None,
    report: Path | None,
    residuals: Path | None,
    inputs: list[Path],
    truth: dict[str, float] | None = None,
    seed: int | None = None,
    published: Published | None = None,
) -> None:
    """Write what was asked for, each file whole or not at all.

    `inputs` are named with their hashes in the report, where `truth` and `published` (SI) stand
    beside the estimates.
    """
    if output is not None:
        atomic_write_text(output, json_text(result.to_json()) + "\n")
    if residuals is not None:
        save_residuals(result, residuals)
    if report is not None:
        from elastocal.report.page import write_identification_report

        command = shlex.join(["elastocal", *sys.argv[1:]])
        write_identification_report(
            result, report, truth=truth, command=command, inputs=inputs, seed=seed,
            published=published,
        )  # fmt: skip


# The files that `elastocal diagnose` writes: JSON, report, extra poses, extended cell.


@dataclass(frozen=True)
class Outputs:
    """Where to write what; None is not asked for."""

    json: Path | None = None
    report: Path | None = None
    plan: Path | None = None
    cell: Path | None = None

    @property
    def wanted(self) -> list[Path]:
        return [p for p in (self.json, self.report, self.plan, self.cell) if p is not None]


def write_diagnosis(
    outputs: Outputs,
    diagnosis: Diagnosis,
    content: dict[str, Any],
    model: Model,
    cell: Path,
    data: Path,
    seed: int,
) -> list[str]:
    """Write what was asked for, each file whole or not at all; a sentence per file.

    `content` is the published diagnosis; `cell` and `data` were read for it.
    """
    told = []
    if outputs.json is not None:
        atomic_write_text(outputs.json, json_text(content) + "\n")
        told.append(f"wrote {outputs.json}")
    if outputs.report is not None:
        from elastocal.report.page import write_diagnosis_report

        command = shlex.join(["elastocal", *sys.argv[1:]])
        write_diagnosis_report(
            diagnosis, model, outputs.report, data=str(data), command=command,
            inputs=[cell, data], seed=seed,
        )  # fmt: skip
        told.append(f"wrote {outputs.report}")
    if outputs.plan is not None:
        told.append(_write_plan(outputs.plan, diagnosis, model.chain.kinds))
    if outputs.cell is not None:
        from elastocal.diagnosis.extended_cell import write_extended_cell

        write_extended_cell(cell, outputs.cell, diagnosis.effects, diagnosis.model_keys)
        added = ", ".join(f"{f.effect}:{f.where}" for f in diagnosis.effects)
        told.append(f"wrote {outputs.cell} with {added or 'no further effect'}")
        if added:
            again = shlex.join(["elastocal", "identify", str(outputs.cell), str(data)])
            told.append(f"to go on: {again} -o result.json")
    return told


def _write_plan(path: Path, diagnosis: Diagnosis, kinds: Sequence[str]) -> str:
    """Write the extra poses, and say so; or why there are none to write."""
    extra = diagnosis.extra
    if extra is None:
        return f"{path} not written: there are no rivals to tell apart"
    if extra.plan is None:
        return f"{path} not written: no pose tells the rivals apart"
    from elastocal.saving import save_extra_poses

    save_extra_poses(path, extra.plan, kinds)
    return f"wrote {path}: {extra.n_poses} poses, {len(extra.plan)} visits"


# What `elastocal compensate` reads besides its tables, writes and prints.

GRID_REMEDIES = {
    "limit": "joint limits prevent it: widen [limits], or give a smaller --box or another --near",
    "not reached": "out of reach, or beside a singular posture: give a smaller --box, another "
    "--rotation or another --near",
    "no equilibrium": "no static equilibrium under this load: check --load",
}


def read_near(arm: CalibratedArm, text: str | None) -> Array | None:
    """--near as joints (n,) in rad or m."""
    import numpy as np

    from elastocal.compensation.compensate import in_file_units
    from elastocal.compensation.tool import numbers
    from elastocal.model.chain import joint_limits

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


def read_table_grid(
    arm: CalibratedArm, grid: str, box: str | None, rotation: str | None
) -> CorrectionGrid:
    """The grid that --grid, --box and --rotation ask for."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    from elastocal.compensation.correction_table import box_grid, joint_grid
    from elastocal.compensation.tool import numbers

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
    from elastocal.compensation.compensate import check_reached, commands_csv, summary

    if not partial:
        check_reached(found)
    kinds = arm.model.chain.kinds
    return summary(found, kinds, commands=listed), commands_csv(found, kinds)


def table_of(
    found: CorrectionTable, arm: CalibratedArm, partial: bool
) -> tuple[dict[str, Any], str]:
    """Summary of the correction table, and the table as CSV; refused as `commands_of` is."""
    import numpy as np

    from elastocal.compensation.compensate import check_status, in_file_units, joint_columns, spread
    from elastocal.compensation.correction_table import EXACT, FIRST_ORDER

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


# An import in words and as JSON.


def left_out(found: Imported) -> list[str]:
    """What is not in the table, in lines: rows passed over, and what found no partner."""
    lines = []
    for observed in found.understood:
        if observed.ignored:
            rows = listed((f"line {line} ({reason})" for line, reason in observed.ignored), 8)
            count = f"{len(observed.ignored)} line{'s' if len(observed.ignored) > 1 else ''}"
            lines.append(f"{observed.path}: passed over {count}: {rows}")
    if found.joined is not None and found.joined.left_out:
        rows = listed(found.joined.left_out, 12)
        lines.append(f"left out, without joint values: {len(found.joined.left_out)} points: {rows}")
    if found.joined is not None and found.joined.unused:
        rows = listed(found.joined.unused, 12)
        lines.append(f"poses without a point: {len(found.joined.unused)}: {rows}")
    return lines


def summary(found: Imported, output: Path | None) -> dict[str, Any]:
    """The preview as JSON."""
    table, joined = found.table, found.joined
    return {
        "schema": "elastocal/import/1",
        "output": None if output is None else str(output),
        "readings": len(table),
        "configurations": len(table.configuration_labels),
        "markers": list(table.marker_names),
        "columns": list(found.assembled.columns),
        "joined_by": None if joined is None else joined.how,
        "left_out": [] if joined is None else list(joined.left_out),
        "poses_without_point": [] if joined is None else list(joined.unused),
        "nominal_fit_um": None if found.fit is None else found.fit.error * 1e6,
        "files": [
            {
                "file": observed.path, "preset": observed.preset, "role": observed.role,
                "encoding": observed.encoding, "layout": observed.layout,
                "decimal": observed.decimal,
                "rows": observed.rows, "unused": list(observed.unused),
                "columns": [
                    {"from": name, "to": to, "unit": unit} for name, to, unit in observed.columns
                ],
                "ignored": [{"line": line, "reason": why} for line, why in observed.ignored],
            }
            for observed in found.understood
        ],
        "warnings": list(found.warnings),
        "refused": found.refused or None,
    }  # fmt: skip


# What an import understood, as tables for the terminal.

FIRST_ROWS = 5
MOST_COLUMNS = 14  # of the first rows, on a wide terminal


def print_preview(console: Console, found: Imported) -> None:
    """Files and their columns, the first rows, ranges, counts, what was left out, warnings."""
    for observed in found.understood:
        console.print(Text(_heading(observed), style="bold"))
        console.print(_columns_of(observed))
        if observed.unused:
            _line(console, "Not used", listed(observed.unused, 20))
        console.print()
    console.print(_first_rows(found, console.width))
    console.print(_ranges(found))
    console.print()
    for label, text in _counts(found):
        _line(console, label, text)
    for text in left_out(found):
        _line(console, "Left out", text)
    for text in found.warnings:
        _line(console, "Warning", text)


def _line(console: Console, label: str, text: str) -> None:
    style = "bold yellow" if label == "Warning" else "bold"
    console.print(Text.assemble((f"{label}: ", style), printable(text)))


def _heading(observed: Understood) -> str:
    kind = {"points": "points", "joints": "joint values", "both": "points and joint values"}
    preset = f"preset {observed.preset}, " if observed.preset else ""
    decimals = ", decimal commas" if observed.decimal == "," else ""
    return printable(
        f"{observed.path}: {counted(observed.rows, 'row')} of {kind[observed.role]} "
        f"({preset}{observed.encoding}, "
        f"{observed.layout}{decimals})"
    )


def _columns_of(observed: Understood) -> Table:
    table = titled("")
    table.title = None
    for head in ("in the file", "read as", "unit"):
        table.add_column(head, overflow="fold")
    for name, column, unit in observed.columns:
        table.add_row(*(Text(printable(text)) for text in (name, column, unit or "–")))
    return table


def _first_rows(found: Imported, width: int) -> Table:
    columns = found.assembled.columns
    shown = [name for name in columns if name != "note_source"][
        : max(4, min(MOST_COLUMNS, width // 10))
    ]
    rest = len(columns) - len(shown)
    more = f", {rest} more columns" if rest else ""
    table = titled(f"The first rows of the table{more}")
    for name in shown:
        numeric = isinstance(columns[name], np.ndarray)
        table.add_column(name, justify="right" if numeric else "left", overflow="fold")
    for i in range(min(FIRST_ROWS, len(found.assembled))):
        table.add_row(*(Text(_cell(columns[name], i)) for name in shown))
    return table


def _cell(values: Sequence[str] | np.ndarray, i: int) -> str:
    if not isinstance(values, np.ndarray):
        return printable(values[i])
    return f"{values[i]:d}" if values.dtype.kind == "i" else f"{values[i]:.6g}"


def _ranges(found: Imported) -> Table:
    table = titled("Ranges")
    for head in ("column", "least", "largest"):
        table.add_column(head, justify="left" if head == "column" else "right", overflow="fold")
    for name, values in found.assembled.columns.items():
        if isinstance(values, np.ndarray) and name != "repeat":
            table.add_row(Text(name), Text(f"{values.min():.6g}"), Text(f"{values.max():.6g}"))
    return table


def _counts(found: Imported) -> list[tuple[str, str]]:
    table, joined = found.table, found.joined
    forces, sizes = np.unique(table.force, axis=0, return_counts=True)
    loads = "; ".join(
        f"{'unloaded' if not f.any() else '(' + ', '.join(f'{v:g}' for v in f) + ') N'}: "
        f"{counted(int(n), 'reading')}"
        for f, n in zip(forces[:8], sizes, strict=False)
    )
    repeats = np.unique(
        np.column_stack([table.configuration, table.marker, table.force]), axis=0,
        return_counts=True,
    )[1]  # fmt: skip
    span = f"{repeats.min()}" if repeats.min() == repeats.max() else (
        f"{repeats.min()} to {repeats.max()}"
    )  # fmt: skip
    lines = [
        ("Table", f"{counted(len(table), 'reading')} of "
         f"{counted(len(table.configuration_labels), 'configuration')}, {span} per configuration, "
         "marker and load"),
        ("Markers", listed(table.marker_names, 20)),
        ("Loads", loads + (f"; {len(forces) - 8} more" if len(forces) > 8 else "")),
    ]  # fmt: skip
    if joined is not None:
        remarks = [r for r in joined.remarks if not r.startswith("WARNING: ")]
        lines.append(("Joined", "; ".join([f"by {joined.how}", *remarks])))
    if table.time is not None:
        lines.append(("Time", f"{table.time.max():.6g} s from the first reading to the last"))
    if found.fit is not None:
        lines.append(("Nominal arm", f"readings fit it to {found.fit.error * 1e3:.3g} mm (median, "
                      "base and markers fitted)"))  # fmt: skip
    return lines
