"""What a diagnosis says, as blocks: verdict, causes, error; behind them evidence and noise."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from elastocal.diagnosis import diagnosis
from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.component_answer import SLIGHT
from elastocal.diagnosis.diagnosis import Diagnosis
from elastocal.measurements import by_rows
from elastocal.messages import printable, some
from elastocal.report import blocks as say
from elastocal.report.figures import Residuals, effects_over_joints, unknown_curves, waterfall

MOST_CANDIDATES = 8
MOST_TESTS = 12
MOST_PLACES = 8
MOST_NAMED = 6
MOST_IN_HEADLINE = 3
FEW = 2  # effects whose shapes stand open
FINE = 0.1  # fraction below which a tenth of a percent is told
ABSURD = 100.0  # typical sizes: no arm has an effect that large, whatever the readings could show
MOMENTS = ("jump_time_s", "slip_time_s")
NAMELESS = "without a name"
# What an error of each family goes with.
FAMILIES = {
    "angle": "against its own angle",
    "gravity": "by gravity",
    "torque": "by torque",
    "load": "by load",
    "move": "by the last move",
    "time": "with time",
    "temperature": "with temperature",
    "pose": "with the pose",
    "tool": "of the tool",
}


def diagnosis_blocks(d: Diagnosis) -> Iterator[say.Block]:
    headline, floor = say.length(d.gap.calibrated), say.length(d.gap.noise_floor)
    figures = [("calibrated arm, held out", headline)]
    if d.effects:
        headline += f" → {say.length(d.gap.explained)}"
        figures.append(("with the effects found", say.length(d.gap.explained)))
    figures += [("noise alone", floor), ("readings", str(d.n_readings))]
    yield say.Fold("", lambda: [say.KeyFigures(f"{headline} (noise {floor})", figures)])
    tone = say.TONES[d.findings[0].severity] if d.findings else "good"
    yield say.ShownVerdict(tone, diagnosis_headline(d))
    lines = [(label, say.capital(text)) for label, text in diagnosis_lines(d)]
    if d.groups or d.verdict != "ambiguous":  # which says it
        lines += [("Not separable", say.capital(f"{text}.")) for text in alike(d)]
    lines += [("Next", text) for text in diagnosis_steps(d)]
    yield say.Lines(
        [*lines, *((say.WARNING, say.sentence(printable(text))) for text in d.warnings)]
    )
    yield say.Fold("", lambda: _figures(d), figures=("budget", "curves"))
    shapes = "" if len(d.effects) <= FEW else "Found effects over the joints they act at"
    yield say.Fold(shapes, lambda: effects_over_joints(d), figures=("effects",))
    yield cause_table(d)
    yield added_parameter_table(d)
    yield say.Fold("Place by place", lambda: [place_table(d)], printed=True)
    yield say.Fold("Corrections without a name", lambda: _corrections(d), printed=True)
    yield say.Fold("Error budget", lambda: [say.budget_table(*_budget(d))], printed=True)
    ranked = candidate_table(d)
    yield say.Fold(ranked.title, lambda: [ranked], printed=True)
    yield say.Fold("Rivals", lambda: [pair_table(d)], printed=True)
    yield say.Fold("Where the error comes from", lambda: [location_table(d), structure_table(d)])
    yield say.Fold("Not tested", lambda: [untested_table(d)], printed=True)
    revolute = ("revolute",) * len(d.noise.repeatability)
    kinds = revolute if d.model is None else d.model.chain.kinds
    along = "" if say.of_distances(d.model) else " per axis"
    noise = [("Noise", text) for text in noise_floor_lines(d.noise, kinds, along)]
    yield say.Fold("Noise", lambda: [say.Lines(noise)], printed=True)
    if d.noise.faulty:
        faulty = sorted(d.noise.faulty, key=lambda f: -f.sigmas)
        each = [(f, f.error, f.sigmas) for f in faulty]
        yield say.Fold("Outliers excluded", lambda: say.outlier_blocks("", each))
    if (base := d.calibrated) is not None:
        yield say.Fold("Residuals of the calibrated arm", lambda: _residuals(base),
                   figures=("space", "residuals", "against_joints", "over_time"))  # fmt: skip


def _figures(d: Diagnosis) -> Iterator[say.Figure]:
    if d.budget:
        yield waterfall("budget", *_budget(d))
    if d.curves:
        yield unknown_curves(d)


def _residuals(base: Baseline) -> Iterator[say.Block]:
    from elastocal.report.arm_view import residual_arm

    residuals = Residuals(base.model, base.observed, base.x, base.residual)
    yield say.Sentence("What the model leaves before the effects found are added.")
    yield residual_arm(*residuals.fit)
    yield from (*residuals.figures(), *residuals.others())


def noise_floor_lines(
    noise: diagnosis.NoiseFloor, kinds: Iterable[str], along: str = " per axis"
) -> Iterator[str]:
    text = f"A reading scatters by {say.length(noise.reading_sigma)} rms{along}"
    if noise.stated:
        text += f", {say.significant(noise.stated_factor, 2)} times what is stated, and "
        text += f"{say.significant(noise.ratio_to_stated)} times with the scatter of the joints"
    yield f"{text}{'' if noise.stated else '; nothing was stated'}."
    joints = [
        f"joint {i + 1} {say.significant(value * 1e6, 2)} {'µrad' if kind == 'revolute' else 'µm'}"
        for i, (value, kind) in enumerate(zip(noise.repeatability, kinds, strict=True))
        if value > 0
    ]
    yield f"Repeatability from visit to visit: {', '.join(joints) or 'none found'}."
    if noise.shared > 0:
        times = say.significant(noise.shared, 2)
        yield f"Visits of a configuration have a common scatter of {times} times that."
    common = "deviation common to a configuration"
    for what, size in (("drift", noise.drift), (common, noise.configuration)):
        if size > 0:
            yield f"The {what} of {say.length(size)} that [noise] states counts as noise."
    if noise.pure_error is None:
        yield "No repeats: residuals alone tell the noise, with one marker hardly that of joints."
    else:
        yield f"Repeats scatter by {say.length(noise.pure_error)} rms{along}."
    if (near := noise.near_repeats) is not None:
        text = f"Readings at nearly the same pose ({say.counted(near.pairs, 'pair')}) scatter by "
        text += f"{say.length(near.scatter)} rms{along}"
        if near.soon is not None and near.later is not None:
            text += f" (measured soon after each other {say.length(near.soon)}, in other parts of "
            text += f"the session {say.length(near.later)})"
        yield f"{text}."
    if n := len(noise.faulty):
        worst = say.length(max(f.error for f in noise.faulty))
        yield f"{say.counted(n, 'outlier was', 'outliers were')} excluded, the worst {worst} off."


def diagnosis_headline(d: Diagnosis) -> str:
    if d.groups:
        large = [g for k, g in enumerate(d.groups[:MOST_IN_HEADLINE]) if k == 0 or g.share >= FINE]
        told = [
            f"{say.effect_at_places(g.name, g.places)} "
            f"({share_text(g.share) if g.share <= 1 else '> 100 %'}"
            f"{' of the remaining error' * (k == 0)})"
            for k, g in enumerate(large)
        ]
        if more := len(d.groups) - len(told):
            told.append(say.counted(more, "smaller effect"))
        first, n = d.groups[0], len(d.indistinguishable)
        one = max(len(d.groups), len(first.places)) == 1 and not first.name.endswith("errors")
        open_ = f"leave {'one effect' if n == 1 else f'{n} effects'} of it open"
        at = say.places(dict.fromkeys(c.where for c in d.components if not c.named))
        where = f"at {at}" if at else ""
    else:
        told, open_ = [], "cannot decide"
        for f in d.effects:  # with its probability and, where it happened once, when
            moments = {k: v for k, v in f.settings.items() if k in MOMENTS}
            when = f"; {settings_of(d, moments)}" if moments else ""
            told.append(f"{say.effect_at(f)} (probability {say.probability(f.probability)}{when})")
        if d.verdict == "ambiguous":
            told = [
                f"either {say.together([say.effect_at(e) for e in s], 'or')}"
                for s in d.indistinguishable
            ]
        one, where = len(told) == 1, location_text(d.location) if d.location else ""
    s, text = "s" * one, say.capital(say.together(told))
    if d.verdict == "explained":
        return f"{text} explain{s} the remaining error."
    if d.verdict == "ambiguous":
        return f"{text} cause{s} the remaining error; these data {open_}."
    if d.groups or (told and d.verdict == "unknown_effect"):
        text += f" cause{s} part of the remaining error; an effect outside the catalogue acts"
        return f"{text}{f' {where}' if where else ''}."
    if d.verdict == "unknown_effect":
        text = "An effect outside the catalogue causes the remaining error"
        return f"{text}, {where}." if where else f"{text}; the data do not show where."
    none = f"probability of none: {say.probability(d.probability_nothing)}"
    if not d.doubtful:
        return f"No further effect exceeds the noise; {none}."
    return (
        "No effect is named: something may be missing, but nothing both stands out from the noise "
        f"and lowers the error at poses left out of the fit ({none})."
    )


def location_text(location: diagnosis.Location) -> str:
    at, stage = say.place(location.where), say.STAGES[location.stage]
    where = f"at {'the ' * (at in say.SINGLE)}{at}"
    if stage not in at and not stage.startswith(at.split()[0]):  # not "at link 2, in the links"
        where += f", in the {stage}"
    return f"{where} (probability {say.probability(location.probability)})"


def diagnosis_lines(d: Diagnosis) -> Iterator[tuple[str, str]]:
    yield "Error", _error_line(d)
    if d.gap.scatters:  # what looks like noise and is none
        yield (
            "Error",
            f"{say.length(d.gap.unexplained)} rms are unexplained: they look like scatter of the "
            "arm, but repeats do not show them, neighbours in pose or time share them, or joints "
            "do not scatter that much.",
        )
    unknown = d.verdict == "unknown_effect"
    if unknown:
        told = [f"{say.driver_name(t.driver)} ({say.size_of(t.p_family)})" for t in d.dependences]
        shape = "; see the curves for its shape" if d.curves else ""
        none = f"no single driver that was tested shows it{shape}"
        yield "Depends on", f"{some(told, MOST_NAMED) or none}."
    chance = " after correction for all candidates."
    if not d.effects and d.p_value > diagnosis.STRUCTURE:
        chance = " for the strongest candidate, corrected for all candidates."
    if d.groups:
        if spans := [f"{curve_span(curve)} ({say.place(curve.entry)})" for curve in d.curves]:
            text = "the joints' errors against their own angles span"
            yield "Curves", f"{text} {say.together(spans)}."
        matters = any(c.family == "move" for c in d.components) or "approach" in d.model_keys
        if matters and d.calibrated and d.calibrated.observed.table.time is None:
            yield (
                "Assumed",
                "the last move is that from the visit before, in the order of the rows; if they "
                "were not measured so, do not rely on effects of the last move.",
            )
    else:
        for curve in d.curves if unknown else ():
            moved = f"{say.driver_name(curve.driver)} moves {say.driver_name(curve.entry)}"
            yield "Shape", f"{moved} by {curve_span(curve)} in all."
        open_sets = {(e.effect, e.where) for rivals in d.indistinguishable for e in rivals}
        for f in d.effects if d.verdict == "ambiguous" else ():
            text = f"{say.effect_at(f)} (probability {say.probability(f.probability)}"
            text += f"; {settings_of(d, f.settings)})." if f.settings else ")."
            yield "Likeliest" if (f.effect, f.where) in open_sets else "Besides", text
        if d.verdict == "nothing_significant":
            yield from (("Sensitivity", text) for text in sensitivity(d))
        elif d.verdict == "ambiguous" and d.location is not None:
            yield "Location", f"{location_text(d.location)}."
    yield "Chance", f"{say.size_of(d.p_value)}{chance}"


def _error_line(d: Diagnosis) -> str:
    calibrated, floor = say.length(d.gap.calibrated), say.length(d.gap.noise_floor)
    if not d.effects:
        return f"Held-out error: {calibrated} rms (noise alone: {floor})."
    text = f"Held-out error: {calibrated} rms, with the effects found "
    text += f"{say.length(d.gap.explained)} rms (noise alone: {floor})."
    if d.groups:  # the table of causes says what each takes away
        nameless = [say.length(s.heldout_rms) for s in d.budget if s.step.startswith("unknown:")]
        return text + f" With unnamed smooth corrections: {nameless[-1]}." if nameless else text
    falls = [
        f"{share_text(f.gap_reduction)} ({span_text(f.gap_reduction_ci95, f.gap_reduction)})"
        for f in d.effects
    ]
    if len(falls) == 1:
        return f"{text} The noise-free error at new poses falls by {falls[0]}."
    each = [f"{say.effect_at(f)} removes {fall}" for f, fall in zip(d.effects, falls, strict=True)]
    return f"{text} Added last, {say.together(each)} of the noise-free error at new poses."


def settings_of(d: Diagnosis, settings: Mapping[str, float]) -> str:
    table = None if d.calibrated is None else d.calibrated.observed.table
    lines = () if table is None or table.time is not None else np.unique(by_rows(table)).tolist()
    return say.settings_text(settings, lines)


def sensitivity(d: Diagnosis) -> Iterator[str]:
    if not d.candidates:
        return
    if math.isfinite(d.smallest_seen):
        yield (
            f"effects above about {say.length(d.smallest_seen, 2)} rms at the "
            "markers, not absorbed by fitted parameters, would have been found."
        )
    visible = sum(c.visible for c in d.candidates)
    text = f"of {len(d.candidates)} candidates {visible} would have been found at typical size"
    faint = [c for c in d.candidates if c.hidden]
    if rest := len(d.candidates) - visible - len(faint):
        text += f", {rest} more perhaps"
    if faint:
        kinds = dict.fromkeys(say.plain_name(c.effect) for c in faint)
        names = some(kinds, MOST_NAMED, more=" and {} more kinds")
        text += f"; below the noise even then: {len(faint)} ({names})"
    yield f"{text}."


def diagnosis_steps(d: Diagnosis) -> Iterator[str]:
    yield from (f.remedy for f in d.findings if f.remedy)
    if (extra := d.extra) is not None:
        rivals, n = say.together([say.name_of(name) for name in extra.rivals], "or"), extra.n_poses
        if not (extra.separable or extra.inseparable):
            yield f"No pose that this cell allows separates {rivals}."
        elif extra.separable:
            yield (
                f"{say.counted(n, 'more pose')} to separate {rivals}: the probability of the right "
                f"answer rises from {say.probability(extra.probability_before)} to "
                f"{say.probability(extra.probability_after)} (as many random poses: "
                f"{say.probability(extra.probability_random)})."
            )
        # Longer names first: one may begin another.
        plain = {name: say.name_of(name) for name in sorted(extra.rivals, key=len, reverse=True)}
        for text in extra.advice:
            for name, told in plain.items():
                text = text.replace(name, told)
            yield say.sentence(printable(text))
    # One piece of advice serves many effects.
    yield from dict.fromkeys(say.sentence(printable(u.advice)) for u in d.untested)


def alike(d: Diagnosis) -> list[str]:
    """Sets of effects that these data cannot tell apart; beside many causes, the one that was taken
    with its probability."""
    taken = {(f.effect, f.where): f.probability for f in d.effects} if d.groups else {}

    def told(e: diagnosis.EffectAt) -> str:
        p = taken.get((e.effect, e.where))
        return say.effect_at(e) + ("" if p is None else f" (probability {say.probability(p)})")

    return [say.together([told(e) for e in rivals]) for rivals in d.indistinguishable]


def _budget(d: Diagnosis) -> say.Budget:
    steps = [step for step in d.budget if step.step != "noise_floor"]
    named = [(say.name_of(step.step), step.heldout_rms, step.ci95) for step in steps]
    return named, ("noise alone", d.gap.noise_floor), say.rms(d.model)


def candidate_table(d: Diagnosis) -> say.ShownTable:
    rows = []
    for c in d.candidates[:MOST_CANDIDATES]:
        seen = "–"
        if math.isfinite(c.seen_from):
            seen = f"> {ABSURD:.0f}" if c.seen_from > ABSURD else say.significant(c.seen_from, 2)
        rows.append(
            (say.effect_at(c), say.probability(c.probability), f"{c.score:+.1f}",
             say.significant(c.detectable, 2), seen, settings_of(d, c.settings))
        )  # fmt: skip
    title = f"Candidates{' one at a time' if d.groups else ''}"
    title += f", rank 1 to {len(rows)} of {len(d.candidates)}"
    none = ("", "", "", "")
    rows.append(("an effect outside the catalogue", say.probability(d.probability_unknown), *none))
    rows.append(("no further effect", say.probability(d.probability_nothing), *none))
    heads = ("candidate", "probability", "evidence", "d", "seen from", "settings")
    table = say.ShownTable(heads, rows, (0, 5), title=title, note=(
        "evidence: log marginal likelihood over that of no further effect. d: standard deviations "
        "by which the typical size moves the data; below 3 it is below the noise. seen from: "
        "smallest detectable size, in typical sizes."
    ))  # fmt: skip
    return table.when_narrow(5) if any(row[5] for row in rows) else table.without(5)


def added_parameter_table(d: Diagnosis) -> say.ShownTable:
    rows: list[tuple[str, ...]] = []
    for f in d.effects:
        for p in f.parameters:
            told = p.value if math.isfinite(p.std) else math.nan
            rows.append(
                (printable(p.name), *say.estimate(told, diagnosis.NORMAL_95 * p.std, p.unit))
            )
        if f.settings:
            rows.append((f"{say.effect_at(f)}: {settings_of(d, f.settings)}", "", "", ""))
    title = "Parameters of the effects found"
    unknown = any(math.isinf(p.std) for f in d.effects for p in f.parameters)
    note = "–: undetermined; the data show only what these parameters do together." * unknown
    heads = ("parameter", "value", "± 95 %", "unit")
    table = say.ShownTable(heads, rows, (0, 3), title=title, note=note)
    return table if any(value for _, value, *_ in rows) else table.without(1, 2, 3)


def structure_table(d: Diagnosis) -> say.ShownTable:
    tests = sorted(d.structure, key=lambda t: (t.p_family, t.p_value))[:MOST_TESTS]
    rows = [
        (say.driver_name(t.driver), say.p_value(t.p_value), say.p_value(t.p_family)) for t in tests
    ]
    return say.ShownTable(("depends on", "p", "p, all tests"), rows, note=(
        "Does the residual depend on it at all? These tests name no effect: whole configurations "
        f"change sign, and the last column counts all {len(d.structure)}."
    ))  # fmt: skip


def pair_table(d: Diagnosis) -> say.ShownTable:
    rows = [
        (f"{say.name_of(pair.first)} or {say.name_of(pair.second)}",
         say.significant(pair.distance_before, 2), say.significant(pair.distance_after, 2))
        for pair in (() if d.extra is None else d.extra.pairs)
    ]  # fmt: skip
    heads = ("rivals", "d so far", "d with the extra poses")
    return say.ShownTable(heads, rows, title="Rivals", note=(
        "d is the distance of the two in standard deviations of the data; the best test between "
        "them is right with probability Φ(d/2)."
    ))  # fmt: skip


def untested_table(d: Diagnosis) -> say.ShownTable:
    groups: dict[tuple[str, str], dict[str, list[str]]] = {}
    for u in d.untested:
        effects = groups.setdefault((printable(u.reason), printable(u.advice)), {})
        effects.setdefault(say.plain_name(u.effect), []).append(u.where)
    rows = [
        (", ".join(f"{name} ({say.places(at, True)})" for name, at in effects.items()), *reason)
        for reason, effects in groups.items()
    ]
    return say.ShownTable(
        ("effect", "why", "record or measure"), rows, (0, 1, 2), title="Not tested"
    )


def location_table(d: Diagnosis) -> say.ShownTable:
    if (location := d.location) is None:
        return say.ShownTable((), [])
    found = location.shares or location.stages
    rows = [
        (name, share_text(min(value, 1.0)) if location.shares else say.probability(value))
        for stage, name in say.STAGES.items()
        for value in (found.get(stage, 0.0),)
    ]
    if location.shares:
        return say.ShownTable(("where", "share of the error"), rows, groups={0: "stages"})
    groups = {0: "stages", len(rows): "places"}
    order = sorted(location.places, key=location.places.__getitem__, reverse=True)[:MOST_PLACES]
    rows += [(say.place(where), say.probability(location.places[where])) for where in order]
    return say.ShownTable(("where", "probability"), rows, groups=groups)


def _error_of(c: diagnosis.ComponentShare) -> str:
    return FAMILIES.get(c.family, say.plain_name(c.family))


def _unnamed(d: Diagnosis) -> list[tuple[str, diagnosis.ComponentShare]]:
    return [
        (f"{NAMELESS}, {_error_of(c)} at {say.place(c.where)}", c)
        for c in d.components
        if not c.named
    ]


def share_text(fraction: float, fine: bool | None = None) -> str:
    if not math.isfinite(fraction):
        return "–"
    fine = abs(fraction) < FINE if fine is None else fine
    if fine and 0 < fraction < 0.0005:
        return "< 0.1 %"
    digits = 1 if fine else 0
    return f"{round(100 * fraction, digits) + 0.0:.{digits}f} %"


def span_text(ends: diagnosis.Interval, middle: float) -> str:
    """ "50 to 59 %", "1.2 to 2.0 %", as fine as what is in the `middle`."""
    low, high = ends
    if not (math.isfinite(low) and math.isfinite(high)):
        return "–"
    fine = abs(middle) < FINE
    return f"{share_text(low, fine).removesuffix(' %')} to {share_text(high, fine)}"


def cause_table(d: Diagnosis) -> say.ShownTable:
    rows = [
        (
            say.effect_at_places(g.name, g.places), share_text(g.share),
            span_text(g.share_ci90, g.share), share_text(g.gap_reduction),
            span_text(g.gap_reduction_ci90, g.gap_reduction),
        )
        for g in d.groups
    ]  # fmt: skip
    rows += [
        (name, share_text(c.share), span_text(c.share_ci90, c.share), "–", "–")
        for name, c in _unnamed(d)
    ]
    if d.gap.unexplained_share >= FINE**2:
        rows.append(("unexplained", share_text(d.gap.unexplained_share), "–", "–", "–"))
    over = any(g.share > 1 for g in d.groups) or any(c.share > 1 for _, c in _unnamed(d))
    heads = ("cause", "share", "90 %", "error falls by", "90 %")
    return say.ShownTable(heads, rows, title="Causes of the remaining error", note=(
        "share: part of the squared remaining error that goes when this is added last. error falls "
        "by: at new poses, when this is added to a model with all the others."
        + " A share above 100 %: causes that partly cancel each other." * over
    ))  # fmt: skip


def place_table(d: Diagnosis) -> say.ShownTable:
    named = [c for c in d.components if c.named]
    found = [
        (say.effect_at_places(g.name, g.places),
         [c for c in named if c.where in g.places and set(c.effects) & set(g.effects)])
        for g in d.groups
    ]  # fmt: skip
    found += [(name, [c]) for name, c in _unnamed(d)]
    rows, groups = list[tuple[str, ...]](), dict[int, str]()
    told: list[diagnosis.ComponentShare] = []
    for name, of_it in found:
        if parts := [c for c in of_it if c not in told]:
            groups[len(rows)] = name
        for c in parts:
            low, high = map(say.length, c.rms_ci95)
            low = low.removesuffix(high[high.rfind(" ") :])  # "266 to 293 µm"
            rows.append((
                say.place(c.where), _error_of(c),
                ", ".join(map(say.plain_name, c.effects)) if c.named else NAMELESS,
                f"{say.length(c.rms)} ({low} to {high})",
                f"{share_text(c.share)} ({span_text(c.share_ci90, c.share).removesuffix(' %')})",
                say.probability(c.probability),
            ))  # fmt: skip
        told += parts
    heads = ("place", "error", "as", "rms (95 %)", "share (90 %)", "probability")
    table = say.ShownTable(heads, rows, (0, 1, 2), groups, title="Place by place")
    return table.when_narrow(2)  # what it is as effects stands in the table of parameters too


def curve_span(curve: diagnosis.Curve) -> str:
    moved = max(curve.y) - min(curve.y)
    if curve.y_unit == "m":
        return say.length(moved)
    shown, unit = say.display(moved, curve.y_unit)
    return f"{say.significant(shown)} {unit}"


def _corrections(d: Diagnosis) -> Iterator[say.Block]:
    rows = [row for f in d.fields for row in _followed(f)]
    heads = ("correction at", "follows", "size", "over", "error falls by", "95 %")
    yield say.ShownTable(heads, rows, (0, 1), title="Corrections without a name", note=(
        "Functions without a physical name; they hold where the arm was measured: size (standard "
        "deviation) and the length over which smooth ones change."
    ))  # fmt: skip
    if d.slight:
        at = next((k for k, step in enumerate(d.budget) if step.step == "rest"), 0)
        gone = d.budget[at - 1].heldout_rms - d.budget[at].heldout_rms if at else 0.0
        together = f", or told by what was found; together {say.length(gone)} of the held-out error"
        together *= gone > SLIGHT * d.gap.calibrated
        yield say.Sentence(
            f"{added_text(d.slight)}: probably less than a hundredth of the remaining error each"
            f"{together}. They correct the arm and are not findings."
        )


# What corrections that are no smooth functions follow, by the setting that is their size.
FOLLOWED = {
    "spectrum_size_rad": "its own angle, by lines", "step_size": "the time, by a step",
    "torque_response_rad": "its torque", "approach_response_rad": "its last motion",
    "load_response_size": "the load's force and moment",
}  # fmt: skip


def _followed(f: diagnosis.FoundEffect) -> Iterable[tuple[str, ...]]:
    """A row for everything that a field follows; the last columns in the first row only."""
    fall, kind = f.gap_reduction, f.where.partition(":")[0].rstrip("0123456789")
    told: Sequence[str] = (share_text(fall), span_text(f.gap_reduction_ci95, fall))
    unit = {"joint": "mrad", "marker": "mm"}.get(kind, "mm, mrad")
    for key, value in f.settings.items():
        name, _, rest = key.rpartition("size")
        if key not in FOLLOWED and (not name or rest not in ("", "_rad")):
            continue
        over = f.settings.get(f"{name}length{rest}", math.nan)
        of = name.rstrip("_").partition("_")[2]
        timed = of == "time"
        angle = f"the angle of {say.place(of)}" if of else "its own angle"
        shown = say.setting_value("over_s" if timed else "over_rad", over)
        size = f"{say.significant(value * 1e3, 2)} {unit}"
        what = FOLLOWED.get(key, "the time" if timed else angle)
        yield say.place(f.where), what, size, shown if math.isfinite(over) else "–", *told
        told = ("", "")


def added_text(found: Sequence[diagnosis.FoundEffect]) -> str:
    """What a written cell has more, by effect: "gear_ripple:joint1", or many of them in short."""
    if len(found) <= 2 * MOST_IN_HEADLINE:
        return ", ".join(f"{f.effect}:{f.where}" for f in found)
    at: dict[str, list[str]] = {}
    for f in found:
        at.setdefault(f.effect, []).append(f.where)
    return ", ".join(f"{printable(name)} ({say.places(where)})" for name, where in at.items())
