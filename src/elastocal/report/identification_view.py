"""What an identification says, as blocks: verdict, errors, parameters; behind them the rest."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cache

import numpy as np

from elastocal.errors import option
from elastocal.identification.error_budget import ErrorBudget, gap_budget
from elastocal.identification.findings import ABSORBED, ALONE, FIXED, INVISIBLE, WEAK
from elastocal.identification.prediction import PredictedError
from elastocal.identification.result import Calibration
from elastocal.identification.scrutiny import stage_of
from elastocal.model.chain import names_told
from elastocal.report import judgement_view as words
from elastocal.report.blocks import (
    WARNING,
    Block,
    Fold,
    KeyFigures,
    Lines,
    Report,
    Sentence,
    ShownTable,
    ShownVerdict,
)
from elastocal.report.formatting import (
    budget_table,
    counted,
    length,
    outlier_blocks,
    sentence,
    signed_change,
    significant,
    title_of,
)
from elastocal.report.judgement_view import judgement, warnings_beside
from elastocal.report.parameter_tables import (
    Published,
    Truth,
    combination_table,
    coverage,
    names_of,
    parameter_table,
    shortened,
    undetermined_lines,
    undetermined_table,
)
from elastocal.text import printable
from elastocal.units import Array

FEW = 6  # rows that stand open
MOST_GROUPS = 3
MOST_CORRELATIONS = 30
MOST_INFLUENTIAL = 12
NOMINAL = "nominal arm"  # its `nominal_rms`: with base and markers placed by all readings
READINGS = {
    "position": "position readings",
    "deflection": "deflections (loaded minus unloaded readings)",
    "pose": "pose readings",
    "distance": "distance readings",
}


def calibration_report(
    result: Calibration, truth: Truth | None = None, published: Published | None = None
) -> Report:
    """An identification; `truth` and `published` (SI) stand beside the estimates."""
    found = _blocks(result, truth, published)
    title = title_of(result.model.chain.name, result.model.cell.name)
    return Report("Identification", title, found, result.model.backend_report())


def _blocks(
    result: Calibration, truth: Truth | None, published: Published | None
) -> Iterator[Block]:
    budget = cache(lambda: gap_budget(result))
    yield Fold("", lambda: [_key(result, budget())])
    verdict = judgement(result)
    yield ShownVerdict(verdict.tone, verdict.headline)
    new = [] if result.predicted is None else [("Expected", at_new_poses(result.predicted))]
    yield Lines([
        ("Error (rms)", error_line(result)), *new,
        *(("Next", step) for step in verdict.steps),
        *((WARNING, text) for text in warnings_beside(result)),
    ])  # fmt: skip
    yield Fold("", lambda: _error_figures(result, budget()), figures=("waterfall", "sureness"))
    yield parameter_table(result, truth, published)
    if result.combinations:
        told = "Combinations that are determined although their members are not"
        yield _open_if_few(combination_table(result, truth), told)
        whole = [(shortened(c, len(c.terms)), shortened(c)) for c in result.combinations]
        longer = [Sentence(every) for every, some in whole if every != some]
        yield Fold("Combinations with all their members", lambda: longer)
    for line in undetermined_lines(result, FEW):
        yield Sentence(sentence(line), soft=True)
    constraints, prior = words.constraints_line(result), words.prior_line(result)
    hit, n = coverage(result, truth) if truth else (0, 0)
    held = f"{hit} of {n} intervals at 95 % hold the true value (expected: {0.95 * n:.1f})."
    yield Lines([
        ("Readings", readings(result)),
        ("Identified", what_was_identified(result)),
        *joint_lines(result),
        ("Noise", words.does_noise_explain_it(result)),
        *([("Constraints", constraints)] if constraints else []),
        *([("Prior", prior)] if prior else []),
        *([("Truth", held)] if truth else []),
        *(("Outliers", text) for text in words.fault_lines(result, MOST_GROUPS)),
    ])  # fmt: skip
    yield Fold("", lambda: _residual_figures(result), figures=("residuals", "against_joints"))
    yield _open_if_few(words.smooth_table(result), "Smooth functions")
    yield from _folds(result, truth, budget)


def _open_if_few(table: ShownTable, summary: str) -> Block:
    if len(table.rows) <= FEW:
        return table
    return Fold(f"{summary} ({len(table.rows)})", lambda: [table], printed=True)


def _folds(
    result: Calibration, truth: Truth | None, budget: Callable[[], ErrorBudget | None]
) -> Iterator[Block]:
    """What stands behind the answer."""
    yield Fold("Method, noise and intervals", lambda: _method(result), printed=True)
    missing = undetermined_table(result, truth)
    if missing.rows:
        why = f"Every parameter without a value, and why ({len(missing.rows)})"
        remedy = Sentence(
            "To see an invisible parameter, measure poses and loads that move the markers through "
            "it. To separate a combination, add markers, loads or poses in which its members "
            "differ.",
            soft=True,
        )
        yield Fold(why, lambda: [missing, remedy], printed=True)
    if result.correlations:
        yield Fold("Correlations over 0.9", lambda: [_correlation_table(result)], printed=True)
    yield Fold("Errors in numbers", lambda: _errors(result, budget()))
    yield Fold(
        "Residuals on the arm, over time and by group",
        lambda: _residuals(result),
        figures=("space", "over_time"),
    )
    single = len(result.outliers) + len(result.excluded)
    if single or words.fault_lines(result):
        yield Fold(f"Outliers ({single})", lambda: _outliers(result))
    yield Fold("Which configurations decide the fit", lambda: [_influence_table(result)])
    yield Fold("Sets of parameters side by side", lambda: [_sets_table(result)])


def _key(result: Calibration, budget: ErrorBudget | None) -> KeyFigures:
    """The error before and after, and the noise that is in both."""
    floor = None if budget is None else budget.floor
    held = math.isfinite(result.heldout_rms)
    after = result.heldout_rms if held else result.residual_rms
    headline = f"{length(result.nominal_rms)} → {length(after)}"
    headline += "" if floor is None else f" (noise {length(floor)})"
    figures = [(NOMINAL, length(result.nominal_rms))]
    figures.append(("held-out poses" if held else "fitted poses, not held out", length(after)))
    if result.test is not None:
        figures.append(("test data", length(result.test.rms)))
    if (at := result.verdict.at) is not None:
        figures.append(("new poses, without noise", f"≤ {length(at)}"))
    if floor is not None and budget is not None:
        figures.append((f"noise ({budget.floor_name})", length(floor)))
    return KeyFigures(headline, figures)


def _error_figures(result: Calibration, budget: ErrorBudget | None) -> Iterator[Block]:
    from elastocal.report.figures import uncertainty_map, waterfall

    if budget is not None:
        yield waterfall("waterfall", *budget_steps(result, budget))
    if (found := uncertainty_map(result)) is not None:
        yield found


def _residual_figures(result: Calibration) -> Iterator[Block]:
    from elastocal.report.figures import over_configurations, over_joints, residuals_by

    residuals = residuals_by(result.observations, result.residual)
    yield over_configurations(residuals)
    yield over_joints(result.model.chain.kinds, residuals)


def _residuals(result: Calibration) -> Iterator[Block]:
    from elastocal.report.arm_view import residual_arm
    from elastocal.report.figures import over_time, residual_table, residuals_by

    residuals = residuals_by(result.observations, result.residual)
    yield residual_arm(result.model, result.observations, result.x, result.residual)
    yield over_time(result.observations, residuals)
    yield residual_table(result.observations, residuals)


def _method(result: Calibration) -> Iterator[Block]:
    yield Lines([
        ("Method", sentence(words.method_and_weights(result))),
        ("Degrees of freedom", f"{result.dof}."),
        *prediction_lines(result),
        *words.noise_lines(result),
        ("Intervals", sentence(words.intervals_line(result))),
    ])  # fmt: skip
    for table in (words.size_table(result.noise), words.candidate_table(result.noise)):
        if len(table.rows) > 1:
            yield table
    if result.residual_summary is not None:
        yield words.deviating_table(result.residual_summary)


def _errors(result: Calibration, budget: ErrorBudget | None) -> Iterator[Block]:
    if budget is not None:
        yield budget_table(*budget_steps(result, budget))
    yield spread_table(before_and_after(result, budget), "readings")


def _outliers(result: Calibration) -> Iterator[Block]:
    if groups := words.fault_lines(result):
        yield Lines([("Groups", text) for text in groups])
        yield Sentence(words.false_alarm_line(result) or "", soft=True)
    kept = f"Kept in the fit; {option('outliers', 'drop')} excludes them"
    for title, found in ((kept, result.outliers), ("Excluded from the fit", result.excluded)):
        if found:
            yield from outlier_blocks(title, [(o, o.residual, o.ratio) for o in found])


def _correlation_table(result: Calibration) -> ShownTable:
    rows = [
        (printable(a), printable(b), f"{r:+.3f}" if abs(r) < 0.9995 else f"{r:+.6f}")
        for a, b, r in result.correlations[:MOST_CORRELATIONS]
    ]
    more = len(result.correlations) - len(rows)
    note = (
        "Such parameters are known far better together than each alone: the intervals count with "
        "it, and so does every prediction."
    )
    note += f" {more} more are in the result's file." if more else ""
    return ShownTable(("parameter", "and", "correlation"), rows, (0, 1), note=note)


def what_was_identified(result: Calibration) -> str:
    alone, n = len(names_of(result, ALONE)), len(result.combinations)
    text = f"{alone} of {counted(len(result.ordinary), 'parameter')}"
    if n:
        absorbed = len(names_of(result, ABSORBED))
        text += (
            f", and {counted(n, 'combination')} of parameters that these readings cannot separate "
            f"({absorbed} held in exchange)"
        )
    told = {
        WEAK: "hardly shown",
        INVISIBLE: "not visible in these data",
        FIXED: "fixed by the user",
    }
    for standing, why in told.items():
        if found := len(names_of(result, standing)):
            text += f"; {found} {why}"
    if (far := result.finding("unheard_of")) is not None:
        text += f"; {len(far.listed('parameters'))} with implausible values"
    return text + words.counted_functions(result) + "."


def prediction_lines(result: Calibration) -> list[tuple[str, str]]:
    """What the verdict does not say: what was left out of the held-out error, test data."""
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


def error_line(result: Calibration) -> str:
    """All rms errors in one line: 3-D, and of poses the length of the rotation error."""
    sizes = {
        NOMINAL: result.nominal_rms,
        "fitted poses": result.residual_rms,
        "held-out poses": result.heldout_rms,
    }
    if result.test is not None:
        sizes["test data"] = result.test.rms
    text = ", ".join(f"{name} {length(value)}" for name, value in sizes.items())
    if result.observations.kind == "pose":
        turns = (r.reshape(-1, 6)[:, 3:] for r in (result.residual, result.held_out))
        rms = (float(np.sqrt((turn**2).sum(axis=1).mean())) for turn in turns)
        told = (
            f"{significant(v * 1e6)} µrad" if math.isfinite(v) else "not available" for v in rms
        )
        text += f"; rotations {next(told)} fitted, {next(told)} held out"
    return text


def joint_lines(result: Calibration) -> list[tuple[str, str]]:
    """The names that the robot's file has for joint1 … jointN, where they say something else."""
    told = names_told(result.model.chain)
    return [("Joints", told)] if told else []


