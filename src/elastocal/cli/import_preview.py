"""An import in words and as JSON, and what it understood as tables for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text

from elastocal.importing.assemble import Imported
from elastocal.importing.records import Understood
from elastocal.report.blocks import WARNING, Lines, ShownTable
from elastocal.report.formatting import counted
from elastocal.report.terminal import print_blocks
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


# What an import understood, as blocks for the terminal.

FIRST_ROWS = 5
MOST_COLUMNS = 14  # of the first rows, on a wide terminal


def print_preview(console: Console, found: Imported) -> None:
    """Files and their columns, the first rows, ranges, counts, what was left out, warnings."""
    for observed in found.understood:
        console.print(Text(_heading(observed), style="bold"))
        rows = [(name, column, unit or "–") for name, column, unit in observed.columns]
        unused = [("Not used", listed(observed.unused, 20))] if observed.unused else []
        heads = ("in the file", "read as", "unit")
        print_blocks(console, [ShownTable(heads, rows, (0, 1, 2)), Lines(unused)])
        console.print()
    columns = found.assembled.columns
    most = max(4, min(MOST_COLUMNS, console.width // 10))
    shown = [name for name in columns if name != "note_source"][:most]
    rest = len(columns) - len(shown)
    words = tuple(k for k, n in enumerate(shown) if not isinstance(columns[n], np.ndarray))
    first = range(min(FIRST_ROWS, len(found.assembled)))
    ranges = [
        (name, f"{values.min():.6g}", f"{values.max():.6g}")
        for name, values in columns.items()
        if isinstance(values, np.ndarray) and name != "repeat"
    ]
    title = "The first rows of the table" + (f", {rest} more columns" if rest else "")
    print_blocks(console, [
        ShownTable(tuple(shown), [tuple(_cell(columns[n], i) for n in shown) for i in first],
                   words, title=title),
        ShownTable(("column", "least", "largest"), ranges, title="Ranges"),
        Lines([
            *_counts(found),
            *(("Left out", text) for text in left_out(found)),
            *((WARNING, text) for text in found.warnings),
        ]),
    ])  # fmt: skip


def _heading(observed: Understood) -> str:
    kind = {"points": "points", "joints": "joint values", "both": "points and joint values"}
    preset = f"preset {observed.preset}, " if observed.preset else ""
    decimals = ", decimal commas" if observed.decimal == "," else ""
    return printable(
        f"{observed.path}: {counted(observed.rows, 'row')} of {kind[observed.role]} "
        f"({preset}{observed.encoding}, {observed.layout}{decimals})"
    )


def _cell(values: Sequence[str] | np.ndarray, i: int) -> str:
    if not isinstance(values, np.ndarray):
        return printable(values[i])
    return f"{values[i]:d}" if values.dtype.kind == "i" else f"{values[i]:.6g}"


def _counts(found: Imported) -> list[tuple[str, str]]:
    table, joined = found.table, found.joined
    forces, sizes = np.unique(table.force, axis=0, return_counts=True)
    names = [
        "(" + ", ".join(f"{v:g}" for v in f) + ") N" if f.any() else "unloaded" for f in forces
    ]
    loads = [f"{name}: {counted(int(n), 'reading')}" for name, n in zip(names, sizes, strict=True)]
    more = [f"{len(loads) - 8} more"] if len(loads) > 8 else []
    alike = np.column_stack([table.configuration, table.marker, table.force])
    repeats = np.unique(alike, axis=0, return_counts=True)[1]
    span = " to ".join(dict.fromkeys((str(repeats.min()), str(repeats.max()))))
    lines = [
        ("Table", f"{counted(len(table), 'reading')} of "
         f"{counted(len(table.configuration_labels), 'configuration')}, {span} per configuration, "
         "marker and load"),
        ("Markers", listed(table.marker_names, 20)),
        ("Loads", "; ".join(loads[:8] + more)),
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
