"""What a diagnosis says, as blocks: verdict, causes, error; behind them evidence and noise."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence

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
from elastocal.report.blocks import (
    TONES,
    WARNING,
    Block,
    Figure,
    Fold,
    KeyFigures,
    Lines,
    Report,
    Sentence,
    ShownArm,
    ShownTable,
    ShownVerdict,
)
from elastocal.report.causes_view import (
    assumed_order,
    cause_table,
    curve_line,
    curve_span,
    field_table,
    headline_of_causes,
    place_table,
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
    budget_table,
    capital,
    estimate,
    joint_heads,
    joint_texts,
    length,
    outlier_blocks,
    significant,
    title_of,
    together,
)
from elastocal.text import printable

MOST_CANDIDATES, MOST_PRINTED = 40, 8
MOST_TESTS = 12
FEW = 2  # effects whose shapes stand open
MOST_PLACES = 8
MOST_VISITS = 200


def diagnosis_report(d: Diagnosis) -> Report:
    """Why the arm still differs from the model, and what follows."""
    title, backend = printable(d.data), ""
    if d.model is not None:
        title = title_of(d.model.chain.name, d.model.cell.name)
        backend = d.model.backend_report()
    return Report("Diagnosis", title, _blocks(d, _kinds(d)), backend)


def _kinds(d: Diagnosis) -> Sequence[str]:
    return ("revolute",) * len(d.noise.repeatability) if d.model is None else d.model.chain.kinds


def _blocks(d: Diagnosis, kinds: Sequence[str]) -> Iterator[Block]:
    yield Fold("", lambda: [_key(d)])
    yield ShownVerdict(
        TONES[d.findings[0].severity] if d.findings else "good", diagnosis_headline(d)
    )
    lines = [(label, capital(text)) for label, text in diagnosis_lines(d)]
    lines += [("Not separable", capital(f"{text}.")) for text in alike(d)]
    lines += [("Next", text) for text in diagnosis_steps(d)]
    yield Lines([*lines, *((WARNING, capital(printable(text))) for text in d.warnings)])
    yield Fold("", lambda: _figures(d), figures=("budget", "curves"))
    shapes = "" if len(d.effects) <= FEW else "Found effects over the joints they act at"
    yield Fold(shapes, lambda: _shapes(d), figures=("effects",))
    yield cause_table(d)
    yield added_parameter_table(d)
    places = place_table(d)
    yield Fold("Place by place", lambda: [places], printed=True)
    yield Fold("Smooth corrections", lambda: _nameless(d), printed=True)
    yield Fold("Error budget", lambda: [gap_table(d)], printed=True)
    best = candidate_table(d, 0, MOST_PRINTED)
    yield Fold("Candidates", lambda: [best], printed=True)
    if len(d.candidates) > MOST_PRINTED:
        more = candidate_table(d, MOST_PRINTED, MOST_CANDIDATES)
        yield Fold("Further candidates", lambda: [more])
    yield Fold("Rivals", lambda: [pair_table(d)], printed=True)
    yield Fold("Extra poses", lambda: [extra_visits(d, kinds)])
    yield Fold("Where the error comes from", lambda: _where(d))
    yield Fold("Not tested", lambda: [untested_table(d)], printed=True)
    noise = [("Noise", text) for text in noise_floor_lines(d.noise, kinds)]
    yield Fold("Noise", lambda: [Lines(noise)], printed=True)
    if d.noise.faulty:
        yield Fold("Outliers excluded", lambda: _outliers(d))
    if d.calibrated is not None:
        yield Fold("Residuals of the calibrated arm", lambda: _residuals(d),
                   figures=("space", "residuals", "against_joints", "over_time"))  # fmt: skip


def _key(d: Diagnosis) -> KeyFigures:
    """The error before and after the effects found, and the noise in both."""
    gap = d.gap
    calibrated, floor = length(gap.calibrated), length(gap.noise_floor)
    figures = [("calibrated arm, held out", calibrated)]
    headline = calibrated
    if d.effects:
        headline += f" → {length(gap.explained)}"
        figures.append(("with the effects found", length(gap.explained)))
    figures += [("noise alone", floor), ("readings", str(d.n_readings))]
    return KeyFigures(f"{headline} (noise {floor})", figures)


def _figures(d: Diagnosis) -> Iterator[Figure]:
    from elastocal.report.figures import unknown_curves, waterfall

    if d.budget:
        yield waterfall("budget", _named_steps(d), ("noise alone", d.gap.noise_floor))
    if d.curves:
        yield unknown_curves(d)


def _shapes(d: Diagnosis) -> Iterator[Figure]:
    from elastocal.report.figures import effects_over_joints

    if (found := effects_over_joints(d)) is not None:
        yield found


def _nameless(d: Diagnosis) -> Iterator[Block]:
    if text := slight_text(d):
        yield Sentence(text)
    yield field_table(d)


def _where(d: Diagnosis) -> Iterator[Block]:
    yield stage_table(d)
    yield place_probabilities(d)
    yield structure_table(d, MOST_TESTS)


def _outliers(d: Diagnosis) -> Iterable[Block]:
    faulty = sorted(d.noise.faulty, key=lambda f: -f.sigmas)
    return outlier_blocks("", [(f, f.error, f.sigmas) for f in faulty])


def _residuals(d: Diagnosis) -> Iterator[ShownArm | Block]:
    from elastocal.report import figures
    from elastocal.report.arm_view import residual_arm

    base = d.calibrated
    assert base is not None
    residuals = figures.residuals_by(base.observed, base.residual)
    yield Sentence("What the model leaves before the effects found are added.")
    yield residual_arm(base.model, base.observed, base.x, base.residual)
    yield figures.over_configurations(residuals)
    yield figures.over_joints(base.model.chain.kinds, residuals)
    yield figures.over_time(base.observed, residuals)
    yield figures.residual_table(base.observed, residuals)


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
    """(label, sentence) on what was found."""
    lines = [("Error", text) for text in _error_lines(d)]
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


def gap_table(d: Diagnosis) -> ShownTable:
    """The budget step by step, the noise last."""
    return budget_table(_named_steps(d), ("noise alone", d.gap.noise_floor))


def _named_steps(d: Diagnosis) -> list[tuple[str, float, tuple[float, float]]]:
    return [(name_of(step.step), step.heldout_rms, step.ci95) for step in error_steps(d)]


OF_CANDIDATES = (
    "evidence: log marginal likelihood over that of no further effect. d: standard deviations by "
    "which the typical size moves the data; below 3 it is below the noise. seen from: smallest "
    "detectable size, in typical sizes."
)


def candidate_table(d: Diagnosis, first: int, last: int) -> ShownTable:
    """The candidates of these ranks, the best first; with rank 0 an unknown effect and none, which
    are candidates as well."""
    rows = [
        (effect_at(c), probability(c.probability), f"{c.score:+.1f}",
         significant(c.detectable, 2), seen_from(c), settings_of(d, c.settings))
        for c in d.candidates[first:last]
    ]  # fmt: skip
    title = f"{'Further c' if first else 'C'}andidates{' one at a time' if d.groups else ''}"
    title += f", rank {first + 1} to {first + len(rows)} of {len(d.candidates)}"
    if not first:
        none = ("", "", "", "")
        rows.append(("an effect outside the catalogue", probability(d.probability_unknown), *none))
        rows.append(("no further effect", probability(d.probability_nothing), *none))
    heads = ("candidate", "probability", "evidence", "d", "seen from", "settings")
    table = ShownTable(heads, rows, (0, 5), title=title, note=OF_CANDIDATES)
    return table.when_narrow(5) if any(row[5] for row in rows) else table.without(5)


def added_parameter_table(d: Diagnosis) -> ShownTable:
    """Fitted parameters of the effects found, with 95 % half widths, and their settings."""
    rows: Rows = []
    for f in d.effects:
        for p in f.parameters:
            rows.append((printable(p.name), *estimate(p.value, NORMAL_95 * p.std, p.unit)))
        if f.settings:
            rows.append((f"{effect_at(f)}: {settings_of(d, f.settings)}", "", "", ""))
    title = "Parameters of the effects found"
    return ShownTable(("parameter", "value", "± 95 %", "unit"), rows, (0, 3), title=title)


def structure_table(d: Diagnosis, most: int) -> ShownTable:
    """Tests that name no effect, the most conspicuous first."""
    tests = sorted(d.structure, key=lambda t: (t.p_family, t.p_value))[:most]
    rows: Rows = [(driver_name(t.driver), p_value(t.p_value), p_value(t.p_family)) for t in tests]
    note = (
        "Does the residual depend on it at all? These tests name no effect: whole configurations "
        f"change sign, and the last column counts all {len(d.structure)}."
    )
    return ShownTable(("depends on", "p", "p, all tests"), rows, note=note)


def pair_table(d: Diagnosis) -> ShownTable:
    """How far apart each pair of rivals is before and after the extra poses."""
    rows = [
        (
            f"{name_of(pair.first)} or {name_of(pair.second)}",
            significant(pair.distance_before, 2),
            significant(pair.distance_after, 2),
        )
        for pair in (() if d.extra is None else d.extra.pairs)
    ]
    note = (
        "d is the distance of the two in standard deviations of the data; the best test between "
        "them is right with probability Φ(d/2)."
    )
    heads = ("rivals", "d so far", "d with the extra poses")
    return ShownTable(heads, rows, title="Rivals", note=note)


def untested_table(d: Diagnosis) -> ShownTable:
    """Effects that could not be tested, those with the same reason and remedy in one row."""
    groups: dict[tuple[str, str], dict[str, list[str]]] = {}
    for u in d.untested:
        effects = groups.setdefault((printable(u.reason), printable(u.advice)), {})
        effects.setdefault(plain_name(u.effect), []).append(u.where)
    rows = [
        (", ".join(f"{name} ({places(at, True)})" for name, at in effects.items()), *reason)
        for reason, effects in groups.items()
    ]
    return ShownTable(("effect", "why", "record or measure"), rows, (0, 1, 2), title="Not tested")


def alike(d: Diagnosis) -> list[str]:
    """Sets of effects that these data cannot tell apart; beside many causes, the one that was
    taken with its probability."""
    taken = {(f.effect, f.where): f.probability for f in d.effects} if d.groups else {}

    def told(e: EffectAt) -> str:
        p = taken.get((e.effect, e.where))
        return effect_at(e) + ("" if p is None else f" (probability {probability(p)})")

    return [together([told(e) for e in rivals]) for rivals in d.indistinguishable]


def stage_table(d: Diagnosis) -> ShownTable:
    """The stages of the chain from commanded joints to tracker, with the evidence for each."""
    location = d.location
    if location is None:
        return ShownTable((), [])
    shared = bool(location.shares)
    found = location.shares or location.stages
    rows = [
        (name, share_text(min(value, 1.0)) if shared else probability(value))
        for stage, name in STAGES.items()
        for value in (found.get(stage, 0.0),)
    ]
    return ShownTable(("stage", "share of the error" if shared else "probability"), rows)


def place_probabilities(d: Diagnosis) -> ShownTable:
    """The likeliest places, the likeliest first."""
    found = [] if d.location is None or d.location.shares else d.location.places.items()
    order = sorted(found, key=lambda item: -item[1])
    rows = [(place(where), probability(p)) for where, p in order[:MOST_PLACES]]
    return ShownTable(("place", "probability"), rows)


def extra_visits(d: Diagnosis, kinds: Sequence[str]) -> ShownTable:
    """The extra poses in the order of measuring."""
    if d.extra is None or d.extra.plan is None:
        return ShownTable((), [])
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
            row.append(" ".join("+" if a > 0 else "-" if a < 0 else "0" for a in plan.approach[i]))
        if plan.time is not None:
            row.append(f"{plan.time[i] / 60:.1f}")
        table.append(tuple(row))
    more = len(plan) - len(table)
    return ShownTable(
        tuple(heads), table, (), title="Poses", note=f"and {more} more" if more else ""
    )