def readings(result: Calibration) -> str:
    observed = result.observations
    markers = len(np.unique(observed.table.marker[observed.lead]))
    return (
        f"{len(observed.lead)} {READINGS[observed.kind]} in "
        f"{counted(observed.n_configurations, 'configuration')}, "
        f"{counted(markers, 'marker')} ({printable(observed.table.source)})"
    )


def nominal_held_out(result: Calibration) -> str:
    """The nominal arm as the budget has it: base and markers placed by the other configurations."""
    placed = any(stage_of(p.effect) == 0 for p in result.model.parameters)
    return f"{NOMINAL}, held out" if placed else NOMINAL


def budget_steps(
    result: Calibration, budget: ErrorBudget
) -> tuple[list[tuple[str, float, tuple[float, float]]], tuple[str, float] | None]:
    """Name, held-out rms (m) and its 95 % interval of every step; name and size of the floor."""
    named = {"nominal_arm": nominal_held_out(result)}
    steps = [(named.get(s.step, s.step), s.heldout_rms, s.ci95) for s in budget.steps]
    return steps, None if budget.floor is None else (budget.floor_name, budget.floor)


def before_and_after(result: Calibration, budget: ErrorBudget | None) -> dict[str, Array]:
    """Length (n,) in m of the errors by name: of the nominal arm and of the calibrated one in poses
    that were not fitted, and on test data."""
    found = {}
    if budget is not None and len(budget.steps) > 1:
        ends = {nominal_held_out(result): budget.steps[0], "calibrated": budget.steps[-1]}
        found = {name: np.linalg.norm(step.errors, axis=1) for name, step in ends.items()}
    if result.test is not None and len(result.test.errors):
        found["calibrated, test data"] = result.test.errors
    return found


