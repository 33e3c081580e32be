"""An import in words and as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from elastocal.importing.import_files import Imported
from elastocal.text import listed


def left_out(found: Imported) -> list[str]:
    """What is not in the table, in lines: rows passed over, and what found no partner."""
    lines = []
    for seen in found.understood:
        if seen.ignored:
            rows = listed((f"line {line} ({reason})" for line, reason in seen.ignored), 8)
            count = f"{len(seen.ignored)} line{'s' if len(seen.ignored) > 1 else ''}"
            lines.append(f"{seen.path}: passed over {count}: {rows}")
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
                "file": seen.path, "preset": seen.preset, "role": seen.role,
                "encoding": seen.encoding, "layout": seen.layout, "decimal": seen.decimal,
                "rows": seen.rows, "unused": list(seen.unused),
                "columns": [
                    {"from": name, "to": to, "unit": unit} for name, to, unit in seen.columns
                ],
                "ignored": [{"line": line, "reason": why} for line, why in seen.ignored],
            }
            for seen in found.understood
        ],
        "warnings": list(found.warnings),
        "refused": found.refused or None,
    }  # fmt: skip
