"""What a diagnosis says: its sentences and its rows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from elastocal.diagnosis.diagnosis import (
    NORMAL_95,
    STRUCTURE,
    Candidate,
    Curve,
    Diagnosis,
    EffectAt,
    ExtraPlan,
    FoundEffect,
    Location,
    NearRepeats,
    NoiseFloor,
)
from elastocal.identification.error_budget import BudgetStep
from elastocal.measurements import by_rows
from elastocal.report.causes_view import (
    assumed_order,
    cause_rows,
    curve_line,
    curve_span,
    field_rows,
    headline_of_causes,
    place_rows,
    share_text,
    slight_text,
)
from elastocal.report.effect_names import (
    STAGES,
    driver_name,
    effect_at,
    name_of,
    p_value,
    place,
    places,
    plain_name,
    probability,
    reduction,
    settings_text,
    size_of,
)
from elastocal.report.formatting import (
    ShownTable,
    capital,
    counted,
    estimate,
    faulty_rows,
    gap_table,
    joint_heads,
    joint_texts,
    length,
    significant,
    together,
)
from elastocal.text import printable


def repeatabilities(noise: NoiseFloor, kinds: Iterable[str]) -> str:
    """Every joint's scatter from visit to visit: "joint 1 6.0 µrad, joint 2 5.1 µrad"."""
    texts = [
        f"joint {i + 1} {significant(value * 1e6, 2)} {'µrad' if kind == 'revolute' else 'µm'}"
        for i, (value, kind) in enumerate(zip(noise.repeatability, kinds, strict=True))
        if value > 0
    ]
    return ", ".join(texts) or "none found"


def noise_floor_lines(noise: NoiseFloor, kinds: Iterable[str]) -> list[str]:
    """What the data themselves say of the noise, a sentence each."""
    sigma = length(noise.reading_sigma)
    if noise.stated:
        text = f"A reading scatters by {sigma} rms per axis, {significant(noise.stated_factor, 2)}"
        lines = [
            f"{text} times what is stated, and {significant(noise.ratio_to_stated)} times with the "
            "scatter of the joints."
        ]
    else:
        lines = [f"A reading scatters by {sigma} rms per axis; nothing was stated."]
    lines.append(f"Repeatability from visit to visit: {repeatabilities(noise, kinds)}.")
    if noise.shared > 0:
        lines.append(
            "Visits of a configuration have a common scatter of "
            f"{significant(noise.shared, 2)} times that."
        )
    if noise.drift > 0:
        lines.append(
            f"The drift of {length(noise.drift)} that [noise] of the cell states counts as noise."
        )
    if noise.pure_error is None:
        lines.append("No repeats: the noise is estimated from residuals only.")
    else:
        lines.append(f"Repeats scatter by {length(noise.pure_error)} rms per axis.")
    if noise.near_repeats is not None:
        lines.append(_near_repeats_line(noise.near_repeats))
    if noise.faulty:
        n = len(noise.faulty)
        lines.append(
            f"{n} outlier{'s were' if n > 1 else ' was'} excluded, the worst "
            f"{length(max(f.error for f in noise.faulty))} off."
        )
    return lines


def _near_repeats_line(near: NearRepeats) -> str:
    pairs = f"{near.pairs} pair{'s' if near.pairs > 1 else ''}"
    text = (
        f"Readings at nearly the same pose ({pairs}) scatter by {length(near.scatter)} rms per axis"
    )
    if near.soon is not None and near.later is not None:
        text += (
            f" (measured soon after each other {length(near.soon)}, in other parts of the session "
            f"{length(near.later)})"
        )
    return f"{text}."


ABSURD = 100.0  # typical sizes: no arm has an effect that large, whatever the readings could show
MOST_NAMED = 6
MOMENTS = ("jump_time_s", "slip_time_s")


def diagnosis_headline(d: Diagnosis) -> str:
    """The verdict in one sentence."""
    if d.groups:
        return capital(headline_of_causes(d))
    if d.verdict == "explained":
        named = together(_likely(d))
        return f"{capital(named)} explain{'s' * (len(d.effects) == 1)} the remaining error."
    if d.verdict == "ambiguous":
        return _ambiguous(d)
    if d.verdict == "unknown_effect":
        return _unknown(d)
    return (
        "No further effect exceeds the noise; probability of none: "
        f"{probability(d.probability_nothing)}."
    )


