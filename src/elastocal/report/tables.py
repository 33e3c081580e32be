"""An identification's result as tables and lines for the terminal."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from elastocal.identification.result import Calibration, Combination, Estimate
from elastocal.report.console_table import titled
from elastocal.report.noise import candidate_rows, size_rows
from elastocal.report.rows import any_lopsided, half_head, signed_half, texts
from elastocal.report.trust import judgement, without_sections
from elastocal.report.units import display, plain
from elastocal.report.verdict import summary_lines
from elastocal.report.words import (
    ALONE,
    Truth,
    combination_truth,
    inside,
    names_of,
    nominal_known,
    printable,
    short_note,
    shortened,
    undetermined_lines,
)

__all__ = [
    "combination_table",
    "noise_tables",
    "parameter_table",
    "print_result",
    "summary_lines",
]

NARROW = 80  # columns; below, each number shares one column with its interval and unit
WIDE = 110  # columns; from here on a note fits beside the numbers
FEW = 6  # parameters without a number of their own, which the table then lists one by one
STYLE = {"inside": "green", "outside": "bold red"}


def parameter_table(
    result: Calibration,
    truth: Truth | None = None,
    undetermined: bool = True,
    brief: bool = False,
) -> Table:
    """Parameters with 95 % half widths; "–" and a note for what the data do not determine.

    Where an interval is lopsided or has no end, the ends stand instead of the half width.

    `truth` (SI) adds true values and whether the interval holds them.  `undetermined` False
    leaves out parameters that have no number of their own.  `brief` is for narrow terminals:
    value, interval and unit in one column, neither nominal nor true value.
    """
    notes = undetermined or any(e.note for e in result.estimates if e.identifiable)
    lopsided = any_lopsided(result.estimates)
    table = _table("Parameters", "parameter", truth, brief, lopsided)
    if not brief:
        table.add_column("nominal", justify="right", overflow="fold")
    if notes:
        table.add_column("note", overflow="fold")
    for e in result.estimates:
        if not (e.identifiable or undetermined):
            continue
        true = None if truth is None else truth.get(e.name)
        row = [Text(printable(e.name))]
        row += _numbers(e, true, truth is not None, brief, lopsided)
        if not brief:
            known = nominal_known(result, e.name)
            row.append(Text(plain(display(e.nominal, e.unit)[0]) if known else "–"))
        if notes:
            row.append(Text(short_note(result, e), style="dim"))
        table.add_row(*row)
    return table


def combination_table(
    result: Calibration, truth: Truth | None = None, brief: bool = False
) -> Table:
    """Sums of parameters that the data determine although their members they do not."""
    lopsided = any_lopsided(result.combinations)
    table = _table("Combinations (factors in SI units)", "combination", truth, brief, lopsided)
    for c in result.combinations:
        true = None if truth is None else combination_truth(result, c, truth)
        numbers = _numbers(c, true, truth is not None, brief, lopsided)
        table.add_row(Text(shortened(c)), *numbers)
    return table


def noise_tables(result: Calibration) -> list[Table]:
    """Sizes of the estimated noise, and the noise models tried with their criterion over the best.

    A table that would have a single row is left out: the summary says it.
    """
    tables = []
    if len(sizes := size_rows(result.noise)) > 1:
        table = _plain("Noise, standard deviations", "part")
        table.add_column("size", justify="right", overflow="fold")
        for row in sizes:
            table.add_row(*map(Text, row))
        tables.append(table)
    if len(candidates := candidate_rows(result.noise)) > 1:
        table = _plain("Noise models tried", "noise model")
        table.add_column("variances", justify="right", overflow="fold")
        table.add_column("criterion over best", justify="right", overflow="fold")
        for candidate in candidates:
            table.add_row(*map(Text, candidate))
        tables.append(table)
    return tables


def print_result(console: Console, result: Calibration, truth: Truth | None = None) -> None:
    """Single estimates, combinations, what is not determined, and the summary in words."""
    brief = console.width < NARROW
    alone = len(names_of(result, ALONE))
    listed = console.width >= WIDE and 0 < len(result.estimates) - alone <= FEW
    if alone or listed:
        console.print(parameter_table(result, truth, listed, brief))
    if result.combinations:
        console.print(combination_table(result, truth, brief))
    for line in undetermined_lines(result):
        console.print(Text(line, style="dim"))
    for table in noise_tables(result):
        console.print(table)
    console.print()
    for line in summary_lines(result, truth):
        label, colon, rest = line.partition(": ")
        style = "bold yellow" if label == "Warning" else "bold"
        console.print(Text.assemble((label + colon, style), rest))
    judged = judgement(result)
    console.print(Text.assemble(("Verdict: ", "bold"), printable(judged.headline)))
    for step in judged.steps:
        console.print(Text.assemble(("Next: ", "bold"), printable(without_sections(step))))


def _table(title: str, first: str, truth: Truth | None, brief: bool, lopsided: bool) -> Table:
    table = _plain(title, first)
    if brief:
        table.add_column(f"value {half_head(lopsided)}", overflow="fold")
    else:
        for name in ("value", half_head(lopsided)):
            table.add_column(name, justify="right", overflow="fold")
        table.add_column("unit", overflow="fold")
    if truth is not None:
        if not brief:
            table.add_column("truth", justify="right", overflow="fold")
        table.add_column("in 95 %", overflow="fold")
    return table


def _plain(title: str, first: str) -> Table:
    table = titled(title)
    table.add_column(first, overflow="fold")
    return table


def _numbers(
    e: Estimate | Combination, true: float | None, compared: bool, brief: bool, lopsided: bool
) -> list[Text]:
    """Cells of value, interval and unit and, where `compared`, true value and verdict.

    `lopsided` says whether the column's head has no "±", which then stands with the number.
    """
    value, half, unit, known = texts(e, true)
    verdict = inside(true, e.ci95)
    tail = [Text(verdict, style=STYLE.get(verdict, ""))] if compared else []
    if brief:
        text = value if e.value is None else f"{value} {signed_half(half)} {unit}"
        return [Text(text), *tail]
    half = signed_half(half) if lopsided else half
    return [Text(value), Text(half), Text(unit), *([Text(known), *tail] if compared else [])]
