"""Rows of the report's tables: numbers as text, and where the interval bars lie."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from elastocal.identification.result import (
    LOPSIDED,
    Calibration,
    Combination,
    Estimate,
)
from elastocal.report.gap_budget import Budget
from elastocal.report.page import Table
from elastocal.report.units import (
    display,
    estimate,
    length,
    plain,
    resolution,
    rounded_alike,
    with_ends,
)
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
ROUNDING = 1e-9  # sides of an interval this short beside the value are alike


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
    effect: str = ""
    published: str = ""

    @property
    def interval(self) -> str:
        """The half width with its sign, or both ends."""
        return signed_half(self.half)


def parameter_rows(
    result: Calibration,
    truth: Truth | None,
    published: Mapping[str, tuple[float, float]] | None = None,
) -> list[Row]:
    """One row per parameter, all of them, in the model's order.

    `published`: values and half widths (SI) that others found, by name.
    """
    rows = []
    effects = {p.name: p.effect.replace("_", " ") for p in result.model.parameters}
    for e in result.estimates:
        true = None if truth is None else truth.get(e.name)
        value, half, unit, known = texts(e, true)
        nominal = e.nominal if nominal_known(result, e.name) else None
        shown = "–" if nominal is None else minus(plain(display(nominal, e.unit)[0]))
        rows.append(
            Row(
                printable(e.name), e.identifiable, minus(value), minus(half), unit, minus(known),
                inside(true, e.ci95), shown, minus(short_note(result, e)),
                bar=_bar(e, true, nominal, truth is not None), effect=effects[e.name],
                published=_published((published or {}).get(e.name), e.unit),
            )
        )  # fmt: skip
    return rows


def _published(found: tuple[float, float] | None, unit: str) -> str:
    """ "0.287 ± 0.003", in the unit of the row."""
    if found is None:
        return "–"
    value, half, _ = estimate(*found, unit)
    return f"{minus(value)} ± {half}"


def budget_table(budget: Budget) -> Table:
    """The steps with their intervals and what each changes; noise alone last."""
    rows: list[tuple[str, ...]] = []
    before: float | None = None
    for step in budget.steps:
        change = "" if before is None else signed_change(step.rms - before)
        rows.append((step.name, length(step.rms), " to ".join(map(length, step.ci95)), change))
        before = step.rms
    if budget.floor is not None:
        rows.append((budget.floor_name, length(budget.floor), "", ""))
    return Table(("model", "held-out rms", "95 %", "change"), rows)


def signed_change(change: float) -> str:
    return f"{'−' if change < 0 else '+'}{length(abs(change))}"


def combination_rows(result: Calibration, truth: Truth | None) -> list[Row]:
    rows = []
    for c in result.combinations:
        true = None if truth is None else combination_truth(result, c, truth)
        value, half, unit, known = texts(c, true)
        short, whole = shortened(c), shortened(c, len(c.terms))
        rows.append(
            Row(
                minus(short), True, minus(value), minus(half), unit, minus(known),
                inside(true, c.ci95), whole=minus(whole) if whole != short else "",
                bar=_bar(c, true, None, truth is not None),
            )
        )  # fmt: skip
    return rows


def texts(e: Estimate | Combination, true: float | None) -> tuple[str, str, str, str]:
    """Value, half width or both ends, unit and true value; "–" for what is not determined."""
    if e.value is None or e.ci95 is None:
        known = "–" if true is None else plain(display(true, e.unit)[0])
        return "–", "–", display(0.0, e.unit)[1], known
    if is_lopsided(e.value, e.ci95):
        shown, low, high = (display(number, e.unit)[0] for number in (e.value, *e.ci95))
        value, half = with_ends(shown, low, high)
        width, unit = resolution(shown, low, high), display(e.value, e.unit)[1]
    else:
        width = (e.ci95[1] - e.ci95[0]) / 2
        value, half, unit = estimate(e.value, width, e.unit)
        width = display(width, e.unit)[0]
    known = "–" if true is None else rounded_alike(display(true, e.unit)[0], width)
    return value, half, unit, known


def is_lopsided(value: float, ci95: tuple[float, float]) -> bool:
    """Whether the interval needs both ends to be told: not symmetric, or without an end."""
    below, above = _sides(value, ci95)
    if not (math.isfinite(below) and math.isfinite(above)):
        return True
    return abs(above - below) > max(LOPSIDED * max(above, below), ROUNDING * abs(value))


def any_lopsided(found: Iterable[Estimate | Combination]) -> bool:
    return any(
        e.value is not None and e.ci95 is not None and is_lopsided(e.value, e.ci95) for e in found
    )


def half_head(lopsided: bool) -> str:
    """Head of the column of intervals, which only says "±" where all are symmetric."""
    return "95 %" if lopsided else "± 95 %"


def signed_half(half: str) -> str:
    """ "± 0.013", but the ends of a lopsided interval as they are."""
    return half if half.startswith(("[", "–")) else f"± {half}"


def minus(text: str) -> str:
    """Proper minus signs in front of numbers, ends and between terms, not in names."""
    if text.startswith("-"):
        text = "−" + text[1:]
    return text.replace(" - ", " − ").replace("[-", "[−").replace(", -", ", −")


def bar_from_truth(value: float, ci95: tuple[float, float], true: float) -> Bar | None:
    """The interval beside the true value; one scale for all bars, in half widths.

    An interval without one end is scaled by its other side and reaches the end of the bar.
    """
    half = (ci95[1] - ci95[0]) / 2
    if not math.isfinite(half):
        half = max((side for side in _sides(value, ci95) if math.isfinite(side)), default=0.0)
    return _bar_on(value, ci95, true, TRUTH_REACH * half)


def bar_from_nominal(value: float, ci95: tuple[float, float], nominal: float) -> Bar | None:
    """The interval beside the nominal value, on a scale of its own."""
    far = [abs(x - nominal) for x in (value, *ci95) if math.isfinite(x)]
    return _bar_on(value, ci95, nominal, 1.05 * max(far))


def _sides(value: float, ci95: tuple[float, float]) -> tuple[float, float]:
    return value - ci95[0], ci95[1] - value


def _bar_on(value: float, ci95: tuple[float, float], middle: float, reach: float) -> Bar | None:
    """The bar that shows `reach` to either side of the `middle`; None where nothing has an end."""
    if not reach > 0 or not any(math.isfinite(end) for end in ci95):
        return None

    def place(x: float) -> float:
        offset = (x - middle) / reach * HALF_LENGTH
        return round(MIDDLE + min(max(offset, -HALF_LENGTH), HALF_LENGTH), 1)

    return Bar(place(ci95[0]), place(ci95[1]), place(value))


def _bar(
    e: Estimate | Combination, true: float | None, nominal: float | None, compared: bool
) -> Bar | None:
    if e.value is None or e.ci95 is None:
        return None
    if compared:
        return None if true is None else bar_from_truth(e.value, e.ci95, true)
    return None if nominal is None else bar_from_nominal(e.value, e.ci95, nominal)
