"""The result in sentences: what was identified, how well it predicts, and all in a few lines."""

from __future__ import annotations

import math

import numpy as np

from elastocal.identification.result import Calibration
from elastocal.report.faults import MOST_TOLD, fault_lines
from elastocal.report.method import (
    constraints_line,
    intervals_line,
    method_and_weights,
    prior_line,
)
from elastocal.report.noise import (
    does_noise_explain_it,
    noise_model_line,
    repeats_line,
    shape_line,
)
from elastocal.report.units import length, significant
from elastocal.report.words import (
    ABSORBED,
    ALONE,
    FIXED,
    INVISIBLE,
    Truth,
    coverage,
    names_of,
    printable,
)

MOST_CORRELATIONS = 8
# Held-out errors this much above the fitted ones mean that the fit flatters itself.
FLATTERS = 1.2
READINGS = {
    "position": "position readings",
    "deflection": "deflections (loaded minus unloaded readings)",
    "pose": "pose readings",
    "distance": "distance readings",
}


def counted(n: int, one: str, many: str | None = None) -> str:
    """ "1 pose", "2 poses"."""
    return f"{n} {one if n == 1 else many or one + 's'}"


def what_was_identified(result: Calibration) -> str:
    alone, n = len(names_of(result, ALONE)), len(result.combinations)
    text = f"{alone} of {counted(len(result.estimates), 'parameter')} known on their own"
    if n:
        absorbed = len(names_of(result, ABSORBED))
        text += (
            f", and {counted(n, 'combination')} of parameters that no reading tells apart "
            f"({absorbed} held in exchange)"
        )
    if unseen := len(names_of(result, INVISIBLE)):
        text += f"; {unseen} not visible in these data"
    if fixed := len(names_of(result, FIXED)):
        text += f"; {fixed} fixed by the user"
    return text + "."


def how_well_it_predicts(result: Calibration) -> str:
    """Held-out error beside the nominal one, and the error on test data."""
    what = {"deflection": "deflection", "distance": "distance"}.get(
        result.observations.kind, "position"
    )
    nominal, held = result.nominal_rms, result.heldout_rms
    if math.isfinite(held):
        text = f"In poses that were not fitted the {what} is predicted to {length(held)} rms"
        if held > 0 and nominal > held:
            text += (
                f"; the {nominal_arm(result)} is off by {length(nominal)}, "
                f"{significant(nominal / held, 2)} times as much"
            )
        elif math.isfinite(nominal):
            text += f", no better than the nominal arm ({length(nominal)})"
        text += "."
        if held > FLATTERS * result.residual_rms:
            text += (
                f" The fitted poses look better ({length(result.residual_rms)}) than unseen ones: "
                "more poses would help."
            )
    else:
        text = (
            "How well unseen poses are predicted is not known: some configuration alone "
            "determines a parameter, so none can be held out."
        )
    if result.test is not None:
        t = result.test
        text += (
            f" On {counted(t.n, 'test reading')} never fitted: {length(t.rms)} rms, "
            f"{length(t.mean)} mean, {length(t.maximum)} at most."
        )
    return text


def nominal_arm(result: Calibration) -> str:
    placed = any(p.effect in ("base_frame", "marker_position") for p in result.model.parameters)
    return "nominal arm (base and markers placed)" if placed else "nominal arm"


def rms_by_kind(result: Calibration) -> list[tuple[str, float]]:
    """What the errors are with the nominal arm, fitted, held out and on test data (3-D rms, m)."""
    rows = [
        (nominal_arm(result), result.nominal_rms),
        ("fitted poses", result.residual_rms),
        ("held-out poses", result.heldout_rms),
    ]
    return rows if result.test is None else [*rows, ("test data", result.test.rms)]


def rotation_rms(result: Calibration) -> tuple[float, float] | None:
    """Fitted and held-out rms length of the rotation error in rad; None where none was read."""
    if result.observations.kind != "pose":
        return None
    parts = [r.reshape(-1, 6)[:, 3:] for r in (result.residual, result.held_out)]
    fitted, held = (float(np.sqrt((p**2).sum(axis=1).mean())) for p in parts)
    return fitted, held


def error_line(result: Calibration) -> str:
    """All rms errors in one line."""
    text = ", ".join(f"{name} {length(value)}" for name, value in rms_by_kind(result))
    if (turns := rotation_rms(result)) is not None:
        fitted, held = (significant(v * 1e6) if math.isfinite(v) else "none" for v in turns)
        text += f"; rotations {fitted} µrad fitted, {held} µrad held out"
    return text


def readings(result: Calibration) -> str:
    seen = result.observations
    poses = len(np.unique(seen.configuration))
    markers = len(np.unique(seen.table.marker[seen.lead]))
    return (
        f"{len(seen.lead)} {READINGS[seen.kind]} in {counted(poses, 'configuration')}, "
        f"{counted(markers, 'marker')} ({printable(seen.table.source)})"
    )


def correlation_lines(result: Calibration, most: int = MOST_CORRELATIONS) -> list[str]:
    lines = []
    for a, b, r in result.correlations[:most]:
        number = f"{r:+.3f}" if abs(r) < 0.9995 else f"{r:+.6f}"
        lines.append(f"{printable(a)} and {printable(b)}: {number}")
    more = len(result.correlations) - len(lines)
    return [*lines, f"and {more} more"] if more else lines


def coverage_line(result: Calibration, truth: Truth) -> str:
    hit, n = coverage(result, truth)
    return f"{hit} of {n} intervals at 95 % hold the true value (expected: {0.95 * n:.1f})."


def noise_lines(result: Calibration) -> list[tuple[str, str]]:
    """Label and sentence: estimated noise model, repeats, shape of the residuals."""
    summary = getattr(result, "residual_summary", None)
    found = [
        ("Noise model", noise_model_line(result)),
        ("Repeats", repeats_line(result)),
        ("Residuals", None if summary is None else shape_line(summary)),
    ]
    return [(label, text) for label, text in found if text is not None]


def held_lines(result: Calibration) -> list[tuple[str, str]]:
    """Label and sentence: what constraints and prior put into the estimates."""
    found = [("Constraints", constraints_line(result)), ("Prior", prior_line(result))]
    return [(label, text) for label, text in found if text is not None]


def summary_lines(result: Calibration, truth: Truth | None = None) -> list[str]:
    """The result in words, one statement per line, warnings last."""
    lines = [
        f"Readings: {readings(result)}",
        f"Method: {method_and_weights(result)}",
        f"Error (rms): {error_line(result)}",
        f"Degrees of freedom: {result.dof}",
        f"Identified: {what_was_identified(result)}",
        f"Prediction: {how_well_it_predicts(result)}",
        f"Noise: {does_noise_explain_it(result)}",
    ]
    lines += [f"{label}: {text}" for label, text in noise_lines(result)]
    lines.append(f"Intervals: {intervals_line(result)}")
    lines += [f"{label}: {text}" for label, text in held_lines(result)]
    if truth:
        lines.append(f"Truth: {coverage_line(result, truth)}")
    if pairs := correlation_lines(result):
        lines.append("Correlated over 0.9: " + "; ".join(pairs))
    lines += [f"Faulty: {text}" for text in fault_lines(result, MOST_TOLD)]
    return lines + [f"Warning: {printable(w)}" for w in result.warnings]
