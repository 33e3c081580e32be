"""Rows of the diagnosis tables as text: shared by the terminal and the page."""

from __future__ import annotations

from collections.abc import Sequence

from elastocal.diagnosis.result import Diagnosis, FoundEffect, Interval
from elastocal.diagnosis.separate.result import ExtraPlan
from elastocal.identification.error_budget import BudgetStep
from elastocal.report.diagnosis_verdict import seen_from
from elastocal.report.diagnosis_words import (
    driver_name,
    effect_at,
    name_of,
    p_value,
    place,
    plain_name,
    probability,
    settings_text,
)
from elastocal.report.rows import signed_change
from elastocal.report.units import estimate, length, significant
from elastocal.report.words import printable

BUDGET = ("model", "held-out rms", "95 %", "change")
CANDIDATES = ("candidate", "probability", "evidence", "d", "seen from", "settings")
PARAMETERS = ("parameter", "value", "± 95 %", "unit")
STRUCTURE = ("depends on", "p", "p, all tests")
FAULTY = ("line", "configuration", "marker", "error", "error / noise")
PAIRS = ("rivals", "d so far", "d with the extra poses")
UNTESTED = ("effect", "why", "record or measure")
Rows = list[tuple[str, ...]]
HALF_WIDTHS = 1.959964  # standard deviations in half a 95 % interval


def error_steps(d: Diagnosis) -> tuple[BudgetStep, ...]:
    """The steps of the gap budget that are models; the noise floor is none."""
    return tuple(step for step in d.budget if step.step != "noise_floor")


def budget_rows(d: Diagnosis) -> Rows:
    """The gap budget step by step, the noise floor last."""
    rows: Rows = []
    before: float | None = None
    for step in error_steps(d):
        change = "" if before is None else signed_change(step.heldout_rms - before)
        rows.append((name_of(step.step), length(step.heldout_rms), _ends(step.ci95), change))
        before = step.heldout_rms
    return [*rows, ("noise alone", length(d.gap.noise_floor), "", "")]


def _ends(ci95: Interval) -> str:
    return " to ".join(length(end) for end in ci95)


def candidate_rows(d: Diagnosis, most: int) -> Rows:
    """The best `most` candidates; nothing and an unknown effect are candidates as well."""
    rows: Rows = [
        (
            effect_at(c),
            probability(c.probability),
            f"{c.score:+.1f}",
            significant(c.detectable, 2),
            seen_from(c),
            settings_text(c.settings),
        )
        for c in d.candidates[:most]
    ]
    return [
        *rows,
        ("an effect outside the catalogue", probability(d.probability_unknown), "", "", "", ""),
        ("no further effect", probability(d.probability_nothing), "", "", "", ""),
    ]


def parameter_rows(findings: Sequence[FoundEffect]) -> Rows:
    """Fitted parameters of the effects found, with 95 % half widths, and their settings."""
    rows: Rows = []
    for f in findings:
        for p in f.parameters:
            value, half, unit = estimate(p.value, HALF_WIDTHS * p.std, p.unit)
            rows.append((printable(p.name), value, half, unit))
        if f.settings:
            rows.append((effect_at(f), settings_text(f.settings), "", ""))
    return rows


def structure_rows(d: Diagnosis, most: int) -> Rows:
    """Tests that name no effect, the most conspicuous first."""
    tests = sorted(d.structure, key=lambda t: (t.p_family, t.p_value))
    return [(driver_name(t.driver), p_value(t.p_value), p_value(t.p_family)) for t in tests[:most]]


def faulty_rows(d: Diagnosis, most: int) -> Rows:
    """Readings left out, the worst first."""
    worst = sorted(d.noise.faulty, key=lambda f: -f.sigmas)
    return [
        (
            str(f.line),
            printable(f.configuration),
            printable(f.marker),
            length(f.error),
            significant(f.sigmas),
        )
        for f in worst[:most]
    ]


def pair_rows(extra: ExtraPlan) -> Rows:
    """How far apart each pair of rivals is before and after the extra poses."""
    return [
        (
            f"{name_of(pair.first)} or {name_of(pair.second)}",
            significant(pair.distance_before, 2),
            significant(pair.distance_after, 2),
        )
        for pair in extra.pairs
    ]


def untested_rows(d: Diagnosis) -> Rows:
    """Effects that could not be tested, those with the same reason and remedy in one row."""
    groups: dict[tuple[str, str], dict[str, list[str]]] = {}
    for u in d.untested:
        effects = groups.setdefault((printable(u.reason), printable(u.advice)), {})
        effects.setdefault(plain_name(u.effect), []).append(place(u.where))
    return [
        (", ".join(f"{name} ({', '.join(at)})" for name, at in effects.items()), *reason)
        for reason, effects in groups.items()
    ]
