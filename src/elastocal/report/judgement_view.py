"""The judgement of an identification in words: the verdict, what speaks against it, what to do."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from elastocal.errors import option
from elastocal.identification.far_values import only_placed
from elastocal.identification.findings import next_steps
from elastocal.identification.result import Calibration, Finding
from elastocal.report.formatting import Tone, counted, display, estimate, length, significant
from elastocal.text import listed, printable

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

    @property
    def lines(self) -> list[tuple[str, str]]:
        """Label and sentence of the verdict and of each step."""
        steps = [("Next", printable(step)) for step in self.steps]
        return [("Verdict", printable(self.headline)), *steps]


def judgement(result: Calibration, sections: bool = False) -> Judgement:
    """How good the calibration is and what follows from it, as the result's findings say.

    `sections`: the steps name the sections of the page.
    """
    steps = tuple(_step(f, sections) for f in next_steps(result))
    trust = result.finding("trust")
    assert trust is not None, "every identification is judged"
    if trust.severity == "poor":
        why = next(f for f in result.findings if f.severity == "poor" and f is not trust)
        return Judgement("poor", f"Do not use this calibration: {DOUBTS[why.kind](why)}.", steps)
    told, elsewhere = _accuracy(result), _load_point(result)
    verdict = result.verdict
    if trust.severity == "care":
        named = "; and ".join(DOUBTS[f.kind](f) for f in verdict.missing)
        return Judgement(
            "care", f"Use this calibration with care: {told}{elsewhere}. But {named}.", steps
        )
    compared = result.finding(
        "residual_agrees_with_stated_noise", "residual_below_stated_noise",
        "residual_agrees_with_readings",
    )  # fmt: skip
    noise = "" if compared is None else ", and the residual is noise"
    at = "" if verdict.at is None else f" at {length(verdict.at)}"
    text = f"This calibration can be trusted{at}: {told}{noise}{elsewhere}."
    return Judgement("good", text, steps)


# What verdict, next step and the line on noise say already.
SAID = ("residual_above_stated_noise", "scatter_not_counted")


def warnings_beside(result: Calibration) -> list[str]:
    """The warnings that say more than the verdict and what to do next."""
    said = {f.kind for f in result.verdict.missing} & set(SAID)
    return [printable(str(w)) for w in result.warnings if getattr(w, "kind", "") not in said]


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
        "how well it predicts poses left out is not known: some pose alone determines a parameter, "
        "and nothing checks it"
        + (
            f" ({_length(f, 'unchecked_um')} of the {_length(f, 'rms_um')} to be expected at new "
            "poses)"
            if f.numbers
            else ""
        )
    ),
    "residual_above_stated_noise": lambda f: (
        f"the residual is {significant(f.number('ratio'))} times the stated noise"
    ),
    "residual_below_stated_noise": lambda f: (
        f"the noise is stated too large (the residual is {significant(f.number('ratio'))} times "
        "it), so nothing shows whether the model lacks something"
    ),
    "residuals_heavy_tailed": lambda f: (
        "far errors are more frequent than normal noise makes them (excess kurtosis "
        f"{f.number('excess_kurtosis'):+.2g})"
    ),
    "autocorrelated": lambda f: (
        "residuals of visits that follow each other are alike, as under a drift"
    ),
    "load_unit": lambda f: (
        f"the compliances are {significant(f.number('ratio'), 2)} times what {f.numbers['by']} let "
        "expect: the loads may be in another unit"
    ),
    "scatter_not_counted": lambda f: (
        "residuals scatter from visit to visit, or drift, as the noise model does not have it"
    ),
    "lack_of_fit": lambda f: "configurations scatter more than repeats of one explain",
    "fit_flatters": lambda f: (
        f"unseen poses are worse than fitted ones ({_length(f, 'residual_rms_um')})"
    ),
    "scale": lambda f: (
        f"all lengths read are {significant(f.number('readings_over_file'), 4)} times those of the "
        "robot's file: one scale, as of a tag or a unit of another size"
    ),
    "unheard_of": lambda f: _unheard_of(f),
    "little_gain": lambda f: "that is hardly better than the nominal arm",
    "few_configurations": lambda f: (
        f"in {counted(int(str(f.numbers['configurations'])), 'configuration')} there are only "
        f"{f.numbers['equations_left']} equations beyond {f.numbers['parameters']} parameters, too "
        f"few to judge by (needed: {f.numbers['needed']})"
    ),
    "noise_unknown": lambda f: (
        "nothing says how large the noise is (no stated noise, no repeats), so the residual may "
        "hide what the model lacks"
    ),
    "new_poses_not_shown": lambda f: (
        f"at new poses {_length(f, 'open_um')} are to be expected of what the measured poses do "
        f"not show ({listed([printable(str(n)) for n in f.listed('parameters')], 3)})"
    ),
    "new_poses_no_gain": lambda f: (
        f"at new poses {_length(f, 'rms_um')} are to be expected, "
        + (
            "hardly better than"
            if f.number("rms_um") <= f.number("nominal_rms_um")
            else "worse than"
        )
        + f" by the nominal arm where it was measured ({_length(f, 'nominal_rms_um')})"
    ),
    "many_faulty_readings": lambda f: (
        f"{f.numbers['faulty']} of the {f.numbers['fitted']} readings fitted lie beyond what the "
        "noise explains"
    ),
    "drift": lambda f: (
        f"base or tracker drift by {_length(f, 'sigma_um')} in the course of the campaign"
    ),
    "test_data_worse": lambda f: (
        f"test data are off by {_length(f, 'test_rms_um')} rms, more than chance explains"
    ),
    "test_data_far": lambda f: (
        f"{f.numbers['far']} of {f.numbers['configurations']} test poses lie where the fit knows "
        f"less than at every pose measured (to {_length(f, 'predicted_std_um')} rms in all, there "
        f"to {_length(f, 'fitted_std_um')} at most)"
    ),
}


def _unheard_of(f: Finding) -> str:
    """ "no arm has such values (link6.dx 32.1 mm, 32 typical sizes): …" """
    each = zip(
        f.listed("parameters"), f.listed("values"), f.listed("units"), f.listed("typical_sizes"),
        strict=True,
    )  # fmt: skip
    shown = []
    for name, value, unit, sizes in each:
        number, shown_unit = display(float(value), str(unit))
        shown.append(
            f"{printable(str(name))} at {significant(number)} {shown_unit}, "
            f"{significant(float(sizes), 2)} typical deviations from nominal"
        )
    return (
        f"no arm has such values ({listed(shown, 3)}): most likely an effect is missing that they "
        "stand in for, or these poses hardly tell them from others"
    )


def _accuracy(result: Calibration) -> str:
    """The arm's own error where nobody measured, and that of readings, which has their noise."""
    what = {"deflection": "deflections", "distance": "distances"}.get(
        result.observations.kind, "positions"
    )
    own = "the error at new poses is not known. With the noise of a reading, "
    if (at := result.verdict.at) is not None:
        most = "no more, rms," if result.verdict.trusted else f"{length(at)} rms at most"
        own = (
            f"the arm itself, without the noise of a reading, is off by {most} at new poses "
            "(95 %). With that noise, "
        )
    if not math.isfinite(result.heldout_rms):
        return f"{own}{what} that were fitted are reproduced to {length(result.residual_rms)} rms"
    text = (
        f"{own}{what} in poses that were not fitted are predicted to {length(result.heldout_rms)} "
        "rms"
    )
    gain = result.nominal_rms / result.heldout_rms if result.heldout_rms > 0 else math.inf
    if only_placed(result):
        text += _placed_markers(result)
    elif math.isfinite(gain):
        text += f", {significant(gain, 2)} times better than by the nominal arm"
    return text


def _load_point(result: Calibration) -> str:
    """That all this is about the markers, where the load point is known worse."""
    if result.load_point_error is None:
        return ""
    marker = printable(next(iter(result.model.cell.tool.markers)))
    return (
        f". That is so of the markers; the load point, where compensate goes by default, is known "
        f"to {length(result.load_point_error)} rms only, as nothing measured says where it lies "
        f"among them: measure a marker there, or state {option('point')} {marker}"
    )


def _placed_markers(result: Calibration) -> str:
    """ "; TCP lies at x = 30.24 ± 0.13, … mm of the flange (95 %)": what such a fit is made for."""
    found: dict[str, list[str]] = {}
    for e in result.ordinary:
        name, _, axis = e.name.rpartition(".")
        if axis in ("x", "y", "z") and e.value is not None and e.ci95 is not None:
            value, half, unit = estimate(e.value, (e.ci95[1] - e.ci95[0]) / 2, e.unit)
            found.setdefault(name, []).append(f"{axis} = {value} ± {half} {unit}")
    told = [f"{printable(name.removeprefix('marker:'))} lies at {', '.join(axes)}"
            for name, axes in found.items() if len(axes) == 3]  # fmt: skip
    return f"; {listed(told, 3)} (95 %)" if told else ""
