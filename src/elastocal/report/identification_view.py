"""What an identification says: its parameters as rows and its sentences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from elastocal.errors import option
from elastocal.identification.error_budget import ErrorBudget, pose_accuracy
from elastocal.identification.findings import (
    ABSORBED,
    ALONE,
    COMBINED,
    FIXED,
    INVISIBLE,
    WEAK,
    standings,
)
from elastocal.identification.prediction import PredictedError, measured_loads
from elastocal.identification.residuals import ResidualSummary
from elastocal.identification.result import (
    LOPSIDED,
    Calibration,
    Combination,
    Estimate,
    deviation,
)
from elastocal.identification.scrutiny import stage_of
from elastocal.model.joint_names import names_told
from elastocal.report.formatting import (
    ShownTable,
    capital,
    counted,
    display,
    estimate,
    faulty_rows,
    gap_table,
    length,
    plain,
    resolution,
    rounded_alike,
    significant,
    with_ends,
)
from elastocal.report.judgement_view import judgement, warnings_beside
from elastocal.report.method_and_noise import (
    MOST_TOLD,
    candidate_rows,
    constraints_line,
    counted_functions,
    does_noise_explain_it,
    false_alarm_line,
    fault_lines,
    group_name,
    in_time_line,
    intervals_line,
    method_and_weights,
    noise_model_line,
    prior_line,
    ratio,
    repeats_line,
    shape_line,
    size_rows,
    smooth_lines,
    smooth_table,
)
from elastocal.text import listed, printable
from elastocal.units import Array

LARGEST_TERMS = 4
Truth = dict[str, float]
Published = Mapping[str, tuple[float, float]]


def names_of(result: Calibration, standing: str) -> list[str]:
    found = standings(result)
    return [printable(e.name) for e in result.ordinary if found[e.name] == standing]


def shortened(combination: Combination, most: int = LARGEST_TERMS) -> str:
    """The first member and the largest other terms by factor, "+ n more" for the rest."""
    (first, _), *rest = combination.terms.items()
    kept = sorted(rest, key=lambda term: -abs(term[1]))[: most - 1]
    text = printable(first)
    for name, factor in [term for term in rest if term in kept]:
        size = significant(abs(factor))
        number = "" if float(size) == 1 else f"{size}·"
        member = deviation(printable(name), combination.held.get(name), 4)
        text += f" {'-' if factor < 0 else '+'} {number}{member}"
    more = len(rest) - len(kept)
    return f"{text} + {more} more" if more else text


def short_note(result: Calibration, e: Estimate) -> str:
    """Why a parameter has no number of its own, in a few words; empty where it has one."""
    standing = standings(result)[e.name]
    if standing == COMBINED:
        return f"only as {shortened(result.combination(e.name))}"
    if standing == ABSORBED:
        several = len(e.combined_with) - 3
        names = ", ".join(printable(n) for n in e.combined_with[:3])
        return f"held: absorbed in {names}" + (f" + {several} more" if several > 0 else "")
    if standing == WEAK:
        return f"hardly shown: {limits(result, e)}"
    if standing == INVISIBLE:
        return "held: not visible in these data"
    return "fixed by the user" if standing == FIXED else printable(e.note)


def limits(result: Calibration, e: Estimate) -> str:
    """What the readings say of a parameter that they hardly show, and what the model uses."""
    assert e.limits is not None
    p = result.model.parameters[result.model.names.index(e.name)]
    low, high = (significant(display(end, e.unit)[0], 2) for end in e.limits)
    held, unit = display(e.held, e.unit)
    text = f"{low} to {high} {unit}"
    if e.limits[0] <= p.lower <= e.limits[1]:
        text = f"at most {high} {unit}"
    elif e.limits[0] <= p.upper <= e.limits[1]:
        text = f"at least {low} {unit}"
    used = "nominal" if e.held == e.nominal and e.held else significant(held, 2)
    return f"{text}; {used} is used"


def held_where(result: Calibration, names: list[str]) -> str:
    """Where all of `names` are held: at nominal, or at a start value that is none."""
    chosen = [e for e in result.estimates if printable(e.name) in names]
    at_nominal = all(e.held == e.nominal and nominal_known(result, e.name) for e in chosen)
    return "held at nominal" if at_nominal else "held at the start value"


def combination_truth(result: Calibration, combination: Combination, truth: Truth) -> float | None:
    """True value X_k + Σ f·(X_d − held_d), None where a member's true value is not known."""
    (first, _), *rest = combination.terms.items()
    if any(name not in truth for name in combination.terms):
        return None
    shift = sum(f * (truth[name] - result[name].held) for name, f in rest)
    return truth[first] + shift