def _likely(d: Diagnosis) -> list[str]:
    return [f"{effect_at(f)} (probability {probability(f.probability)}{_when(d, f)})"
            for f in d.effects]  # fmt: skip


def _when(d: Diagnosis, f: FoundEffect) -> str:
    """When it happened, where it happened once."""
    moments = {k: v for k, v in f.settings.items() if k in MOMENTS}
    return f"; {settings_of(d, moments)}" if moments else ""


def _ambiguous(d: Diagnosis) -> str:
    sets = [together([effect_at(e) for e in rivals], "or") for rivals in d.indistinguishable]
    text = together([f"either {rivals}" for rivals in sets])
    verb = "causes" if len(sets) == 1 else "cause"
    return f"{capital(text)} {verb} the remaining error; these data cannot decide."


def _unknown(d: Diagnosis) -> str:
    text = "An effect outside the catalogue causes the remaining error"
    if d.effects:
        verb = "cause" if len(d.effects) > 1 else "causes"
        text = f"{capital(together(_likely(d)))} {verb} part of the remaining error; an effect "
        text += "outside the catalogue"
        return f"{text} acts {location_text(d.location)}." if d.location else f"{text} acts."
    if d.location is None:
        return f"{text}; the data do not show where."
    return f"{text}, {location_text(d.location)}."


def location_text(location: Location) -> str:
    """ "at joint 2, in the transmission (probability 0.97)"."""
    at, stage = place(location.where), STAGES[location.stage]
    where = f"at {at}, in the {stage}" if at != stage else f"at the {at}"
    return f"{where} (probability {probability(location.probability)})"


def diagnosis_lines(d: Diagnosis) -> list[tuple[str, str]]:
    """(label, sentence) on what was found, for the terminal and the head of the page."""
    lines = [("Verdict", diagnosis_headline(d))]
    lines += [("Error", text) for text in _error_lines(d)]
    if d.verdict == "unknown_effect":
        lines += [("Depends on", text) for text in _dependence(d)]
    if d.groups:
        told = (("Curves", curve_line(d)), ("Assumed", assumed_order(d)), ("Chance", _chance(d)))
        return lines + [(label, text) for label, text in told if text]
    if d.verdict == "unknown_effect":
        lines += [("Shape", _shape(curve)) for curve in d.curves]
    if d.open:
        lines += [_finding_line(d, f) for f in d.effects]
    if d.verdict == "nothing_significant":
        lines += [("Sensitivity", text) for text in sensitivity(d)]
    elif d.verdict == "ambiguous" and d.location is not None:
        lines.append(("Location", f"{location_text(d.location)}."))
    lines.append(("Chance", _chance(d)))
    return lines


def _error_lines(d: Diagnosis) -> list[str]:
    """Error on held-out poses before and after, and the part of it that the effects remove."""
    calibrated, floor = length(d.gap.calibrated), length(d.gap.noise_floor)
    rest = _unexplained_lines(d)
    if not d.effects:
        return [
            f"Held-out error: {calibrated} rms (noise alone: {floor}).", *rest,
        ]  # fmt: skip
    text = (
        f"Held-out error: {calibrated} rms, with the effects found {length(d.gap.explained)} rms "
        f"(noise alone: {floor})."
    )
    nameless = [s for s in d.budget if s.step.startswith("unknown:")]
    if d.groups and nameless:
        left = length(nameless[-1].heldout_rms)
        text += f" With unnamed smooth corrections: {left}."
    if d.groups:  # the table of causes says what each takes away
        return [text, *rest]
    if len(d.effects) == 1:
        shrinks = f"The noise-free error at new poses falls by {reduction(d.effects[0])}."
        return [f"{text} {shrinks}", *rest]
    each = [f"{effect_at(f)} removes {reduction(f)}" for f in d.effects]
    last = f"Added last, {together(each)} of the noise-free error at new poses."
    return [f"{text} {last}", *rest]


MATERIAL = 0.2  # of the noise: 2 % more in all


