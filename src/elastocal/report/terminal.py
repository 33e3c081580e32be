"""The blocks of a result as plain text and for the terminal."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from io import StringIO
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table as RichTable
from rich.text import Text as RichText

from elastocal.errors import option
from elastocal.report.blocks import (
    WARNING,
    Block,
    Heading,
    Lines,
    Report,
    Table,
    Text,
    Verdict,
    unfolded,
)
from elastocal.screen import safe_console
from elastocal.text import printable

if TYPE_CHECKING:
    from rich.console import RenderableType

PRINTED_WIDTH = 100  # columns of a result as plain text
# Which module has the report of each kind of result; one result does not load what others need.
REPORTS = {
    "Calibration": "identification_view",
    "Plan": "plan_view",
    "NextPoses": "plan_view",
    "Diagnosis": "diagnosis_view",
    "Comparison": "changes_view",
    "Compensation": "compensation_view",
    "Measurements": "compensation_view",
}
REPORT_OF = {"NextPoses": "next_report", "Measurements": "readings_report"}


def report_of(result: object, **told: Any) -> Report:
    """What is to be said of a result.  TypeError for a kind without a report."""
    kind = type(result).__name__
    if kind not in REPORTS:
        raise TypeError(kind)
    module = import_module(f"elastocal.report.{REPORTS[kind]}")
    found: Report = getattr(module, REPORT_OF.get(kind, "report"))(result, **told)
    return found


def print_report(console: Console, result: object, details: bool = True, **told: Any) -> None:
    """Show a result: what stands open in its report, and unless `details` are left out what is
    folded and `printed`."""
    print_blocks(console, report_of(result, **told).blocks, details)
    if not details:
        more = f"{option('details', True)} tells of method, noise, residuals, intervals"
        console.print(RichText(f"{more} and every combination; so does the report.", style="dim"))


def printed_text(result: object) -> str:
    """A result as the command line prints it, without colours and trailing blanks."""
    console = safe_console(file=StringIO(), width=PRINTED_WIDTH, color_system=None)
    with console.capture() as capture:
        print_report(console, result)
    return "\n".join(line.rstrip() for line in capture.get().rstrip().splitlines())


def print_blocks(console: Console, blocks: Iterable[Block], details: bool = False) -> None:
    """Print blocks; a blank line separates tables from sentences."""
    heading = before = ""
    for block in unfolded(blocks, lambda fold: details and fold.printed):
        if isinstance(block, Heading):
            heading = block.text
        elif shown := list(_shown(console, block)):
            kind = type(block).__name__.replace("Verdict", "Lines")
            if before not in ("", kind, "Table"):  # a table ends with one
                console.print()
            if heading and _needs(heading, block):
                console.print(RichText(heading, style="bold underline"))
            for each in shown:
                console.print(each)
            heading, before = "", kind


def _needs(heading: str, block: Block) -> bool:
    """Whether the heading says more than the block below it."""
    told = block.title if isinstance(block, Table) else ""
    if isinstance(block, Lines):
        told = block.items[0][0]
    return not (told and heading.startswith(told.partition(" (")[0].partition(",")[0]))


def _shown(console: Console, block: Block) -> Iterable[RenderableType]:
    if isinstance(block, Verdict):
        style = "bold" if block.tone == "good" else "bold yellow"
        yield _line("Verdict", block.sentence, style)
    elif isinstance(block, Lines):
        for label, text in block.items:
            yield _line(label, text, "bold yellow" if label == WARNING else "bold")
    elif isinstance(block, Text):
        yield RichText(printable(block.text), style="dim" if block.soft else "")
    elif isinstance(block, Table) and block.rows:
        shown, room = block, console.options.update(max_width=WIDEST)
        while True:
            table = table_of(shown)
            least = Measurement.get(console, room, table).minimum
            if shown.narrow is None or least <= console.width:
                break
            shown = shown.narrow
        yield table
        if block.note:
            yield RichText(printable(block.note), style="dim")


def _line(label: str, text: str, style: str) -> RichText:
    return RichText.assemble((f"{label}: ", style), printable(text))


WIDEST = 1000  # columns; more than any table needs
STYLES = {"inside": "green", "outside": "bold red", "changed": "bold yellow"}
LONGEST_WHOLE = 28  # letters; a longer name breaks where its column ends


def table_of(shown: Table) -> RichTable:
    """For the terminal: under its title, with a rule below its heads and no frame; words to the
    left, numbers to the right."""
    table = RichTable(title=shown.title or None, title_justify="left", title_style="bold",
                      box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)  # fmt: skip
    for k, head in enumerate(shown.heads):
        words = k in shown.words
        least = None
        if words and (not k or head == "unit"):
            longest = max((len(w) for row in shown.rows for w in row[k].split()), default=0)
            least = longest if longest <= LONGEST_WHOLE else None
        table.add_column(head, justify="left" if words else "right", min_width=least,
                         overflow="fold")  # fmt: skip
    for row in shown.rows:
        table.add_row(*(RichText(printable(cell), STYLES.get(cell, "")) for cell in row))
    return table