def inside(value: float | None, ci95: tuple[float, float] | None) -> str:
    """Whether a true value lies in the 95 % interval; empty where either is unknown."""
    if value is None or ci95 is None:
        return ""
    return "inside" if ci95[0] <= value <= ci95[1] else "outside"


def coverage(result: Calibration, truth: Truth) -> tuple[int, int]:
    """How many 95 % intervals hold the true value, of how many that could be compared."""
    found = [inside(truth.get(e.name), e.ci95) for e in result.ordinary]
    found += [inside(combination_truth(result, c, truth), c.ci95) for c in result.combinations]
    return found.count("inside"), len(found) - found.count("")


def nominal_known(result: Calibration, name: str) -> bool:
    """False for a zero that only stands for "no nominal value stated", as of a compliance."""
    parameter = result.model.parameters[result.model.names.index(name)]
    return parameter.nominal != 0 or parameter.typical is not None


def undetermined_lines(result: Calibration, most: int | None = None) -> list[str]:
    """Which parameters have no number of their own, and why, one line per reason; `most` names."""
    lines = []

    def told(names: list[str]) -> str:
        return listed(names, most or len(names))

    extra = {printable(name) for name in result.left.redundant} if result.left else set()
    weak = [
        f"{printable(e.name)} ({limits(result, e)})"
        for e in result.ordinary
        if e.limits is not None
    ]
    if weak:
        lines.append(f"hardly shown, so without a value (95 %): {told(weak)}")
    if names := [n for n in names_of(result, INVISIBLE) if n not in extra]:
        where = held_where(result, names)
        lines.append(f"{where} (not visible in these data): {told(names)}")
    if names := [n for n in names_of(result, ABSORBED) if n not in extra]:
        where = held_where(result, names)
        lines.append(f"{where}, absorbed in a combination: {told(names)}")
    if names := [n for s in (INVISIBLE, ABSORBED) for n in names_of(result, s) if n in extra]:
        where = held_where(result, names)
        lines.append(f"{where}, not identifiable with these loads (expected): {told(names)}")
    if names := names_of(result, FIXED):
        lines.append(f"fixed by the user: {told(names)}")
    return lines


MOST_CORRELATIONS = 8
READINGS = {
    "position": "position readings",
    "deflection": "deflections (loaded minus unloaded readings)",
    "pose": "pose readings",
    "distance": "distance readings",
}


def what_was_identified(result: Calibration) -> str:
    alone, n = len(names_of(result, ALONE)), len(result.combinations)
    text = f"{alone} of {counted(len(result.ordinary), 'parameter')}"
    if n:
        absorbed = len(names_of(result, ABSORBED))
        text += (
            f", and {counted(n, 'combination')} of parameters that these readings cannot separate "
            f"({absorbed} held in exchange)"
        )
    if weak := len(names_of(result, WEAK)):
        text += f"; {weak} hardly shown"
    if unseen := len(names_of(result, INVISIBLE)):
        text += f"; {unseen} not visible in these data"
    if fixed := len(names_of(result, FIXED)):
        text += f"; {fixed} fixed by the user"
    if (far := result.finding("unheard_of")) is not None:
        text += f"; {len(far.listed('parameters'))} with implausible values"
    return text + counted_functions(result) + "."


