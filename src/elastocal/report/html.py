"""The identification report: one HTML page that needs no network and no other file."""

from __future__ import annotations

import hashlib
import math
import platform
from collections.abc import Iterable, Mapping
from importlib import metadata, resources
from pathlib import Path
from typing import Any

from elastocal import __version__
from elastocal.files import atomic_write_text, open_input
from elastocal.identification.residual_summary import ResidualSummary
from elastocal.identification.result import IdentificationResult, Outlier
from elastocal.report.faults import false_alarm_line, fault_lines
from elastocal.report.method import intervals_line, method_and_weights
from elastocal.report.noise import (
    candidate_rows,
    does_noise_explain_it,
    group_name,
    ratio,
    shape_line,
    size_rows,
)
from elastocal.report.residuals import Residuals, residuals_of, summary_of
from elastocal.report.rows import any_lopsided, combination_rows, parameter_rows
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
LIBRARIES = ("numpy", "scipy", "casadi")


def write_report(
    result: IdentificationResult,
    path: str | Path,
    truth: Truth | None = None,
    command: str | None = None,
    inputs: Mapping[str, str] | Iterable[str | Path] | None = None,
    seed: int | None = None,
) -> None:
    """Write the page to `path`, whole or not at all.

    `truth` (SI) adds true values; `inputs` are the files read, or a map from their names to
    their SHA-256; `command` and `seed` tell how to repeat the run.

    Raises InputError where an input cannot be read or `path` cannot be written.
    """
    atomic_write_text(path, report_page(result, truth, command, inputs, seed))


def report_page(
    result: IdentificationResult,
    truth: Truth | None = None,
    command: str | None = None,
    inputs: Mapping[str, str] | Iterable[str | Path] | None = None,
    seed: int | None = None,
) -> str:
    """The page as text; arguments as for `write_report`."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(resource("identification.html.j2"))
    return template.render(
        **_contents(result, truth),
        command=None if command is None else printable(command),
        inputs={printable(k): printable(v) for k, v in digests(inputs).items()},
        seed=seed,
        backend=printable(result.model.backend_report()),
    )


def digests(inputs: Mapping[str, str] | Iterable[str | Path] | None) -> dict[str, str]:
    """File name → SHA-256; a map is taken as it is."""
    if inputs is None or isinstance(inputs, Mapping):
        return dict(inputs or {})
    found = {}
    for path in inputs:
        with open_input(path, "input file") as handle:
            digest = hashlib.sha256()
            while block := handle.read(1 << 20):
                digest.update(block)
        found[str(path)] = digest.hexdigest()
    return found


def _contents(result: IdentificationResult, truth: Truth | None) -> dict[str, Any]:
    from markupsafe import Markup

    residuals, summary = residuals_of(result), summary_of(result)
    verdict = [
        ("Identified", what_was_identified(result)),
        ("Prediction", how_well_it_predicts(result)),
        ("Noise", does_noise_explain_it(result)),
        *held_lines(result),
    ]
    if truth:
        verdict.append(("Truth", coverage_line(result, truth)))
    names = dict.fromkeys([result.model.chain.name, result.model.cell.name])
    return {
        "title": printable(" – ".join(name for name in names if name)),
        "css": Markup(resource("style.css")),
        "version": __version__,
        "environment": software(),
        "compared": truth is not None,
        "lopsided": any_lopsided((*result.estimates, *result.combinations)),
        "verdict": verdict,
        "readings": readings(result),
        "method": _sentence(method_and_weights(result)),
        "intervals": _sentence(f"intervals are {intervals_line(result)}"),
        "dof": result.dof,
        **_noise(result, summary),
        "error_line": _sentence(error_line(result)),
        "warnings": [printable(w) for w in result.warnings],
        "parameters": parameter_rows(result, truth),
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
        "figures": {
            name: Markup(svg) for name, svg in _figures(result, residuals, summary).items()
        },
        **_thinning(residuals),
    }


def _endless(result: IdentificationResult) -> str:
    """A sentence for bars that run off, empty where every interval has two ends."""
    intervals = [e.ci95 for e in result.estimates] + [c.ci95 for c in result.combinations]
    endless = any(math.isinf(end) for ci95 in intervals for end in ci95 or ())
    return " An interval without an end runs to the edge." if endless else ""


def _noise(result: IdentificationResult, summary: ResidualSummary | None) -> dict[str, Any]:
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


def _figures(
    result: IdentificationResult, residuals: Residuals, summary: ResidualSummary | None
) -> dict[str, str]:
    from elastocal.report import figures, noise_figures

    distribution = {} if summary is None else {
        "histogram": noise_figures.histogram(summary),
        "scores": noise_figures.scores(summary),
        "groups": noise_figures.scatter_by_group(summary),
        "histograms": noise_figures.histograms_by_group(summary),
    }  # fmt: skip
    return {
        **distribution,
        "errors": figures.errors(result),
        "held_out": figures.held_out(result, residuals),
        "by_configuration": figures.by_configuration(residuals),
        "against_joints": figures.against_joints(result, residuals),
    }


def _thinning(residuals: Residuals) -> dict[str, str]:
    """Sentences on how many readings the scatter plots show, empty where it is all."""
    from elastocal.report.figures import MOST_JOINT_DOTS

    total = len(residuals.value)
    shown = len(residuals.shown)
    in_joints = min(shown, MOST_JOINT_DOTS // residuals.positions)
    text = " Dots are a random choice of {} of {} readings; everything else uses all of them."
    return {
        "thinned": text.format(shown, total) if shown < total else "",
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


def software() -> str:
    versions = [f"{name} {metadata.version(name)}" for name in LIBRARIES]
    return ", ".join([f"Python {platform.python_version()}", *versions])


def resource(name: str) -> str:
    return (resources.files("elastocal.report") / name).read_text(encoding="utf-8")
