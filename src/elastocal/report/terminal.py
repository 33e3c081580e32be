"""The report of a result of any kind, and its blocks as plain text and for the terminal."""

from __future__ import annotations

from collections.abc import Iterable
from io import StringIO
from typing import TYPE_CHECKING, Any, cast

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from elastocal.errors import option
from elastocal.report.blocks import (
    WARNING,
    Block,
    Heading,
    Lines,
    Report,
    Sentence,
    ShownTable,
    ShownVerdict,
    unfolded,
)
from elastocal.screen import safe_console
from elastocal.text import printable

if TYPE_CHECKING:
    from rich.console import RenderableType


def report_of(result: object, certificate: bool = False, **told: Any) -> Report:
    """What is to be said of a result.  Each kind has its view, which no other result loads."""
    kind, report = type(result).__name__, cast(Any, None)
    if certificate:
        from elastocal.report.certificate_view import certificate_report as report
    elif kind == "Calibration":
        from elastocal.report.identification_view import calibration_report as report
    elif kind == "Diagnosis":
        from elastocal.report.diagnosis_view import diagnosis_report as report
    elif kind == "Plan":
        from elastocal.report.plan_view import plan_report as report
    elif kind == "NextPoses":
        from elastocal.report.plan_view import next_report as report
    elif kind == "Comparison":
        from elastocal.report.smaller_views import changes_report as report
    elif kind == "Compensation":
        from elastocal.report.smaller_views import compensation_report as report
    else:
        from elastocal.report.smaller_views import readings_report as report
    found: Report = report(result, **told)
    return found


PRINTED_WIDTH = 100  # columns of a result as plain text
WIDEST = 1000  # columns; more than any table needs
STYLES = {"inside": "green", "outside": "bold red", "changed": "bold yellow"}
LONGEST_WHOLE = 28  # letters; a longer name breaks where its column ends


def print_report(console: Console, result: object, details: bool = True, **told: Any) -> None:
    """Show a result: what stands open in its report, and unless `details` are left out what is
    folded and `printed`."""
    print_blocks(console, report_of(result, **told).blocks, details)
    if not details:
        more = f"{option('details', True)} tells of method, noise, residuals, intervals"
        console.print(Text(f"{more} and every combination; so does the report.", style="dim"))


def printed_text(result: object) -> str:
    """A result as the command line prints it, without colours and trailing blanks."""
    console = safe_console(file=StringIO(), width=PRINTED_WIDTH, color_system=None)
    with console.capture() as capture:
        print_report(console, result)
    return "\n".join(line.rstrip() for line in capture.get().rstrip().splitlines())


def print_blocks(console: Console, blocks: Iterable[Block], details: bool = False) -> None:
    """Print blocks; a blank line separates tables from sentences."""
    heading, before = "", None
    for block in unfolded(blocks, lambda fold: details and fold.printed):
        if isinstance(block, Heading):
            heading = block.text
        elif shown := list(_shown(console, block)):
            kind = Lines if isinstance(block, ShownVerdict) else type(block)
            if before not in (None, kind, ShownTable):  # a table ends with one
                console.print()
            if heading and _needs(heading, block):
                console.print(Text(heading, style="bold underline"))
            for each in shown:
                console.print(each)
            heading, before = "", kind


def _needs(heading: str, block: Block) -> bool:
    """Whether the heading says more than the block below it."""
    told = block.title if isinstance(block, ShownTable) else ""
    if isinstance(block, Lines):
        told = block.items[0][0]
    return not (told and heading.startswith(told.partition(" (")[0].partition(",")[0]))


def _shown(console: Console, block: Block) -> Iterable[RenderableType]:
    if isinstance(block, ShownVerdict):
        style = "bold" if block.tone == "good" else "bold yellow"
        yield _line("Verdict", block.sentence, style)
    elif isinstance(block, Lines):
        for label, text in block.items:
            yield _line(label, text, "bold yellow" if label == WARNING else "bold")
    elif isinstance(block, Sentence):
        yield Text(printable(block.text), style="dim" if block.soft else "")
    elif isinstance(block, ShownTable) and block.rows:
        shown, room = block, console.options.update(max_width=WIDEST)
        marked = "" in shown.heads  # by a last column, which is cut unless the others give way
        while True:
            table = table_of(shown, tight=marked)
            least = Measurement.get(console, room, table).minimum
            if shown.narrow is None or least <= console.width:
                break
            shown = shown.narrow
        if Measurement.get(console, room, wide := table_of(shown)).maximum <= console.width:
            table = wide
        yield table
        if block.note:
            yield Text(printable(block.note), style="dim")


def _line(label: str, text: str, style: str) -> Text:
    return Text.assemble((f"{label}: ", style), printable(text))


def table_of(shown: ShownTable, tight: bool = False) -> Table:
    """For the terminal: under its title, with a rule below its heads and no frame; words to the
    left, numbers to the right.  `tight`: only what is longer than a word gives way, and heads."""
    table = Table(title=shown.title or None, title_justify="left", title_style="bold",
                      box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)  # fmt: skip
    for k, head in enumerate(shown.heads):
        words, cells = k in shown.words, [row[k] for row in shown.rows]
        longest = max((len(w) for text in (head, *cells) for w in text.split()), default=0)
        longest = longest if words else max([longest, *map(len, cells)])
        whole = words and longest <= LONGEST_WHOLE and (not k or head in ("unit", ""))
        gives_way = words and any(" " in cell for cell in cells)
        table.add_column(head, justify="left" if words else "right", overflow="fold",
                         min_width=longest if whole else None,
                         width=longest if tight and not gives_way else None)  # fmt: skip
    for row in shown.rows:
        table.add_row(*(Text(printable(cell), STYLES.get(cell, "")) for cell in row))
    return table
