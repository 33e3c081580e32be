"""Rows of the report's tables: numbers as text, and where the interval bars lie."""

from __future__ import annotations

import math
from dataclasses import dataclass

from elastocal.identification.result import Combination, Estimate, IdentificationResult
from elastocal.report.units import display, estimate, plain, rounded_alike
from elastocal.report.words import (
    Truth,
    combination_truth,
    inside,
    nominal_known,
    printable,
    short_note,
    shortened,
)

# Bars have the true or nominal value in the middle and reach HALF_LENGTH to either side.
MIDDLE, HALF_LENGTH = 72.0, 70.0
TRUTH_REACH = 2.5  # half widths from the true value to a bar's end


@dataclass(frozen=True)
class Bar:
    """Where interval and estimate lie on a bar."""

    low: float
    high: float
    value: float


@dataclass(frozen=True)
class Row:
    """A parameter or a combination as text; "–" where there is no number."""

    name: str
    determined: bool
    value: str
    half: str
    unit: str
    truth: str
    verdict: str
    nominal: str = ""
    note: str = ""
    whole: str = ""
    bar: Bar | None = None


def parameter_rows(result: IdentificationResult, truth: Truth | None) -> list[Row]:
    """One row per parameter, all of them, in the model's order."""
    rows = []
    for e in result.estimates:
        true = None if truth is None else truth.get(e.name)
        value, half, unit, known = texts(e, true)
        nominal = e.nominal if nominal_known(result, e.name) else None
        shown = "–" if nominal is None else minus(plain(display(nominal, e.unit)[0]))
        rows.append(
            Row(
                printable(e.name), e.identifiable, minus(value), half, unit, minus(known),
                inside(true, e.ci95), shown, minus(short_note(result, e)),
                bar=_bar(e, true, nominal, truth is not None),
            )
        )  # fmt: skip
    return rows


def combination_rows(result: IdentificationResult, truth: Truth | None) -> list[Row]:
    rows = []
    for c in result.combinations:
        true = None if truth is None else combination_truth(result, c, truth)
        value, half, unit, known = texts(c, true)
        short, whole = shortened(c), shortened(c, len(c.terms))
        rows.append(
            Row(
                minus(short), True, minus(value), half, unit, minus(known),
                inside(true, c.ci95), whole=minus(whole) if whole != short else "",
                bar=_bar(c, true, None, truth is not None),
            )
        )  # fmt: skip
    return rows


def texts(e: Estimate | Combination, true: float | None) -> tuple[str, str, str, str]:
    """Value, ± half width, unit and true value; no number for what is not determined."""
    if e.value is None or e.ci95 is None:
        known = "–" if true is None else plain(display(true, e.unit)[0])
        return "–", "–", display(0.0, e.unit)[1], known
    width = (e.ci95[1] - e.ci95[0]) / 2
    value, half, unit = estimate(e.value, width, e.unit)
    if true is None:
        return value, half, unit, "–"
    known = rounded_alike(display(true, e.unit)[0], display(width, e.unit)[0])
    return value, half, unit, known


def minus(text: str) -> str:
    """Proper minus signs in front of numbers and between terms, not in names."""
    if text.startswith("-"):
        text = "−" + text[1:]
    return text.replace(" - ", " − ")


def bar_from_truth(value: float, half: float, true: float) -> Bar | None:
    """The interval beside the true value; one scale for all bars, in half widths."""
    if not half > 0:
        return None
    unit = HALF_LENGTH / TRUTH_REACH

    def place(x: float) -> float:
        return _place((x - true) / half * unit)

    return Bar(place(value - half), place(value + half), place(value))


def bar_from_nominal(value: float, half: float, nominal: float) -> Bar | None:
    """The interval beside the nominal value, on a scale of its own."""
    reach = 1.05 * (abs(value - nominal) + half)
    if not reach > 0:
        return None

    def place(x: float) -> float:
        return _place((x - nominal) / reach * HALF_LENGTH)

    return Bar(place(value - half), place(value + half), place(value))


def _place(offset: float) -> float:
    return round(MIDDLE + min(max(offset, -HALF_LENGTH), HALF_LENGTH), 1)


def _bar(
    e: Estimate | Combination, true: float | None, nominal: float | None, compared: bool
) -> Bar | None:
    if e.value is None or e.ci95 is None:
        return None
    half = (e.ci95[1] - e.ci95[0]) / 2
    if not math.isfinite(half):  # an interval without an end
        return None
    if compared:
        return None if true is None else bar_from_truth(e.value, half, true)
    return None if nominal is None else bar_from_nominal(e.value, half, nominal)
