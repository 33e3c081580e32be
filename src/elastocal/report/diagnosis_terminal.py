"""Diagnoses and comparisons on the terminal: apart from other results, which do not need these."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from elastocal.diagnosis.changes import Comparison
from elastocal.diagnosis.diagnosis import Diagnosis
from elastocal.report.causes_view import cause_rows, field_rows, place_rows, slight_text
from elastocal.report.changes_view import change_rows, changes_lines, tone
from elastocal.report.diagnosis_view import (
    added_parameter_rows,
    alike,
    diagnosis_lines,
    diagnosis_steps,
    gap_rows,
    hypothesis_rows,
    noise_floor_lines,
    pair_rows,
    untested_rows,
)
from elastocal.report.formatting import without_columns
from elastocal.report.terminal import WIDE, print_told, table_of
from elastocal.text import printable

NARROW_FOR_BOTH = 96  # columns; below, a comparison tells changes alone
MOST_CANDIDATES_PRINTED = 8
NARROW_FOR_SETTINGS = 100  # columns; below, a candidate is told without its settings


def print_diagnosis(console: Console, d: Diagnosis, kinds: Sequence[str] = ()) -> None:
    """The whole answer for an engineer; `kinds` of the joints ("revolute" or "prismatic") where
    the diagnosis does not say them."""
    joints = ("revolute",) * len(d.noise.repeatability)
    kinds = kinds or (joints if d.calibrated is None else d.calibrated.model.chain.kinds)
    print_told(console, diagnosis_lines(d))
    console.print()
    for told in _tables_of_causes(console, d):
        console.print(told)
    console.print(table_of("Error budget (3-D rms error at held-out poses)", gap_rows(d)))
    if (parameters := added_parameter_rows(d)).rows:
        console.print(table_of("Parameters of the effects found", parameters))
    best = hypothesis_rows(d, MOST_CANDIDATES_PRINTED)
    alone = " one at a time" if d.groups else ""
    title = f"Candidates{alone}, the best {len(best.rows) - 2} of {len(d.candidates)}"
    if console.width < NARROW_FOR_SETTINGS or not any(row[-1] for row in best.rows):
        best = without_columns(best, len(best.heads) - 1)
    console.print(table_of(title, best))
    console.print(
        Text(
            "evidence: log marginal likelihood over that of no further effect. d: standard "
            "deviations by which the typical size moves the data; below 3 it is below the noise. "
            "seen from: smallest detectable size, in typical sizes.",
            style="dim",
        )
    )
    for title, table in (("Rivals", pair_rows(d)), ("Not tested", untested_rows(d))):
        if table.rows:
            console.print(table_of(title, table))
    console.print()
    lines = [("Alike here", f"{text}: not separable by these data.") for text in alike(d)]
    lines += [("Slight", text)] if (text := slight_text(d)) else []
    lines += [("Noise", text) for text in noise_floor_lines(d.noise, kinds)]
    lines += [("Next", text) for text in diagnosis_steps(d)]
    print_told(console, [*lines, *(("Warning", printable(text)) for text in d.warnings)])


def _tables_of_causes(console: Console, d: Diagnosis) -> Iterable[Table | Text]:
    """What the gap is made of, place by place, and the corrections without a name."""
    found, at, fields = cause_rows(d), place_rows(d), field_rows(d)
    if found.rows:
        yield table_of("Causes of the remaining error", found, whole=True)
        yield Text(
            "share: part of the squared remaining error that goes when this is added last. error "
            "falls by: at new poses, if only this is added to the model.\n",
            style="dim",
        )
    if at.rows:
        # What it is as effects stands in the table of parameters too.
        yield table_of("Place by place", without_columns(at, 2) if console.width < WIDE else at)
    if fields.rows:
        yield table_of("Smooth corrections", fields)


def print_comparison(console: Console, c: Comparison) -> None:
    """The verdict, and every parameter; in a narrow terminal its change without both values."""
    print_told(console, changes_lines(c), "Warning" if tone(c) == "good" else "Verdict")
    console.print()
    shown = change_rows(c)
    if console.width < NARROW_FOR_BOTH:
        shown = without_columns(shown, 1, 2)
    console.print(table_of("Parameter by parameter", shown))