def spread_table(
    found: dict[str, Array], count: str, title: str = "Before and after"
) -> ShownTable:
    """Mean, standard deviation, 95 % quantile and maximum of lengths (n,) in m, by name."""
    rows = []
    for name, e in found.items():
        sizes = (e.mean(), e.std(), np.quantile(e, 0.95), e.max())
        rows.append((name, str(len(e)), *(length(float(size)) for size in sizes)))
    heads = ("error of the position", count, "mean", "std", "95 %", "max")
    return ShownTable(heads, rows, title=title)


def _influence_table(result: Calibration) -> ShownTable:
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
    note = (
        "Without a configuration the estimates move, one of them most. Cook's distance counts all "
        "of them together: at 1 they move about to the edge of their 50 % region. To depend less "
        "on one, measure more like it."
    )
    return ShownTable(heads, rows, (0, 4), note=note)


def _sets_table(result: Calibration) -> ShownTable:
    rows = []
    for s in result.parameter_sets():
        over, ends = "", ""
        if s.heldout_over_chosen and math.isfinite(s.heldout_over_chosen):
            over = signed_change(s.heldout_over_chosen)
            ends = " to ".join(map(signed_change, s.ci95))
        rows.append((
            s.name, str(s.parameters), length(s.residual_rms),
            length(s.heldout_rms) if math.isfinite(s.heldout_rms) else "undetermined", over, ends,
            f"{s.log_likelihood:+.1f}" if s.log_likelihood else "0",
        ))  # fmt: skip
    heads = (
        "set", "parameters", "fitted rms", "held-out rms", "over the chosen", "95 %",
        "log-likelihood over the chosen",
    )  # fmt: skip
    note = (
        "By the weights of the fit, on the model linearised there. Differences and their 95 % are "
        "of the held-out error, by resampling configurations. The likelihood is restricted to what "
        "base and markers leave, with the other parameters of typical size."
    )
    return ShownTable(heads, rows, note=note)
