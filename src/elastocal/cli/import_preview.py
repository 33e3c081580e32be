"""An import in words and as JSON, and what it understood as tables for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from elastocal.importing.assemble import Imported
from elastocal.importing.records import Understood
from elastocal.report import blocks
from elastocal.report.formatting import counted
from elastocal.report.terminal import table_of
from elastocal.text import listed, printable


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
    rows = [
        (printable(name), printable(column), printable(unit or "–"))
        for name, column, unit in observed.columns
    ]
    return table_of(blocks.ShownTable(("in the file", "read as", "unit"), rows, (0, 1, 2)))


def _first_rows(found: Imported, width: int) -> Table:
    columns = found.assembled.columns
    shown = [name for name in columns if name != "note_source"][
        : max(4, min(MOST_COLUMNS, width // 10))
    ]
    rest = len(columns) - len(shown)
    more = f", {rest} more columns" if rest else ""
    words = [k for k, name in enumerate(shown) if not isinstance(columns[name], np.ndarray)]
    rows = [
        tuple(_cell(columns[name], i) for name in shown)
        for i in range(min(FIRST_ROWS, len(found.assembled)))
    ]
    title = f"The first rows of the table{more}"
    return table_of(blocks.ShownTable(tuple(shown), rows, tuple(words), title=title))


def _cell(values: Sequence[str] | np.ndarray, i: int) -> str:
    if not isinstance(values, np.ndarray):
        return printable(values[i])
    return f"{values[i]:d}" if values.dtype.kind == "i" else f"{values[i]:.6g}"


def _ranges(found: Imported) -> Table:
    rows = [
        (name, f"{values.min():.6g}", f"{values.max():.6g}")
        for name, values in found.assembled.columns.items()
        if isinstance(values, np.ndarray) and name != "repeat"
    ]
    return table_of(blocks.ShownTable(("column", "least", "largest"), rows, title="Ranges"))


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
