"""Results as plain text and for the terminal: tables and lines."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from io import StringIO
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from elastocal.errors import option
from elastocal.identification.findings import ALONE
from elastocal.identification.result import Calibration
from elastocal.report.formatting import ShownTable, capital, length
from elastocal.report.identification_view import (
    ParameterRow,
    Truth,
    any_lopsided,
    combination_rows,
    half_head,
    leading_lines,
    names_of,
    parameter_rows,
    summary_lines,
    undetermined_lines,
)
from elastocal.report.method_and_noise import candidate_rows, size_rows
from elastocal.screen import safe_console

PRINTED_WIDTH = 100  # columns of a result as plain text


def printed_text(show: Callable[[Console, Any], None], result: Any) -> str:
    """What `show` prints of a result, without colours and trailing blanks."""
    console = safe_console(file=StringIO(), width=PRINTED_WIDTH, color_system=None)
    with console.capture() as capture:
        show(console, result)
    return "\n".join(line.rstrip() for line in capture.get().rstrip().splitlines())


def titled(title: str | None) -> Table:
    """An empty table under a title, with a rule below its heads and no frame."""
    return Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=SIMPLE_HEAD,
        pad_edge=False,
        collapse_padding=True,
    )


def table_of(title: str | None, shown: ShownTable, whole: bool = False) -> Table:
    """For the terminal: words to the left, numbers to the right.

    Where numbers have to be `whole`, only joints and words may wrap.
    """
    table = titled(title)
    for k, head in enumerate(shown.heads):
        words = k in shown.words
        wraps = not whole or (words and head != "unit") or head.startswith("q")
        whole_words = words and (not k or head == "unit")
        least = longest_word(row[k] for row in shown.rows) if whole_words else None
        table.add_column(head, justify="left" if words else "right", min_width=least,
                         overflow="fold" if wraps else "ellipsis")  # fmt: skip
    for row in shown.rows:
        table.add_row(*map(Text, row))
    return table


LONGEST_WHOLE = 28  # letters; a longer name breaks where its column ends


def longest_word(texts: Iterable[str]) -> int | None:
    """How wide a column of names has to be for none to break within a word."""
    longest = max((len(word) for text in texts for word in text.split()), default=0)
    return longest if longest <= LONGEST_WHOLE else None


def print_lines(
    console: Console, lines: Iterable[tuple[str, str]], yellow: str = "Warning"
) -> None:
    for label, text in lines:
        style = "bold yellow" if label == yellow else "bold"
        console.print(Text.assemble((f"{label}: ", style), text))


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
    notes = undetermined or any(e.note for e in result.ordinary if e.identifiable)
    lopsided = any_lopsided(result.ordinary)
    least = longest_word(e.name for e in result.ordinary if e.identifiable or undetermined)
    table = _numbers_table("Parameters", "parameter", truth is not None, brief, lopsided, least)
    if not brief:
        table.add_column("nominal", justify="right", overflow="fold")
    if notes:
        table.add_column("note", overflow="fold")
    for row in parameter_rows(result, truth):
        if row.determined or undetermined:
            cells = _numbers(row, truth is not None, brief, lopsided)
            cells += [] if brief else [Text(row.nominal)]
            cells += [Text(row.note, style="dim")] if notes else []
            table.add_row(*cells)
    return table


def combination_table(
    result: Calibration, truth: Truth | None = None, brief: bool = False
) -> Table:
    """Sums of parameters that the data determine although their members they do not."""
    lopsided, compared = any_lopsided(result.combinations), truth is not None
    title = "Combinations (factors in SI units)"
    table = _numbers_table(title, "combination", compared, brief, lopsided)
    for row in combination_rows(result, truth):
        table.add_row(*_numbers(row, compared, brief, lopsided))
    return table


def _numbers_table(
    title: str, first: str, compared: bool, brief: bool, lopsided: bool, least: int | None = None
) -> Table:
    half = half_head(lopsided)
    table = titled(title)
    table.add_column(first, overflow="fold", min_width=least)
    for name in (f"value {half}",) if brief else ("value", half):
        table.add_column(name, justify="left" if brief else "right", overflow="fold")
    if not brief:
        table.add_column("unit", overflow="fold")
    if compared and not brief:
        table.add_column("truth", justify="right", overflow="fold")
    if compared:
        table.add_column("in 95 %", overflow="fold")
    return table


def _numbers(row: ParameterRow, compared: bool, brief: bool, lopsided: bool) -> list[Text]:
    """Cells of name, value, interval and unit and, where `compared`, true value and verdict.

    `lopsided` says whether the column's head has no "±", which then stands with the number.
    """
    tail = [Text(row.verdict, style=STYLE.get(row.verdict, ""))] if compared else []
    if brief:
        text = row.value if row.value == "–" else f"{row.value} {row.interval} {row.unit}"
        return [Text(row.name), Text(text), *tail]
    half = row.interval if lopsided else row.half
    cells = [row.name, row.value, half, row.unit, *([row.truth] if compared else [])]
    return [*map(Text, cells), *tail]


def noise_tables(result: Calibration) -> list[Table]:
    """Sizes of the estimated noise, and the noise models tried with their criterion over the best.

    A table that would have a single row is left out: the summary says it.
    """
    sizes = ShownTable(("part", "size"), size_rows(result.noise))
    heads = ("noise model", "variances", "criterion over best")
    tried = ShownTable(heads, candidate_rows(result.noise))
    named = (("Noise, standard deviations", sizes), ("Noise models tried", tried))
    return [table_of(title, table) for title, table in named if len(table.rows) > 1]


def print_result(
    console: Console, result: Calibration, truth: Truth | None = None, details: bool = False
) -> None:
    """Verdict, errors and what to do; single estimates and combinations; the rest in words.

    Without `details` long lists are cut short, and noise, method and intervals left out.
    """
    print_lines(console, leading_lines(result))
    console.print()
    brief = console.width < NARROW
    alone = len(names_of(result, ALONE))
    listed = console.width >= WIDE and 0 < len(result.ordinary) - alone <= FEW
    if alone or listed:
        console.print(parameter_table(result, truth, listed, brief))
    if result.combinations and (details or len(result.combinations) <= FEW):
        console.print(combination_table(result, truth, brief))
    for line in undetermined_lines(result, None if details else FEW):
        console.print(Text(line, style="dim"))
    for table in noise_tables(result) if details else ():
        console.print(table)
    console.print()
    print_lines(console, summary_lines(result, truth, details))
    if not details:
        more = f"{option('details', True)} tells of method, noise, residuals, intervals"
        console.print(Text(f"{more} and every combination; so does the report.", style="dim"))


def print_told(console: Console, lines: Iterable[tuple[str, str]], yellow: str = "Warning") -> None:
    print_lines(console, ((label, capital(text)) for label, text in lines), yellow)


def print_compensation(console: Console, content: dict[str, Any]) -> None:
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
        _print_spreads(console, "Position of the tool, predicted", rows)
        for k, command in enumerate(commands.get("commands", ())):
            joints = ", ".join(f"{n} {v:.6f}" for n, v in command.items() if n != "status")
            console.print(f"target {k + 1}: {joints or command['status']}")
        console.print(
            f"{commands['reached']} of {commands['n']} targets reached by the {commands['point']}; "
            f"targets in the {commands['frame']} frame.",
            markup=False,  # a marker may be called [red]
        )
        for told in commands["warnings"]:
            console.print(f"Warning: {told}", markup=False)
    if table is not None:
        rows = {"without the table": table["error_without_um"]}
        rows["with it, interpolated"] = table["error_with_um"]
        title = f"Position of the tool at {table['checked_between']} points between the grid's"
        _print_spreads(console, title, rows)
        console.print(
            f"{table['points']} grid points: {table['exact']} exact, {table['first_order']} of "
            "first order (beside singular postures or limits)."
        )


def _fine_length(um: float) -> str:
    return "< 0.01 µm" if um < 0.01 else length(um * 1e-6)


def _print_spreads(console: Console, title: str, rows: dict[str, dict[str, Any]]) -> None:
    cells = [
        (name, *("–" if v is None else _fine_length(v) for v in values.values()))
        for name, values in rows.items()
    ]
    console.print(table_of(title, ShownTable(("", "rms", "95 %", "max"), cells)))
