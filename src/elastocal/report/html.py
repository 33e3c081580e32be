"""The identification report: one HTML page that needs no network and no other file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from elastocal.files import atomic_write_text
from elastocal.identification.residual_summary import ResidualSummary
from elastocal.identification.result import Calibration, Outlier
from elastocal.report import identification_figures
from elastocal.report.faults import false_alarm_line, fault_lines
from elastocal.report.gap_budget import Budget, gap_budget
from elastocal.report.method import intervals_line, method_and_weights
from elastocal.report.noise import (
    candidate_rows,
    does_noise_explain_it,
    group_name,
    ratio,
    shape_line,
    size_rows,
)
from elastocal.report.page import Inputs, Repeat, render, title_of
from elastocal.report.residual_rows import residual_table
from elastocal.report.residual_space import residual_space, time_caption, view_caption
from elastocal.report.residuals import Residuals, residuals_of, summary_of
from elastocal.report.rows import any_lopsided, budget_table, combination_rows, parameter_rows
from elastocal.report.space import space_json
from elastocal.report.trust import judgement
from elastocal.report.units import length, significant
from elastocal.report.verdict import (
    correlation_lines,
    coverage_line,
    error_line,
    held_lines,
    how_well_it_predicts,
    noise_lines,
    readings,
    what_was_identified,
)
from elastocal.report.words import Truth, printable, undetermined_lines

MOST_CORRELATIONS = 30
MOST_FAULTY = 100
Published = Mapping[str, tuple[float, float]]


def write_report(
    result: Calibration,
    path: str | Path,
    truth: Truth | None = None,
    command: str | None = None,
    inputs: Inputs = None,
    seed: int | None = None,
    published: Published | None = None,
) -> None:
    """Write the page to `path`, whole or not at all.

    `truth` (SI) adds true values, `published` values (SI) and half widths that others found;
    `inputs` are the files read, or a map from their names to their SHA-256; `command` and `seed`
    tell how to repeat the run.

    Raises InputError where an input cannot be read or `path` cannot be written.
    """
    atomic_write_text(path, report_page(result, truth, command, inputs, seed, published))


def report_page(
    result: Calibration,
    truth: Truth | None = None,
    command: str | None = None,
    inputs: Inputs = None,
    seed: int | None = None,
    published: Published | None = None,
) -> str:
    """The page as text; arguments as for `write_report`."""
    return render(
        "identification.html.j2",
        title_of(result.model),
        Repeat(command, inputs, seed, result.model.backend_report()),
        **_contents(result, truth, published or {}),
    )


def _contents(result: Calibration, truth: Truth | None, published: Published) -> dict[str, Any]:
    from markupsafe import Markup

    residuals, summary, budget = residuals_of(result), summary_of(result), gap_budget(result)
    space = residual_space(result.model, result.observations, result.x, result.residual)
    verdict = [
        ("Identified", what_was_identified(result)),
        ("Prediction", how_well_it_predicts(result)),
        ("Noise", does_noise_explain_it(result)),
        *held_lines(result),
    ]
    if truth:
        verdict.append(("Truth", coverage_line(result, truth)))
    figures = identification_figures.drawn_for(result, residuals, summary, budget, space)
    return {
        "judgement": judgement(result),
        "compared": truth is not None,
        "published": bool(published),
        "lopsided": any_lopsided((*result.estimates, *result.combinations)),
        "verdict": verdict,
        "readings": readings(result),
        "method": _sentence(method_and_weights(result)),
        "intervals": _sentence(f"intervals are {intervals_line(result)}"),
        "dof": result.dof,
        **_noise(result, summary),
        "error_line": _sentence(error_line(result)),
        "warnings": [printable(w) for w in result.warnings],
        "budget": None if budget is None else budget_table(budget),
        "floor": _floor(budget),
        "parameters": parameter_rows(result, truth, published),
        "combinations": combination_rows(result, truth),
        "endless": _endless(result),
        "undetermined": [_sentence(line) for line in undetermined_lines(result)],
        "correlations": correlation_lines(result, MOST_CORRELATIONS),
        "faults": fault_lines(result),
        "false_alarm": false_alarm_line(result),
        "outliers": [_faulty(o) for o in result.outliers],
        "excluded": [_faulty(o) for o in result.excluded],
        "most_faulty": MOST_FAULTY,
        "n_markers": len(residuals.markers),
        "residual_table": residual_table(result.observations, residuals),
        "view": space_json(space),
        "view_caption": view_caption(space, len(residuals.labels)),
        "time_caption": time_caption(result.observations),
        "figures": {name: Markup(svg) for name, svg in figures.items()},
        **_thinning(result, residuals),
    }


def _floor(budget: Budget | None) -> str:
    if budget is None or budget.floor is None:
        return "Nothing says how large the noise alone is."
    return f"The dashed line is what noise alone gives ({budget.floor_name})."


def _endless(result: Calibration) -> str:
    """A sentence for bars that run off, empty where every interval has two ends."""
    intervals = [e.ci95 for e in result.estimates] + [c.ci95 for c in result.combinations]
    endless = any(math.isinf(end) for ci95 in intervals for end in ci95 or ())
    return " An interval without an end runs to the edge." if endless else ""


def _noise(result: Calibration, summary: ResidualSummary | None) -> dict[str, Any]:
    """Sentences and rows of the section on noise."""
    sentences = [text for label, text in noise_lines(result) if label != "Residuals"]
    deviating = () if summary is None else summary.deviating
    return {
        "noise_sentences": sentences,
        "shape": None if summary is None else shape_line(summary),
        "sizes": size_rows(result.noise),
        "candidates": candidate_rows(result.noise),
        "deviating": [(group_name(by, g), g.n, ratio(g), f"{g.p_holm:.1g}") for by, g in deviating],
        "held_out_scatter": _held_out_scatter(summary),
    }


def _held_out_scatter(summary: ResidualSummary | None) -> str:
    """Held-out residuals over the noise model, empty where they are not known."""
    if summary is None or summary.whole.held_out_mean_square is None:
        return ""
    size = significant(summary.whole.held_out_mean_square**0.5)
    return f"In held-out configurations the scatter is {size} times that of the noise model."


def _thinning(result: Calibration, residuals: Residuals) -> dict[str, str]:
    """Sentences on how many readings the scatter plots show, empty where it is all."""
    from elastocal.report.figures import MOST_JOINT_DOTS
    from elastocal.report.place_figures import MOST_PARAMETERS

    total = len(residuals.value)
    shown = len(residuals.shown)
    in_joints = min(shown, MOST_JOINT_DOTS // residuals.positions)
    text = " Dots are a random choice of {} of {} readings; everything else uses all of them."
    return {
        "thinned": text.format(shown, total) if shown < total else "",
        "thinned_matrix": (
            f" The {MOST_PARAMETERS} of {len(result.determined)} that correlate most."
            if len(result.determined) > MOST_PARAMETERS
            else ""
        ),
        "thinned_joints": text.format(in_joints, total) if in_joints < total else "",
    }


def _faulty(o: Outlier) -> dict[str, str]:
    return {
        "line": str(o.line),
        "configuration": printable(o.configuration),
        "marker": printable(o.marker),
        "error": length(o.residual),
        "ratio": significant(o.ratio),
    }


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."
