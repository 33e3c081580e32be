"""A diagnosis for the terminal: verdict in words, gap budget, candidates, what to do next."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from elastocal.diagnosis.result import Diagnosis
from elastocal.report.console_table import titled
from elastocal.report.diagnosis_rows import (
    BUDGET,
    CANDIDATES,
    PAIRS,
    PARAMETERS,
    UNTESTED,
    Rows,
    budget_rows,
    candidate_rows,
    pair_rows,
    parameter_rows,
    untested_rows,
)
from elastocal.report.diagnosis_verdict import next_steps, verdict_lines
from elastocal.report.diagnosis_words import capital, effect_at, noise_lines, together
from elastocal.report.words import printable

MOST_CANDIDATES = 8
NARROW = 100  # columns; below, a candidate is told without its settings
WORDS = ("settings", "unit", "why", "record or measure")  # columns that are not numbers


def print_diagnosis(console: Console, d: Diagnosis, kinds: Sequence[str]) -> None:
    """The whole answer for an engineer; `kinds` of the joints ("revolute" or "prismatic")."""
    _print_lines(console, verdict_lines(d))
    console.print()
    console.print(_table("Gap budget (3-D rms error on held-out poses)", BUDGET, budget_rows(d)))
    if rows := parameter_rows(d.effects):
        console.print(_table("Parameters of the effects found", PARAMETERS, rows))
    rows = candidate_rows(d, MOST_CANDIDATES)
    heads = CANDIDATES if console.width >= NARROW and any(r[-1] for r in rows) else CANDIDATES[:-1]
    title = f"Candidates, the best {len(rows) - 2} of {len(d.candidates)}"
    console.print(_table(title, heads, rows))
    console.print(
        Text(
            "evidence: log marginal likelihood over that of no further effect. d: standard "
            "deviations that the typical size moves the data; below 3 it hides in the noise. "
            "seen from: the size, in typical sizes, from which it would have been seen.",
            style="dim",
        )
    )
    if d.extra is not None and d.extra.pairs:
        console.print(_table("Rivals", PAIRS, pair_rows(d.extra)))
    if d.untested:
        console.print(_table("Not tested", UNTESTED, untested_rows(d)))
    console.print()
    _print_lines(console, [("Alike here", text) for text in _alike(d)])
    _print_lines(console, [("Noise", text) for text in noise_lines(d.noise, kinds)])
    _print_lines(console, [("Next", text) for text in next_steps(d)])
    _print_lines(console, [("Warning", printable(text)) for text in d.warnings])


def _alike(d: Diagnosis) -> list[str]:
    """Sets that these data cannot tell apart."""
    sets = [together([effect_at(e) for e in rivals]) for rivals in d.indistinguishable]
    return [f"{text}: these data cannot tell them apart." for text in sets]


def _print_lines(console: Console, lines: Sequence[tuple[str, str]]) -> None:
    for label, text in lines:
        style = "bold yellow" if label == "Warning" else "bold"
        console.print(Text.assemble((f"{label}: ", style), capital(text)))


def _table(title: str, heads: Sequence[str], rows: Rows) -> Table:
    """The first `heads` columns of the rows; numbers to the right."""
    table = titled(title)
    for k, head in enumerate(heads):
        words = k == 0 or head in WORDS
        table.add_column(head, justify="left" if words else "right", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row[: len(heads)]))
    return table