def prediction_lines(result: Calibration) -> list[tuple[str, str]]:
    """What the verdict does not say of it: what was left out, new poses, test data."""
    told: list[str] = []
    held = math.isfinite(result.heldout_rms)
    if not held:
        told.append("No held-out error: some configuration alone determines a parameter.")
    elif result.noise.drift is not None:
        told.append("Whole blocks in time were held out, with another day's drift.")
    if held and result.excluded:
        told.append(
            f"With the {counted(len(result.excluded), 'reading')} excluded as outliers, the "
            f"held-out error is {length(result.heldout_all_rms)} rms."
        )
    if result.predicted is not None:
        told.append(at_new_poses(result.predicted))
    if (t := result.test) is not None:
        told.append(
            f"Test error ({counted(t.n, 'reading')}, not fitted): {length(t.rms)} rms, "
            f"{length(t.mean)} mean, {length(t.maximum)} maximum."
        )
    return [("Prediction", " ".join(told))] if told else []


def at_new_poses(found: PredictedError) -> str:
    """Expected error at new poses and its parts."""
    low, high = found.ci95
    parts = [f"parameters {length(found.parameters)}"]
    if found.open > 0:
        parts.append(f"undetermined parameters {length(found.open)}")
    if found.lacking:
        parts.append(f"possible model error {length(found.lacking)}")
    return (
        f"{length(found.rms)} rms at new poses, 95 %: {length(low)} to {length(high)}, measurement "
        f"noise excluded ({', '.join(parts)}). New poses: {found.source}."
    )


def nominal_arm(result: Calibration) -> str:
    """The nominal arm as `nominal_rms` has it: placed by all readings."""
    return "nominal arm (base and markers placed)" if _placed(result) else "nominal arm"


def nominal_arm_held_out(result: Calibration) -> str:
    """The nominal arm as the gap budget has it: each configuration under the others' placing."""
    return "nominal arm (base and markers by other poses)" if _placed(result) else "nominal arm"


def _placed(result: Calibration) -> bool:
    return any(stage_of(p.effect) == 0 for p in result.model.parameters)


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
        fitted, held = (
            significant(v * 1e6) if math.isfinite(v) else "not available" for v in turns
        )
        text += f"; rotations {fitted} µrad fitted, {held} µrad held out"
    return text


def joint_lines(result: Calibration) -> list[tuple[str, str]]:
    """The names that the robot's file has for joint1 … jointN, where they say something else."""
    told = names_told(result.model.chain)
    return [("Joints", told)] if told else []


