"""Can this calibration be trusted?  A judgement in one sentence, and what to do next."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from scipy import stats

from elastocal.identification.advice import MANY
from elastocal.identification.result import Calibration
from elastocal.report.noise import LACK_OF_FIT
from elastocal.report.units import length, significant
from elastocal.report.verdict import FLATTERS, counted
from elastocal.report.words import ABSORBED, INVISIBLE, names_of

Tone = Literal["good", "care", "poor"]
SECTIONS = FAULTY, OPEN = ("Faulty readings", "What is not determined")  # of the page
LITTLE = 1.25  # times better than the nominal arm, below which little was gained
# Test data lie where the calibration was not made, or the arm has changed, where their errors are
# this much larger than held-out poses' and chance allows for it in one table of a hundred.
WORSE, CHANCE = 1.25, 0.01


@dataclass(frozen=True)
class Judgement:
    """`tone`: good (use it), care (use it knowing what is wrong), poor (do not use it)."""

    tone: Tone
    headline: str
    steps: tuple[str, ...]


def without_sections(step: str) -> str:
    """A step where there is no page with sections to look into."""
    for section in SECTIONS:
        step = step.replace(f" ({section})", "")
    return step


def judgement(result: Calibration) -> Judgement:
    """How good the calibration is and what follows from it."""
    if (why := _spoilt(result)) is not None:
        return Judgement("poor", f"Do not use this calibration: {why}.", _steps(result, False))
    told = _accuracy(result)
    if doubts := _doubts(result):
        text = f"Use this calibration with care: {told}, but {'; and '.join(doubts)}."
        return Judgement("care", text, _steps(result, False))
    noise = ", and the residual is noise" if result.noise.get("ratio_to_stated") else ""
    text = f"This calibration can be trusted: {told}{noise}."
    return Judgement("good", text, _steps(result, True))


def _spoilt(result: Calibration) -> str | None:
    """What makes the result worthless; None where nothing does."""
    if not result.converged:
        return f"the fit did not converge ({result.reason})"
    held, nominal = result.heldout_rms, result.nominal_rms
    if math.isfinite(held) and math.isfinite(nominal) and held >= nominal:
        return (
            f"unseen poses are predicted to {length(held)} rms, and the nominal arm does as well "
            f"({length(nominal)})"
        )
    return None


def _accuracy(result: Calibration) -> str:
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


def larger_than_noise(result: Calibration) -> float | None:
    """Residual over stated noise where chance does not explain the excess; else None."""
    ratio = result.noise.get("ratio_to_stated")
    if ratio is None or ratio <= math.sqrt(stats.chi2.ppf(0.975, result.dof) / result.dof):
        return None
    return float(ratio)


def lacks_fit(result: Calibration) -> bool:
    """Whether configurations scatter more than the repeats of one explain."""
    found = result.noise.get("lack_of_fit")
    return found is not None and float(found["p"]) < LACK_OF_FIT


def _worse_than_held_out(result: Calibration) -> float | None:
    """Rms error (m) of the test data where it is larger than that of held-out poses; else None.

    An F-test of the two mean squares; the components of a reading count as one.
    """
    test, held = result.test, result.heldout_rms
    if test is None or not math.isfinite(held):
        return None
    allowed = math.sqrt(stats.f.ppf(1 - CHANCE, test.n, result.dof))
    return test.rms if test.rms > max(WORSE, allowed) * held else None


def _doubts(result: Calibration) -> list[str]:
    doubts = []
    held = result.heldout_rms
    if not math.isfinite(held) and result.test is None:
        doubts.append(
            "how well it predicts other poses is not known: some pose alone determines a parameter"
        )
    if (ratio := larger_than_noise(result)) is not None:
        doubts.append(f"the residual is {significant(ratio)} times the stated noise")
    if lacks_fit(result):
        doubts.append("configurations scatter more than repeats of one explain")
    if math.isfinite(held) and held > FLATTERS * result.residual_rms:
        doubts.append(f"unseen poses are worse than fitted ones ({length(result.residual_rms)})")
    if result.nominal_rms < LITTLE * held < math.inf:
        doubts.append("that is hardly better than the nominal arm")
    fitted = len(result.observations.lead)
    if len(result.outliers) > MANY * fitted:
        doubts.append(
            f"{len(result.outliers)} of the {fitted} readings fitted lie beyond what the noise "
            "explains"
        )
    if (found := _worse_than_held_out(result)) is not None:
        doubts.append(f"test data are off by {length(found)} rms, more than chance explains")
    return doubts


def _steps(result: Calibration, fine: bool) -> tuple[str, ...]:
    steps = []
    if larger_than_noise(result) is not None or lacks_fit(result):
        steps.append(
            "Ask what the model lacks: elastocal diagnose with the same cell and data. Where it "
            "finds nothing, the excess is the robot's repeatability, or noise larger than stated."
        )
    elif result.noise.get("ratio_to_stated") is None:
        steps.append(
            "State the tracker's noise ([tracker] sigma_um, or range_um and transverse_um): only "
            "beside it does the residual say whether the model lacks something. elastocal diagnose "
            "looks for that either way."
        )
    held, few = result.heldout_rms, result.heldout_rms > FLATTERS * result.residual_rms
    if not math.isfinite(held) or few:
        steps.append("Measure more poses: elastocal design --augment plans what these data lack.")
    if n := len(result.faulty):
        verb = "lies" if n == 1 else "lie"
        steps.append(
            f"Look at the {counted(n, 'reading')} that {verb} beyond the noise ({FAULTY})."
        )
    hidden = len(names_of(result, INVISIBLE)) + len(names_of(result, ABSORBED))
    if hidden:
        steps.append(
            f"{counted(hidden, 'parameter')} cannot be had from these data ({OPEN}). Poses and "
            "loads like those measured are predicted all the same; for others, measure what shows "
            "them."
        )
    if _worse_than_held_out(result) is not None:
        steps.append(
            "Compare the test poses with those fitted: where they lie elsewhere (joints, load), "
            "fit some like them; where they do not, the arm or the tracker has changed in between."
        )
    if result.test is None:
        steps.append(
            "Prove it: measure some poses that take no part in the fit, and give them with --test."
        )
    if fine:
        steps.append(
            "Use it (elastocal compensate, elastocal export) where poses and loads are like those "
            "measured."
        )
    return tuple(steps)