def _unexplained_lines(d: Diagnosis) -> list[str]:
    """What looks like noise and is none."""
    if d.gap.unexplained <= MATERIAL * d.gap.noise_floor:
        return []
    return [
        f"{length(d.gap.unexplained)} rms are unexplained: they look like scatter of the arm, but "
        "repeats do not show them, neighbours in pose or time share them, or joints do not scatter "
        "that much."
    ]


def _finding_line(d: Diagnosis, f: FoundEffect) -> tuple[str, str]:
    """An effect beside the open question, or the likeliest answer to it."""
    open_sets = {(e.effect, e.where) for rivals in d.indistinguishable for e in rivals}
    label = "Likeliest" if (f.effect, f.where) in open_sets else "Besides"
    text = f"{effect_at(f)} (probability {probability(f.probability)}"
    return (
        label,
        f"{text}; {settings_of(d, f.settings)})." if f.settings else f"{text}).",
    )


def settings_of(d: Diagnosis, settings: Mapping[str, float]) -> str:
    """Constants of an effect in words."""
    table = None if d.calibrated is None else d.calibrated.observed.table
    lines = () if table is None or table.time is not None else np.unique(by_rows(table)).tolist()
    return settings_text(settings, lines)


def _dependence(d: Diagnosis) -> list[str]:
    """The drivers that the residual depends on, the strongest first."""
    if not d.dependences:
        return ["no single driver that was tested shows it; see the curves for its shape."]
    told = d.dependences[:MOST_NAMED]
    named = [f"{driver_name(t.driver)} ({size_of(t.p_family)})" for t in told]
    more = len(d.dependences) - len(named)
    return [together(named) + (f" and {more} more" if more else "") + "."]


def _shape(curve: Curve) -> str:
    """How much the driver moves the entry, from its lowest to its highest point."""
    moved = f"{driver_name(curve.driver)} moves {driver_name(curve.entry)}"
    return f"{moved} by {curve_span(curve)} in all."


def _chance(d: Diagnosis) -> str:
    if not d.effects and d.p_value > STRUCTURE:
        return f"{size_of(d.p_value)} for the strongest candidate, corrected for all candidates."
    return f"{size_of(d.p_value)} after correction for all candidates."


def sensitivity(d: Diagnosis) -> list[str]:
    """How small an effect would have been seen."""
    if not d.candidates:
        return []
    lines = []
    if math.isfinite(d.smallest_seen):
        lines.append(
            f"effects above about {significant(d.smallest_seen * 1e6, 2)} µm rms at the markers, "
            "not absorbed by fitted parameters, would have been found."
        )
    visible = [c for c in d.candidates if c.visible]
    faint = [c for c in d.candidates if c.hidden]
    text = f"of {len(d.candidates)} candidates {len(visible)} would have been found at typical size"
    if faint:
        by_effect = dict.fromkeys(plain_name(c.effect) for c in faint)
        names = list(by_effect)[:MOST_NAMED]
        more = len(by_effect) - len(names)
        text += f"; below the noise even then: {len(faint)} ({', '.join(names)}"
        text += f" and {more} more kinds)" if more else ")"
    return [*lines, f"{text}."]


def seen_from(c: Candidate) -> str:
    """The size from which an effect would be seen, in typical sizes: "0.4"."""
    if not math.isfinite(c.seen_from):
        return "–"
    return f"> {ABSURD:.0f}" if c.seen_from > ABSURD else significant(c.seen_from, 2)


def diagnosis_steps(d: Diagnosis) -> list[str]:
    """What to do now: the remedies of the findings, what extra poses promise, what to record."""
    steps = [f.remedy for f in d.findings if f.remedy]
    if d.extra is not None:
        steps += extra_lines(d.extra)
    # One piece of advice serves many effects.
    return steps + list(dict.fromkeys(capital(printable(u.advice)) for u in d.untested))


def extra_lines(extra: ExtraPlan) -> list[str]:
    """What the extra poses promise, or that none would help."""
    rivals = together([name_of(name) for name in extra.rivals], "or")
    if not extra.separable:
        lines = [f"No pose that this cell allows separates {rivals}."]
    else:
        n = extra.n_poses
        lines = [
            f"{n} more pose{'s' if n != 1 else ''} to separate {rivals}: the probability of "
            f"the right answer rises from {probability(extra.probability_before)} to "
            f"{probability(extra.probability_after)} (as many random poses: "
            f"{probability(extra.probability_random)})."
        ]
        for group in extra.inseparable:
            lines.append(f"{capital(together([name_of(name) for name in group]))} count as one.")
    return lines + [capital(printable(text)) for text in extra.advice]


