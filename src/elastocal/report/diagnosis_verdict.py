"""What a diagnosis says in sentences: the verdict, where it points, what to do next."""

from __future__ import annotations

import math

from elastocal.diagnosis.result import Candidate, Curve, Diagnosis, FoundEffect, Location
from elastocal.diagnosis.separate.result import ExtraPlan
from elastocal.report.diagnosis_words import (
    STAGES,
    capital,
    driver_name,
    effect_at,
    name_of,
    place,
    plain_name,
    probability,
    reduction,
    settings_text,
    size_of,
    together,
)
from elastocal.report.units import display, length, significant
from elastocal.report.words import printable

ABSURD = 100.0  # typical sizes: no arm has an effect that large, whatever the readings could show
MOST_NAMED = 6


def headline(d: Diagnosis) -> str:
    """The verdict in one sentence."""
    if d.verdict == "explained":
        named = [f"{effect_at(f)} (probability {probability(f.probability)})" for f in d.effects]
        return f"{capital(together(named))} explain{'s' * (len(named) == 1)} the gap."
    if d.verdict == "ambiguous":
        return _ambiguous(d)
    if d.verdict == "unknown_effect":
        return _unknown(d)
    return (
        "No further effect shows above the noise: the probability that there is none is "
        f"{probability(d.probability_nothing)}."
    )


def _ambiguous(d: Diagnosis) -> str:
    sets = [together([effect_at(e) for e in rivals], "or") for rivals in d.indistinguishable]
    text = together([f"either {rivals}" for rivals in sets])
    return f"{capital(text)} make{'s' * (len(sets) == 1)} the gap; these data cannot tell which."


def _unknown(d: Diagnosis) -> str:
    text = "Something that is not in the catalogue makes the gap"
    if d.effects:
        each = [f"{effect_at(f)} (probability {probability(f.probability)})" for f in d.effects]
        named = together(each)
        verb = "make" if len(each) > 1 else "makes"
        text = f"{capital(named)} {verb} part of the gap; beside it, something not in the catalogue"
        return f"{text} acts {location_text(d.location)}." if d.location else f"{text} acts."
    if d.location is None:
        return f"{text}; the data do not show where it sits."
    return f"{text}: it sits {location_text(d.location)}."


def location_text(location: Location) -> str:
    """ "at joint 2, in the transmission (probability 0.97)"."""
    at, stage = place(location.where), STAGES[location.stage]
    where = f"at {at}, in the {stage}" if at != stage else f"at the {at}"
    return f"{where} (probability {probability(location.probability)})"


def verdict_lines(d: Diagnosis) -> list[tuple[str, str]]:
    """(label, sentence) on what was found, for the terminal and the head of the page."""
    lines = [("Verdict", headline(d))]
    lines += [("Error", text) for text in _error_lines(d)]
    if d.verdict == "unknown_effect":
        lines += [("Depends on", text) for text in _dependence(d)]
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
    if not d.effects:
        return [
            f"On held-out poses the calibrated arm is off by {calibrated} rms; noise alone "
            f"gives {floor}."
        ]
    text = (
        f"On held-out poses the error falls from {calibrated} to {length(d.gap.explained)} rms "
        f"(noise alone: {floor})."
    )
    if len(d.effects) == 1:
        return [f"{text} The noise-free error of fresh poses shrinks by {reduction(d.effects[0])}."]
    each = [f"{effect_at(f)} takes away {reduction(f)}" for f in d.effects]
    return [f"{text} Of the noise-free error of fresh poses {together(each)}."]


def _finding_line(d: Diagnosis, f: FoundEffect) -> tuple[str, str]:
    """An effect beside the open question, or the likeliest answer to it."""
    open_sets = {(e.effect, e.where) for rivals in d.indistinguishable for e in rivals}
    label = "Likeliest" if (f.effect, f.where) in open_sets else "Besides"
    text = f"{effect_at(f)} (probability {probability(f.probability)}"
    return label, f"{text}; {settings_text(f.settings)})." if f.settings else f"{text})."


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
    moved = max(curve.y) - min(curve.y)
    how_far = length(moved) if curve.y_unit == "m" else _in_unit(moved, curve.y_unit)
    return f"{driver_name(curve.driver)} moves {driver_name(curve.entry)} by {how_far} in all."


def _in_unit(value: float, unit: str) -> str:
    shown, text = display(value, unit)
    return f"{significant(shown)} {text}"


def _chance(d: Diagnosis) -> str:
    if d.verdict == "nothing_significant":
        return f"the strongest candidate is one that noise alone yields with {size_of(d.p_value)}."
    return f"noise alone yields such a finding with {size_of(d.p_value)}, all candidates counted."


def sensitivity(d: Diagnosis) -> list[str]:
    """How small an effect would have been seen."""
    if not d.candidates:
        return []
    lines = []
    if math.isfinite(d.smallest_seen):
        lines.append(
            f"effects that move the markers by more than about "
            f"{significant(d.smallest_seen * 1e6, 2)} µm rms, in a way that the fitted parameters "
            "cannot follow, would have been seen."
        )
    visible = [c for c in d.candidates if c.visible]
    faint = [c for c in d.candidates if c.hidden]
    text = f"of {len(d.candidates)} candidates {len(visible)} would have shown at typical size"
    if faint:
        by_effect = dict.fromkeys(plain_name(c.effect) for c in faint)
        names = list(by_effect)[:MOST_NAMED]
        more = len(by_effect) - len(names)
        text += f"; hidden in the noise even then: {len(faint)} ({', '.join(names)}"
        text += f" and {more} more kinds)" if more else ")"
    return [*lines, f"{text}."]


def seen_from(c: Candidate) -> str:
    """The size from which an effect would be seen, in typical sizes: "0.4"."""
    if not math.isfinite(c.seen_from):
        return "–"
    return f"> {ABSURD:.0f}" if c.seen_from > ABSURD else significant(c.seen_from, 2)


def next_steps(d: Diagnosis) -> list[str]:
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
        lines = [f"No pose that this cell allows tells apart {rivals}."]
    else:
        n = extra.n_poses
        lines = [
            f"{n} more pose{'s' if n != 1 else ''} to tell apart {rivals}: the probability of "
            f"naming the right one rises from {probability(extra.probability_before)} to "
            f"{probability(extra.probability_after)} (as many random poses: "
            f"{probability(extra.probability_random)})."
        ]
        for group in extra.inseparable:
            lines.append(f"{capital(together([name_of(name) for name in group]))} count as one.")
    return lines + [capital(printable(text)) for text in extra.advice]
