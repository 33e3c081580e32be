"""Can this calibration be trusted?  The findings in one sentence, and what to do next."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from elastocal.identification.findings import next_steps
from elastocal.identification.result import Finding, IdentificationResult
from elastocal.report.units import length, significant

Tone = Literal["good", "care", "poor"]
# Sections of the page, by the finding they tell of, and the words that they are named after.
SECTIONS = {
    "faulty_readings": ("beyond the noise", "Faulty readings"),
    "undetermined": ("from these data", "What is not determined"),
}


@dataclass(frozen=True)
class Judgement:
    """`tone`: good (use it), care (use it knowing what is wrong), poor (do not use it)."""

    tone: Tone
    headline: str
    steps: tuple[str, ...]


def judgement(result: IdentificationResult, sections: bool = False) -> Judgement:
    """How good the calibration is and what follows from it, as the result's findings say.

    `sections`: the steps name the sections of the page.
    """
    steps = tuple(_step(f, sections) for f in next_steps(result))
    trust = result.finding("trust")
    assert trust is not None, "every identification is judged"
    if trust.severity == "poor":
        why = next(f for f in result.findings if f.severity == "poor" and f is not trust)
        return Judgement("poor", f"Do not use this calibration: {DOUBTS[why.kind](why)}.", steps)
    told = _accuracy(result)
    if trust.severity == "care":
        doubts = [f for f in result.findings if f.severity == "care" and f is not trust]
        named = "; and ".join(DOUBTS[f.kind](f) for f in doubts)
        text = f"Use this calibration with care: {told}, but {named}."
        return Judgement("care", text, steps)
    compared = result.finding("residual_agrees_with_stated_noise", "residual_below_stated_noise")
    noise = "" if compared is None else ", and the residual is noise"
    return Judgement("good", f"This calibration can be trusted: {told}{noise}.", steps)


def _step(f: Finding, sections: bool) -> str:
    if not sections or f.kind not in SECTIONS:
        return f.remedy
    phrase, section = SECTIONS[f.kind]
    return f.remedy.replace(phrase, f"{phrase} ({section})", 1)


def _length(f: Finding, name: str) -> str:
    return length(f.number(name) * 1e-6)


# What speaks against a calibration, in words.
DOUBTS: dict[str, Callable[[Finding], str]] = {
    "not_converged": lambda f: f"the fit did not converge ({f.numbers['reason']})",
    "no_better_than_nominal": lambda f: (
        f"unseen poses are predicted to {_length(f, 'heldout_rms_um')} rms, and the nominal arm "
        f"does as well ({_length(f, 'nominal_rms_um')})"
    ),
    "not_held_out": lambda f: (
        "how well it predicts other poses is not known: some pose alone determines a parameter"
    ),
    "residual_above_stated_noise": lambda f: (
        f"the residual is {significant(f.number('ratio'))} times the stated noise"
    ),
    "lack_of_fit": lambda f: "configurations scatter more than repeats of one explain",
    "fit_flatters": lambda f: (
        f"unseen poses are worse than fitted ones ({_length(f, 'residual_rms_um')})"
    ),
    "little_gain": lambda f: "that is hardly better than the nominal arm",
    "many_faulty_readings": lambda f: (
        f"{f.numbers['faulty']} of the {f.numbers['fitted']} readings fitted lie beyond what the "
        "noise explains"
    ),
    "test_data_worse": lambda f: (
        f"test data are off by {_length(f, 'test_rms_um')} rms, more than chance explains"
    ),
}


def _accuracy(result: IdentificationResult) -> str:
    what = {"deflection": "deflections", "distance": "distances"}.get(
        result.observations.kind, "positions"
    )
    if not math.isfinite(result.heldout_rms):
        return f"it reproduces the {what} that were fitted to {length(result.residual_rms)} rms"
    text = f"{what} in poses that were not fitted are predicted to {length(result.heldout_rms)} rms"
    gain = result.nominal_rms / result.heldout_rms if result.heldout_rms > 0 else math.inf
    if math.isfinite(gain):
        text += f", {significant(gain, 2)} times better than by the nominal arm"
    return text
