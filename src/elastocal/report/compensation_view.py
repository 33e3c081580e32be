"""What compensated commands and readings say, as blocks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from elastocal.compensation.compensate import in_file_units, joint_columns, summary
from elastocal.report.blocks import (
    WARNING,
    Block,
    Figure,
    Fold,
    Lines,
    Report,
    Sentence,
    ShownTable,
)
from elastocal.report.formatting import length
from elastocal.text import printable

if TYPE_CHECKING:
    from elastocal.compensation.compensate import Compensation
    from elastocal.measurements import Measurements

MOST_ROWS = 40  # drawn, and shown of tables


def compensation_report(c: Compensation) -> Report:
    """Commands for targets: the predicted errors, the commands, what is not reached."""
    return Report("Compensation", printable(c.chain.name), _blocks(c))


def _blocks(c: Compensation) -> Iterator[Block]:
    yield from compensation_blocks({"commands": summary(c, c.chain.kinds, commands=False)})
    yield Fold("", lambda: [_errors(c)], figures=("errors",))
    yield Fold("Commands", lambda: [_commands(c)])


def compensation_blocks(content: dict[str, Any]) -> Iterator[Block]:
    """Errors before and after, uncertainty and warnings.

    `content`: the summary of the `commands`, that of the correction `table`, or both.
    """
    commands, table = content.get("commands"), content.get("table")
    if commands is not None:
        rows = {
            "nominal command": commands["error_before_um"],
            "new command": commands["error_after_um"],
            "standard uncertainty": commands["std_um"],
            "within, at 95 %": commands["within95_um"],
        }
        yield _spreads("Position of the tool, predicted", rows)
        for k, command in enumerate(commands.get("commands", ())):
            joints = ", ".join(f"{n} {v:.6f}" for n, v in command.items() if n != "status")
            yield Sentence(f"target {k + 1}: {joints or command['status']}")
        yield Sentence(
            f"{commands['reached']} of {commands['n']} targets reached by the {commands['point']}; "
            f"targets in the {commands['frame']} frame."
        )
        yield Lines([(WARNING, text) for text in commands["warnings"]])
    if table is not None:
        rows = {"without the table": table["error_without_um"]}
        rows["with it, interpolated"] = table["error_with_um"]
        yield _spreads(
            f"Position of the tool at {table['checked_between']} points between the grid's", rows
        )
        yield Sentence(
            f"{table['points']} grid points: {table['exact']} exact, {table['first_order']} of "
            "first order (beside singular postures or limits)."
        )


def _spreads(title: str, rows: dict[str, dict[str, Any]]) -> ShownTable:
    cells = [
        (name, *("–" if v is None else _fine_length(v) for v in values.values()))
        for name, values in rows.items()
    ]
    return ShownTable(("", "rms", "95 %", "max"), cells, title=title)


def _fine_length(um: float) -> str:
    return "< 0.01 µm" if um < 0.01 else length(um * 1e-6)


def _commands(c: Compensation) -> ShownTable:
    table, kinds = c.targets.table, c.chain.kinds
    q, std = in_file_units(c.q, kinds), c.uncertainty.std * 1e6
    rows = []
    for i, status in enumerate(c.status[:MOST_ROWS]):
        numbers = [f"{v:.4f}" if np.isfinite(v) else "–" for v in q[i]]
        sure = f"{std[i]:.2f}" if np.isfinite(std[i]) else "–"
        name = table.configuration_labels[table.configuration[i]]
        rows.append((printable(name), *numbers, sure, printable(status)))
    heads = ("configuration", *joint_columns(kinds), "std_um", "status")
    more = len(c.status) - len(rows)
    note = f"and {more} more in the file of commands" if more else ""
    return ShownTable(heads, rows, (0, len(heads) - 1), note=note)


def _errors(c: Compensation) -> Figure:
    from elastocal.report.figures import rows_of_dots

    table, no_ends = c.targets.table, (np.nan, np.nan)
    rows = [
        (table.configuration_labels[table.configuration[i]], float(c.before[i]) * 1e6, no_ends, "")
        for i in np.flatnonzero(c.reached)[:MOST_ROWS]
    ]
    axis = "error at the nominal command"
    return rows_of_dots("errors", f"Targets: {axis}", rows, axis, lengths=True)


def readings_report(table: Measurements) -> Report:
    """What a table has of each column: labels are counted, numbers from least to largest."""
    return Report("Readings", printable(table.source), _of_readings(table))


def _of_readings(table: Measurements) -> Iterator[Block]:
    rows = [
        (printable(name), str(len(np.unique(values.astype(str)))), "", "")
        if values.dtype == object
        else (name, str(len(np.unique(values))), f"{values.min():.6g}", f"{values.max():.6g}")
        for name, values in table.columns().items() if len(values)
    ]  # fmt: skip
    heads = ("column", "different", "least", "largest")
    yield ShownTable(heads, rows, title=f"{len(table)} rows of {printable(table.source)}")
    yield Fold("", lambda: [_joints(table)], figures=("joints",))


def _joints(table: Measurements) -> Figure:
    """Where each joint stood: the middle of its values, and from end to end."""
    from elastocal.report.figures import rows_of_dots

    q = in_file_units(table.q, table.kinds)
    ends = np.column_stack([q.min(axis=0), q.max(axis=0)]) if len(q) else np.zeros((q.shape[1], 2))
    rows = [
        (name, float(np.mean(e)), (float(e[0]), float(e[1])), "")
        for name, e in zip(joint_columns(table.kinds), ends, strict=True)
    ]
    axis = "middle and ends of the values, in ° or mm"
    return rows_of_dots("joints", "Where each joint stood", rows, axis)
