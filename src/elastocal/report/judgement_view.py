"""The judgement of an identification in words: the verdict, what speaks against it, what to do."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from elastocal.errors import option
from elastocal.identification.far_values import only_placed
from elastocal.identification.result import Calibration, Finding
from elastocal.identification.sentences import next_steps
from elastocal.report.blocks import Tone
from elastocal.report.formatting import counted, display, estimate, length, significant
from elastocal.text import listed, printable


@dataclass(frozen=True)
class Judgement:
    tone: Tone
    headline: str
    steps: tuple[str, ...]


def judgement(result: Calibration) -> Judgement:
    """How good the calibration is and what follows from it, as the result's findings say."""
    steps = tuple(f.remedy for f in next_steps(result))
    trust = result.finding("trust")
    assert trust is not None, "every identification is judged"
    if trust.severity == "poor":
        why = next(f for f in result.findings if f.severity == "poor" and f is not trust)
        return Judgement("poor", f"Do not use this calibration: {DOUBTS[why.kind](why)}.", steps)
    told = _accuracy(result)
    verdict = result.verdict
    if trust.severity == "care":
        named = "; and ".join(DOUBTS[f.kind](f) for f in verdict.missing)
        return Judgement("warn", f"Use this calibration with care: {named}. {told}", steps)
    compared = result.finding(
        "residual_agrees_with_stated_noise", "residual_below_stated_noise",
        "residual_agrees_with_readings",
    )  # fmt: skip
    noise = "" if compared is None else " The residual is consistent with noise."
    return Judgement("good", f"This calibration can be used. {told}{noise}", steps)


def warnings_beside(result: Calibration) -> list[str]:
    """The warnings that say more than the verdict, what to do next and the line on noise."""
    told = {"residual_above_stated_noise", "scatter_not_counted"}
    said = {f.kind for f in result.verdict.missing} & told
    return [printable(str(w)) for w in result.warnings if getattr(w, "kind", "") not in said]


def _length(f: Finding, name: str) -> str:
    return length(f.number(name) * 1e-6)


# What speaks against a calibration, in words.
DOUBTS: dict[str, Callable[[Finding], str]] = {
    "not_converged": lambda f: f"the fit did not converge ({f.numbers['reason']})",
    "no_better_than_nominal": lambda f: (
        f"the held-out error ({_length(f, 'heldout_rms_um')} rms) is not below that of the nominal "
        f"arm ({_length(f, 'nominal_rms_um')})"
    ),
    "not_held_out": lambda f: (
        "there is no held-out error: some pose alone determines a parameter, and nothing checks it"
        + (
            f" ({_length(f, 'unchecked_um')} of the {_length(f, 'rms_um')} expected at new poses)"
            if f.numbers
            else ""
        )
    ),
    "residual_above_stated_noise": lambda f: (
        f"the residual is {significant(f.number('ratio'))} times the stated noise"
    ),
    "residual_below_stated_noise": lambda f: (
        f"the stated noise is too large (the residual is {significant(f.number('ratio'))} times "
        "it), so a missing effect would not show"
    ),
    "residuals_heavy_tailed": lambda f: (
        "large errors are more frequent than in normal noise (excess kurtosis "
        f"{f.number('excess_kurtosis'):+.2g})"
    ),
    "autocorrelated": lambda f: "residuals of successive visits are correlated, as under a drift",
    "load_unit": lambda f: (
        f"the compliances are {significant(f.number('ratio'), 2)} times those expected from "
        f"{f.numbers['by']}: the loads may be in another unit"
    ),
    "scatter_not_counted": lambda f: (
        "residuals scatter between visits, or drift, beyond the noise model"
    ),
    "lack_of_fit": lambda f: "configurations scatter more than their repeats",
    "fit_flatters": lambda f: (
        f"the held-out error is larger than the fitted one ({_length(f, 'residual_rms_um')})"
    ),
    "scale": lambda f: (
        f"all measured lengths are {significant(f.number('readings_over_file'), 4)} times those of "
        "the robot's file: a scale error, as of a target or unit of another size"
    ),
    "unheard_of": lambda f: _unheard_of(f),
    "little_gain": lambda f: "the error is hardly smaller than that of the nominal arm",
    "few_configurations": lambda f: (
        f"{counted(int(str(f.numbers['configurations'])), 'configuration')} give only "
        f"{f.numbers['equations_left']} equations beyond {f.numbers['parameters']} parameters "
        f"(needed: {f.numbers['needed']})"
    ),
    "noise_unknown": lambda f: (
        "the noise level is unknown (neither stated nor repeated), so the residual may hide a "
        "missing effect"
    ),
    "new_poses_not_shown": lambda f: (
        f"{_length(f, 'open_um')} of the error at new poses come from parameters that the measured "
        f"poses do not show ({listed([printable(str(n)) for n in f.listed('parameters')], 3)})"
    ),
    "new_poses_no_gain": lambda f: (
        f"the error expected at new poses ({_length(f, 'rms_um')}) is "
        + ("hardly smaller" if f.number("rms_um") <= f.number("nominal_rms_um") else "larger")
        + f" than that of the nominal arm at measured poses ({_length(f, 'nominal_rms_um')})"
    ),
    "many_faulty_readings": lambda f: (
        f"{f.numbers['faulty']} of the {f.numbers['fitted']} fitted readings are outliers"
    ),
    "drift": lambda f: (
        f"base or tracker drift by {_length(f, 'sigma_um')} during the measurement session"
    ),
    "test_data_worse": lambda f: (
        f"the test error ({_length(f, 'test_rms_um')} rms) is larger than chance explains"
    ),
    "test_data_far": lambda f: (
        f"{f.numbers['far']} of {f.numbers['configurations']} test poses are more uncertain than "
        f"every measured pose ({_length(f, 'predicted_std_um')} rms over all test poses, at most "
        f"{_length(f, 'fitted_std_um')} at measured ones)"
    ),
}


def _unheard_of(f: Finding) -> str:
    """ "implausible values (link6.dx 32.1 mm, 32 typical sizes): …" """
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
        f"implausible values ({listed(shown, 3)}): most likely an effect is missing, or these "
        "poses hardly determine them"
    )


def _accuracy(result: Calibration) -> str:
    """The arm's own error where nobody measured, and that of readings, which has their noise;
    that the load point is known worse than the markers."""
    kind = result.observations.kind
    of = f" of {kind}s" if kind in ("deflection", "distance") else ""
    own = "Expected error at new poses: not known."
    if (at := result.verdict.at) is not None:
        own = f"Expected error at new poses: ≤ {length(at)} rms (95 %), measurement noise excluded."
    text = f"{own} Held-out error{of}: {length(result.heldout_rms)} rms"
    if not math.isfinite(result.heldout_rms):
        text = f"{own} Residual{of}: {length(result.residual_rms)} rms; no held-out error"
    elif only_placed(result):
        text += _placed_markers(result)
    else:
        text += f" (nominal arm {length(result.nominal_rms)})"
    if result.load_point_error is None:
        return f"{text}."
    marker = printable(next(iter(result.model.cell.tool.markers)))
    return (
        f"{text}. The load point, default of compensate, is known only to "
        f"{length(result.load_point_error)} rms: measure a marker there, or state "
        f"{option('point')} {marker}."
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