Rows = list[tuple[str, ...]]


def error_steps(d: Diagnosis) -> tuple[BudgetStep, ...]:
    """The steps of the gap budget that are models; the noise floor is none."""
    return tuple(step for step in d.budget if step.step != "noise_floor")


def gap_rows(d: Diagnosis) -> ShownTable:
    """The gap budget step by step, the noise floor last."""
    steps = [(name_of(step.step), step.heldout_rms, step.ci95) for step in error_steps(d)]
    return gap_table(steps, ("noise alone", d.gap.noise_floor))


def hypothesis_rows(d: Diagnosis, most: int) -> ShownTable:
    """The best `most` candidates; nothing and an unknown effect are candidates as well."""
    rows = [
        (
            effect_at(c),
            probability(c.probability),
            f"{c.score:+.1f}",
            significant(c.detectable, 2),
            seen_from(c),
            settings_of(d, c.settings),
        )
        for c in d.candidates[:most]
    ]
    for name, p in (
        ("an effect outside the catalogue", d.probability_unknown),
        ("no further effect", d.probability_nothing),
    ):
        rows.append((name, probability(p), "", "", "", ""))
    heads = ("candidate", "probability", "evidence", "d", "seen from", "settings")
    return ShownTable(heads, rows, (0, 5))


def added_parameter_rows(d: Diagnosis) -> ShownTable:
    """Fitted parameters of the effects found, with 95 % half widths, and their settings."""
    rows: Rows = []
    for f in d.effects:
        for p in f.parameters:
            rows.append((printable(p.name), *estimate(p.value, NORMAL_95 * p.std, p.unit)))
        if f.settings:
            rows.append((effect_at(f), settings_of(d, f.settings), "", ""))
    return ShownTable(("parameter", "value", "± 95 %", "unit"), rows, (0, 3))


def structure_rows(d: Diagnosis, most: int) -> ShownTable:
    """Tests that name no effect, the most conspicuous first."""
    tests = sorted(d.structure, key=lambda t: (t.p_family, t.p_value))[:most]
    rows: Rows = [(driver_name(t.driver), p_value(t.p_value), p_value(t.p_family)) for t in tests]
    return ShownTable(("depends on", "p", "p, all tests"), rows)


def pair_rows(d: Diagnosis) -> ShownTable:
    """How far apart each pair of rivals is before and after the extra poses."""
    rows = [
        (
            f"{name_of(pair.first)} or {name_of(pair.second)}",
            significant(pair.distance_before, 2),
            significant(pair.distance_after, 2),
        )
        for pair in (() if d.extra is None else d.extra.pairs)
    ]
    return ShownTable(("rivals", "d so far", "d with the extra poses"), rows)


def untested_rows(d: Diagnosis) -> ShownTable:
    """Effects that could not be tested, those with the same reason and remedy in one row."""
    groups: dict[tuple[str, str], dict[str, list[str]]] = {}
    for u in d.untested:
        effects = groups.setdefault((printable(u.reason), printable(u.advice)), {})
        effects.setdefault(plain_name(u.effect), []).append(u.where)
    rows = [
        (", ".join(f"{name} ({places(at, True)})" for name, at in effects.items()), *reason)
        for reason, effects in groups.items()
    ]
    return ShownTable(("effect", "why", "record or measure"), rows, (0, 1, 2))


def alike(d: Diagnosis) -> list[str]:
    """Sets of effects that these data cannot tell apart; beside many causes, the one that was
    taken with its probability."""
    taken = {(f.effect, f.where): f.probability for f in d.effects} if d.groups else {}

    def told(e: EffectAt) -> str:
        p = taken.get((e.effect, e.where))
        return effect_at(e) + ("" if p is None else f" (probability {probability(p)})")

    return [together([told(e) for e in rivals]) for rivals in d.indistinguishable]


# What only the page shows.

MOST_CANDIDATES = 40
MOST_TESTS = 12
MOST_PLACES = 8
MOST_VISITS = 200
BOX_WIDTH, GAP = 118, 18  # width of a box of the chain and the room between two, in SVG units


