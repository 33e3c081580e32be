"""An identification's result as tables and lines for the terminal."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from elastocal.identification.result import IdentificationResult
from elastocal.report.units import display, estimate, plain
from elastocal.report.verdict import summary_lines
from elastocal.report.words import (
    ABSORBED,
    ALONE,
    FIXED,
    INVISIBLE,
    Truth,
    combination_truth,
    held_where,
    inside,
    names_of,
    nominal_known,
    printable,
    short_note,
    shortened,
)

__all__ = ["combination_table", "parameter_table", "print_result", "summary_lines"]

NARROW = 80  # columns; below, nominal values and notes would squeeze the numbers
FEW = 6  # parameters without a number of their own, which the table may list one by one
STYLE = {"inside": "green", "outside": "bold red"}


def parameter_table(
    result: IdentificationResult,
    truth: Truth | None = None,
    undetermined: bool = True,
    brief: bool = False,
) -> Table:
    """Parameters with 95 % half widths; "–" and a note for what the data do not determine.

    `truth` (SI) adds true values and whether the interval holds them.  `undetermined` False
    leaves out parameters that have no number of their own; `brief` drops nominal and note.
    """
    notes = not brief and (undetermined or any(e.note for e in result.estimates if e.identifiable))
    table = _table("Parameters", "parameter")
    _number_columns(table, truth)
    if not brief:
        table.add_column("nominal", justify="right", overflow="fold")
    if notes:
        table.add_column("note", overflow="fold")
    for e in result.estimates:
        if not (e.identifiable or undetermined):
            continue
        cells = _numbers(e.value, e.ci95, e.unit, None if truth is None else truth.get(e.name))
        row = [Text(printable(e.name)), *(cells if truth is not None else cells[:3])]
        if not brief:
            known = nominal_known(result, e.name)
            row.append(Text(plain(display(e.nominal, e.unit)[0]) if known else "–"))
        if notes:
            row.append(Text(short_note(result, e), style="dim"))
        table.add_row(*row)
    return table


def combination_table(result: IdentificationResult, truth: Truth | None = None) -> Table:
    """Sums of parameters that the data determine although their members they do not."""
    table = _table("Combinations (factors in SI units)", "combination")
    _number_columns(table, truth)
    for c in result.combinations:
        true = None if truth is None else combination_truth(result, c, truth)
        cells = _numbers(c.value, c.ci95, c.unit, true)
        table.add_row(Text(shortened(c)), *(cells if truth is not None else cells[:3]))
    return table


def undetermined_lines(result: IdentificationResult) -> list[str]:
    """Which parameters have no number of their own, and why, one line per reason."""
    lines = []
    if names := names_of(result, INVISIBLE):
        where = held_where(result, names)
        lines.append(f"{where} (not visible in these data): {', '.join(names)}")
    if names := names_of(result, ABSORBED):
        where = held_where(result, names)
        lines.append(f"{where}, absorbed in a combination: {', '.join(names)}")
    if names := names_of(result, FIXED):
        lines.append(f"fixed by the user: {', '.join(names)}")
    return lines


def print_result(
    console: Console, result: IdentificationResult, truth: Truth | None = None
) -> None:
    """Single estimates, combinations, what is not determined, and the summary in words."""
    brief = console.width < NARROW
    left_out = len(result.estimates) - len(names_of(result, ALONE))
    listed = 0 < left_out <= FEW
    if names_of(result, ALONE) or listed:
        console.print(parameter_table(result, truth, listed, brief))
    if result.combinations:
        console.print(combination_table(result, truth))
    for line in undetermined_lines(result):
        console.print(Text(line, style="dim"))
    console.print()
    for line in summary_lines(result, truth):
        label, colon, rest = line.partition(": ")
        style = "bold yellow" if label == "Warning" else "bold"
        console.print(Text.assemble((label + colon, style), rest))


def _table(title: str, first: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column(first, overflow="fold")
    return table


def _number_columns(table: Table, truth: Truth | None) -> None:
    for name in ("value", "± 95 %"):
        table.add_column(name, justify="right", overflow="fold")
    table.add_column("unit", overflow="fold")
    if truth is not None:
        table.add_column("truth", justify="right", overflow="fold")
        table.add_column("95 %", overflow="fold")


def _numbers(
    value: float | None, ci95: tuple[float, float] | None, unit: str, true: float | None
) -> list[Text]:
    """Cells: value, half width, unit, true value, inside or outside."""
    shown = "–" if true is None else plain(display(true, unit)[0])
    if value is None or ci95 is None:
        return [Text("–"), Text("–"), Text(display(0.0, unit)[1]), Text(shown), Text("")]
    number, half, text = estimate(value, (ci95[1] - ci95[0]) / 2, unit)
    verdict = inside(true, ci95)
    return [
        Text(number), Text(half), Text(text), Text(shown),
        Text(verdict, style=STYLE.get(verdict, "")),
    ]  # fmt: skip