def readings(result: Calibration) -> str:
    observed = result.observations
    poses = observed.n_configurations
    markers = len(np.unique(observed.table.marker[observed.lead]))
    return (
        f"{len(observed.lead)} {READINGS[observed.kind]} in {counted(poses, 'configuration')}, "
        f"{counted(markers, 'marker')} ({printable(observed.table.source)})"
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
    summary = result.residual_summary
    found = [
        ("Noise model", noise_model_line(result)),
        ("Repeats", repeats_line(result)),
        ("Residuals", None if summary is None else shape_line(summary)),
        ("In time", in_time_line(result)),
    ]
    return [(label, text) for label, text in found if text is not None]


def held_lines(result: Calibration) -> list[tuple[str, str]]:
    """Label and sentence: what constraints and prior put into the estimates."""
    found = [("Constraints", constraints_line(result)), ("Prior", prior_line(result))]
    return [(label, text) for label, text in found if text is not None]


def leading_lines(result: Calibration) -> list[tuple[str, str]]:
    """Label and sentence of what comes first: verdict, errors, what to do, warnings."""
    (verdict, *steps) = judgement(result).lines
    new = [] if result.predicted is None else [("Expected", at_new_poses(result.predicted))]
    warnings = [("Warning", text) for text in warnings_beside(result)]
    return [verdict, ("Error (rms)", error_line(result)), *new, *steps, *warnings]


def summary_lines(
    result: Calibration, truth: Truth | None = None, details: bool = True
) -> list[tuple[str, str]]:
    """Label and sentence of what else there is to say; `details`: of method, noise, intervals."""
    lines = [("Readings", readings(result)), ("Identified", what_was_identified(result))]
    lines += joint_lines(result)
    if details:
        lines += [
            ("Method", method_and_weights(result)),
            ("Degrees of freedom", str(result.dof)),
            *prediction_lines(result),
        ]
    lines.append(("Noise", does_noise_explain_it(result)))
    if details:
        lines += [*noise_lines(result), ("Intervals", intervals_line(result))]
    lines += held_lines(result)
    lines += [("Smooth function", text) for text in smooth_lines(result)]
    if truth:
        lines.append(("Truth", coverage_line(result, truth)))
    if details and (pairs := correlation_lines(result)):
        lines.append(("Correlated over 0.9", "; ".join(pairs)))
    return lines + [("Faulty", text) for text in fault_lines(result, MOST_TOLD)]


# Bars have the true or nominal value in the middle and reach HALF_LENGTH to either side.
MIDDLE, HALF_LENGTH = 72.0, 70.0
TRUTH_REACH = 2.5  # half widths from the true value to a bar's end
ROUNDING = 1e-9  # sides of an interval this short beside the value are alike


@dataclass(frozen=True)
class Bar:
    """Where interval and estimate lie on a bar."""

    low: float
    high: float
    value: float


@dataclass(frozen=True)
class ParameterRow:
    """A parameter or a combination as text; "–" where there is no number."""

    name: str
    determined: bool
    value: str
    half: str
    unit: str
    truth: str
    verdict: str
    nominal: str = ""
    note: str = ""
    whole: str = ""
    bar: Bar | None = None
    effect: str = ""
    published: str = ""

    @property
    def interval(self) -> str:
        """The half width with its sign, or both ends."""
        return signed_half(self.half)


def parameter_rows(
    result: Calibration, truth: Truth | None, published: Published | None = None
) -> list[ParameterRow]:
    """One row per parameter, all of them but those of smooth functions, in the model's order.

    `published`: values and half widths (SI) that others found, by name.
    """
    rows = []
    effects = {p.name: p.effect.replace("_", " ") for p in result.model.parameters}
    for e in result.ordinary:
        true = None if truth is None else truth.get(e.name)
        nominal = e.nominal if nominal_known(result, e.name) else None
        rows.append(
            ParameterRow(
                printable(e.name), e.identifiable, *texts(e, true), inside(true, e.ci95),
                nominal="–" if nominal is None else plain(display(nominal, e.unit)[0]),
                note=short_note(result, e), bar=_bar(e, true, nominal, truth is not None),
                effect=effects[e.name], published=_published((published or {}).get(e.name), e.unit),
            )
        )  # fmt: skip
    return rows


def _published(found: tuple[float, float] | None, unit: str) -> str:
    """ "0.287 ± 0.003", in the unit of the row."""
    return "–" if found is None else " ± ".join(estimate(*found, unit)[:2])


def combination_rows(result: Calibration, truth: Truth | None) -> list[ParameterRow]:
    """One row per sum of parameters that the data determine although its members they do not."""
    rows = []
    for c in result.combinations:
        true = None if truth is None else combination_truth(result, c, truth)
        short, whole = shortened(c), shortened(c, len(c.terms))
        rows.append(
            ParameterRow(
                short, True, *texts(c, true), inside(true, c.ci95),
                whole=whole if whole != short else "", bar=_bar(c, true, None, truth is not None),
            )
        )  # fmt: skip
    return rows


def budget_steps(
    result: Calibration, budget: ErrorBudget
) -> list[tuple[str, float, tuple[float, float]]]:
    """Name, held-out rms (m) and its 95 % interval of every step."""
    named = {"nominal_arm": nominal_arm_held_out(result)}
    return [(named.get(s.step, s.step), s.heldout_rms, s.ci95) for s in budget.steps]


def budget_table(result: Calibration, budget: ErrorBudget) -> ShownTable:
    """The steps with their intervals and what each changes; noise alone last."""
    floor = None if budget.floor is None else (budget.floor_name, budget.floor)
    return gap_table(budget_steps(result, budget), floor)


def before_and_after(
    result: Calibration, budget: ErrorBudget | None, by_place: bool = False
) -> dict[str, Array]:
    """Length (n,) in m of the errors by name: of the nominal arm and of the calibrated one in poses
    that were not fitted, and on test data; `by_place` of the mean of what was read at one place."""
    found = {}
    if budget is not None and len(budget.steps) > 1:
        ends = {nominal_arm_held_out(result): budget.steps[0], "calibrated": budget.steps[-1]}
        for name, step in ends.items():
            found[name] = np.linalg.norm(step.errors, axis=1)
            if by_place:
                found[name] = pose_accuracy(result.observations, step.errors)
    if result.test is not None and len(result.test.errors) and not by_place:
        found["calibrated, test data"] = result.test.errors
    return found


def spread_table(found: dict[str, Array], count: str = "readings") -> ShownTable:
    """Mean, standard deviation, 95 % quantile and maximum of lengths (n,) in m, by name."""
    rows = []
    for name, e in found.items():
        sizes = (e.mean(), e.std(), np.quantile(e, 0.95), e.max())
        rows.append((name, str(len(e)), *(length(float(size)) for size in sizes)))
    return ShownTable(("error of the position", count, "mean", "std", "95 %", "max"), rows)


def _newtons(force: Array) -> str:
    return f"({', '.join(f'{v:g}' for v in force)}) N"


def _each(value: Any) -> Array:
    """A number, the numbers of three axes, or the one that all have."""
    values: Array = np.atleast_1d(value)
    return values if np.ptp(values) else values[:1]


def certificate_contents(result: Calibration, budget: ErrorBudget | None) -> dict[str, Any]:
    """Words and tables of the calibration certificate."""
    stated = result.model.cell.tracker.noise
    noise = "none stated" if result.observations.table.sigma is None else "stated with each reading"
    if stated is not None:
        noise = ", ".join(
            f"{name.replace('_', ' ')} {', '.join(length(float(v)) for v in _each(value))}"
            + (" per m" if name.endswith("per_m") else "")
            for name, value in vars(stated).items()
        )
    facts = [
        ("Robot", printable(result.model.chain.name)),
        *joint_lines(result),
        ("Instrument, standard deviations", noise),
        ("Readings", readings(result)),
        ("Loads", "; ".join(_newtons(f) for f in measured_loads(result.observations))),
        ("Identified", what_was_identified(result)),
        ("Method", _sentence(method_and_weights(result))),
    ]
    if result.predicted is not None:
        facts.append(("Expected error", at_new_poses(result.predicted)))
    if result.test is not None:
        t = result.test
        told = f"{length(t.mean)} mean, {length(t.maximum)} at most of {counted(t.n, 'reading')}"
        facts.append(("Test data", told))
    return {
        "judgement": judgement(result),
        "facts": facts,
        "accuracy": spread_table(before_and_after(result, budget, by_place=True), "places"),
    }


def texts(e: Estimate | Combination, true: float | None) -> tuple[str, str, str, str]:
    """Value, half width or both ends, unit and true value; "–" for what is not determined."""
    if e.value is None or e.ci95 is None:
        known = "–" if true is None else plain(display(true, e.unit)[0])
        return "–", "–", display(0.0, e.unit)[1], known
    if is_lopsided(e.value, e.ci95):
        shown, low, high = (display(number, e.unit)[0] for number in (e.value, *e.ci95))
        value, half = with_ends(shown, low, high)
        width, unit = resolution(shown, low, high), display(e.value, e.unit)[1]
    else:
        width = (e.ci95[1] - e.ci95[0]) / 2
        value, half, unit = estimate(e.value, width, e.unit)
        width = display(width, e.unit)[0]
    known = "–" if true is None else rounded_alike(display(true, e.unit)[0], width)
    return value, half, unit, known


def is_lopsided(value: float, ci95: tuple[float, float]) -> bool:
    """Whether the interval needs both ends to be told: not symmetric, or without an end."""
    below, above = _sides(value, ci95)
    if not (math.isfinite(below) and math.isfinite(above)):
        return True
    return abs(above - below) > max(LOPSIDED * max(above, below), ROUNDING * abs(value))


def any_lopsided(found: Iterable[Estimate | Combination]) -> bool:
    return any(
        e.value is not None and e.ci95 is not None and is_lopsided(e.value, e.ci95) for e in found
    )


def half_head(lopsided: bool) -> str:
    """Head of the column of intervals, which only says "±" where all are symmetric."""
    return "95 %" if lopsided else "± 95 %"


def signed_half(half: str) -> str:
    """ "± 0.013", but the ends of a lopsided interval as they are."""
    return half if half.startswith(("[", "–")) else f"± {half}"


def bar_from_truth(value: float, ci95: tuple[float, float], true: float) -> Bar | None:
    """The interval beside the true value; one scale for all bars, in half widths.

    An interval without one end is scaled by its other side and reaches the end of the bar.
    """
    half = (ci95[1] - ci95[0]) / 2
    if not math.isfinite(half):
        half = max((side for side in _sides(value, ci95) if math.isfinite(side)), default=0.0)
    return _bar_on(value, ci95, true, TRUTH_REACH * half)


def bar_from_nominal(value: float, ci95: tuple[float, float], nominal: float) -> Bar | None:
    """The interval beside the nominal value, on a scale of its own."""
    far = [abs(x - nominal) for x in (value, *ci95) if math.isfinite(x)]
    return _bar_on(value, ci95, nominal, 1.05 * max(far))


def _sides(value: float, ci95: tuple[float, float]) -> tuple[float, float]:
    return value - ci95[0], ci95[1] - value


def _bar_on(value: float, ci95: tuple[float, float], middle: float, reach: float) -> Bar | None:
    """The bar that shows `reach` to either side of the `middle`; None where nothing has an end."""
    if not reach > 0 or not any(math.isfinite(end) for end in ci95):
        return None

    def place(x: float) -> float:
        offset = (x - middle) / reach * HALF_LENGTH
        return round(MIDDLE + min(max(offset, -HALF_LENGTH), HALF_LENGTH), 1)

    return Bar(place(ci95[0]), place(ci95[1]), place(value))


def _bar(
    e: Estimate | Combination, true: float | None, nominal: float | None, compared: bool
) -> Bar | None:
    if e.value is None or e.ci95 is None:
        return None
    if compared:
        return None if true is None else bar_from_truth(e.value, e.ci95, true)
    return None if nominal is None else bar_from_nominal(e.value, e.ci95, nominal)


# A second look: who decides the fit, what else would do, what its errors are of.

MOST_INFLUENTIAL = 12


def influence_table(result: Calibration) -> ShownTable:
    """The configurations that decide most, by Cook's distance; those without others to judge them
    first."""
    found = sorted(result.influence(), key=lambda c: (-c.cook, -c.leverage))[:MOST_INFLUENTIAL]
    rows = [
        (
            printable(c.configuration), str(c.readings), significant(c.leverage, 2),
            significant(c.cook, 2) if math.isfinite(c.cook) else "∞", printable(c.moved),
            significant(c.by, 2) if math.isfinite(c.by) else "undetermined",
        )
        for c in found
    ]  # fmt: skip
    heads = (
        "configuration", "readings", "leverage (parameters)", "Cook's distance", "moves most",
        "by (std)",
    )  # fmt: skip
    return ShownTable(heads, rows, (0, 4))


def sets_table(result: Calibration) -> ShownTable:
    """Sets of parameters side by side."""
    rows = []
    for s in result.parameter_sets():
        over, ends = "", ""
        if s.heldout_over_chosen and math.isfinite(s.heldout_over_chosen):
            over = _signed(s.heldout_over_chosen)
            ends = f"{_signed(s.ci95[0])} to {_signed(s.ci95[1])}"
        rows.append((
            s.name, str(s.parameters), length(s.residual_rms),
            length(s.heldout_rms) if math.isfinite(s.heldout_rms) else "undetermined", over, ends,
            f"{s.log_likelihood:+.1f}" if s.log_likelihood else "0",
        ))  # fmt: skip
    heads = (
        "set", "parameters", "fitted rms", "held-out rms", "over the chosen", "95 %",
        "log-likelihood over the chosen",
    )  # fmt: skip
    return ShownTable(heads, rows)


def _signed(metres: float) -> str:
    return f"{'-' if metres < 0 else '+'}{length(abs(metres))}"


SOURCES = {
    "parameters": "parameters: uncertainty of the estimates",
    "open_parameters": "undetermined parameters: typical deviations",
    "repeatability": "repeatability: common to the readings of a visit",
    "instrument": "instrument: single readings",
    "lack_of_fit": "lack of fit: further scatter of configurations",
    "total": "total",
}


def uncertainty_table(result: Calibration) -> ShownTable:
    """What the error of a predicted reading is made of."""
    budget = result.uncertainty()
    if budget is None:
        return ShownTable((), [])
    total = budget.total
    rows = [
        (words, length(part), f"{100 * (part / total) ** 2 if total else 0:.0f} %")
        for name, words in SOURCES.items()
        for part in (getattr(budget, name),)
    ]
    return ShownTable(("source", "3-D rms", "share of the square"), rows)


# What the page shows, by the names that its template has for it.

MOST_CORRELATIONS_LISTED = 30


def identification_contents(
    result: Calibration,
    summary: ResidualSummary | None,
    budget: ErrorBudget | None,
    truth: Truth | None,
    published: Published | None,
) -> dict[str, Any]:
    """Words and tables of the page."""
    sentences = [text for label, text in noise_lines(result) if label != "Residuals"]
    verdict = [
        ("Identified", what_was_identified(result)),
        *joint_lines(result),
        *prediction_lines(result),
        ("Noise", does_noise_explain_it(result)),
        *held_lines(result),
        *([("Truth", coverage_line(result, truth))] if truth else []),
    ]
    found: list[Estimate | Combination] = [*result.ordinary, *result.combinations]
    endless = any(math.isinf(end) for e in found for end in e.ci95 or ())
    deviating = () if summary is None else summary.deviating
    scatter = None if summary is None else summary.whole.held_out_mean_square
    return {
        "judgement": judgement(result, sections=True),
        "compared": truth is not None,
        "published": bool(published),
        "lopsided": any_lopsided(found),
        "verdict": verdict,
        "readings": readings(result),
        "method": _sentence(method_and_weights(result)),
        "intervals": _sentence(f"intervals are {intervals_line(result)}"),
        "dof": result.dof,
        "noise_sentences": sentences,
        "shape": None if summary is None else shape_line(summary),
        "sizes": size_rows(result.noise),
        "candidates": candidate_rows(result.noise),
        "influence": influence_table(result),
        "sets": sets_table(result),
        "uncertainty": uncertainty_table(result),
        "deviating": [(group_name(by, g), g.n, ratio(g), f"{g.p_holm:.1g}") for by, g in deviating],
        "held_out_scatter": "" if scatter is None else (
            f"In held-out configurations the scatter is {significant(scatter**0.5)} times that of "
            "the noise model."
        ),
        "error_line": _sentence(error_line(result)),
        "warnings": warnings_beside(result),
        "budget": None if budget is None else budget_table(result, budget),
        "spread": spread_table(before_and_after(result, budget)),
        "floor": "The noise level is unknown."
        if budget is None or budget.floor is None
        else f"The dashed line is the noise level ({budget.floor_name}).",
        "parameters": parameter_rows(result, truth, published),
        "combinations": combination_rows(result, truth),
        "endless": " An interval without an end runs to the edge." if endless else "",
        "smooth": smooth_table(result),
        "undetermined": [_sentence(line) for line in undetermined_lines(result)],
        "correlations": correlation_lines(result, MOST_CORRELATIONS_LISTED),
        "faults": fault_lines(result),
        "false_alarm": false_alarm_line(result),
        "outliers": faulty_rows([(o, o.residual, o.ratio) for o in result.outliers]),
        "excluded": faulty_rows([(o, o.residual, o.ratio) for o in result.excluded]),
        "drop": option("outliers", "drop"),
    }  # fmt: skip


def _sentence(text: str) -> str:
    return f"{capital(text)}."