@dataclass(frozen=True)
class ChainBox:
    """A link of the chain as the page draws it: `shade` 0 to 1, None where it cannot err."""

    name: str
    x: int
    shade: float | None
    evidence: str


def chain_boxes(d: Diagnosis) -> list[ChainBox]:
    """The chain from commanded joints to tracker, shaded by the evidence for each link."""
    stages = {} if d.location is None else d.location.shares or d.location.stages
    named: list[tuple[str, float | None]] = [("commanded joints", None)]
    named += [(name, stages.get(stage, 0.0) if stages else None) for stage, name in STAGES.items()]
    return [
        ChainBox(
            name,
            k * (BOX_WIDTH + GAP),
            None if shade is None else min(shade, 1.0),
            "" if shade is None else _evidence(d, shade),
        )
        for k, (name, shade) in enumerate(named)
    ]


def _evidence(d: Diagnosis, value: float) -> str:
    shared = d.location is not None and d.location.shares
    return share_text(min(value, 1.0)) if shared else probability(value)


def likeliest_places(d: Diagnosis) -> list[tuple[str, str]]:
    """The likeliest places, the likeliest first."""
    if d.location is None:
        return []
    order = sorted(d.location.places.items(), key=lambda item: -item[1])
    return [(place(where), probability(p)) for where, p in order[:MOST_PLACES]]


def extra_visits(d: Diagnosis, kinds: tuple[str, ...]) -> dict[str, Any] | None:
    """The extra poses as a table, in the order of measuring; None where there are none."""
    if d.extra is None or d.extra.plan is None:
        return None
    plan = d.extra.plan
    heads = ["order", "pose", *joint_heads(kinds), "force N"]
    heads += ["approach"] if plan.approach is not None else []
    heads += ["time min"] if plan.time is not None else []
    table: list[tuple[str, ...]] = []
    for i in range(min(len(plan), MOST_VISITS)):
        row = [str(i + 1), printable(plan.configuration_labels[plan.configuration[i]])]
        row += joint_texts(plan.q[i] + 0.0, kinds)
        row.append(" ".join(significant(f) for f in plan.force[i]))
        if plan.approach is not None:
            row.append(" ".join("+" if a > 0 else "−" if a < 0 else "0" for a in plan.approach[i]))
        if plan.time is not None:
            row.append(f"{plan.time[i] / 60:.1f}")
        table.append(tuple(row))
    return {"table": ShownTable(tuple(heads), table, ()), "more": len(plan) - len(table)}


def diagnosis_contents(d: Diagnosis, kinds: tuple[str, ...]) -> dict[str, Any]:
    """Words and tables of the page, by the names that its template has for them."""
    faulty = sorted(d.noise.faulty, key=lambda f: -f.sigmas)
    return {
        "headline": diagnosis_headline(d),
        "tone": d.findings[0].severity,
        "verdict": [(label, capital(text)) for label, text in diagnosis_lines(d)[1:]],
        "steps": diagnosis_steps(d),
        "warnings": [capital(printable(w)) for w in d.warnings],
        "readings": f"{counted(d.n_readings, 'reading')} in "
        f"{counted(d.n_configurations, 'configuration')}",
        "data": printable(d.data),
        "boxes": chain_boxes(d),
        "box": BOX_WIDTH,
        "places": likeliest_places(d),
        "budget": gap_rows(d),
        "causes": cause_rows(d),
        "causes_by_place": place_rows(d),
        "fields": field_rows(d),
        "shared": bool(d.location and d.location.shares),
        "parameters": added_parameter_rows(d),
        "candidates": hypothesis_rows(d, MOST_CANDIDATES),
        "n_candidates": len(d.candidates),
        "slight": slight_text(d),
        "alike": [capital(text) for text in alike(d)],
        "structure": structure_rows(d, MOST_TESTS),
        "n_structure": len(d.structure),
        "noise": noise_floor_lines(d.noise, kinds),
        "faulty": faulty_rows([(f, f.error, f.sigmas) for f in faulty]),
        "untested": untested_rows(d),
        "extra": [] if d.extra is None else extra_lines(d.extra),
        "pairs": pair_rows(d),
        "visits": extra_visits(d, kinds),
    }
