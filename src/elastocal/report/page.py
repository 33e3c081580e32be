"""Results as one HTML page each: identification, plan, diagnosis, compensation."""

from __future__ import annotations

import base64
import hashlib
import math
import platform
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from elastocal import __version__
from elastocal.compensation.compensate import Compensation
from elastocal.diagnosis.diagnosis import Diagnosis
from elastocal.files import atomic_write_text, open_input
from elastocal.identification.error_budget import ErrorBudget, gap_budget
from elastocal.identification.outliers import Outlier
from elastocal.identification.residuals import ResidualSummary
from elastocal.identification.result import Calibration
from elastocal.model.manipulator import Model
from elastocal.planning.plan import Plan
from elastocal.report.arm_view import (
    Space,
    marker_positions,
    plan_space,
    residual_space,
    space_json,
    time_caption,
    view_caption,
)
from elastocal.report.diagnosis_view import (
    BOX_WIDTH,
    BUDGET_HEADS,
    CANDIDATE_HEADS,
    FAULTY_HEADS,
    PAIR_HEADS,
    PARAMETER_HEADS,
    STRUCTURE_HEADS,
    UNTESTED_HEADS,
    added_parameter_rows,
    chain_boxes,
    diagnosis_headline,
    diagnosis_lines,
    diagnosis_steps,
    effect_at,
    extra_lines,
    extra_visits,
    faulty_rows,
    gap_rows,
    hypothesis_rows,
    likeliest_places,
    noise_floor_lines,
    pair_rows,
    structure_rows,
    untested_rows,
)
from elastocal.report.formatting import (
    ShownTable,
    capital,
    counted,
    length,
    printable,
    significant,
    together,
)
from elastocal.report.identification_view import (
    Truth,
    any_lopsided,
    budget_table,
    combination_rows,
    correlation_lines,
    coverage_line,
    error_line,
    held_lines,
    how_well_it_predicts,
    judgement,
    noise_lines,
    parameter_rows,
    readings,
    undetermined_lines,
    what_was_identified,
)
from elastocal.report.method_and_noise import (
    candidate_rows,
    does_noise_explain_it,
    false_alarm_line,
    fault_lines,
    group_name,
    intervals_line,
    method_and_weights,
    ratio,
    shape_line,
    size_rows,
)
from elastocal.report.notebook import view_of
from elastocal.report.plan_view import (
    curve_rows,
    interval_rows,
    plan_headline,
    plan_lead,
    plan_lines,
    plan_steps,
    plan_tone,
    pose_rows,
    reason_rows,
    removal_rows,
    stop_rows,
)
from elastocal.report.residual_figures import drawn_for
from elastocal.report.residual_view import (
    Residuals,
    residual_table,
    residuals_by,
    residuals_of,
    summary_of,
)

if TYPE_CHECKING:
    from jinja2 import Environment

# The reports: each one HTML page that needs no network and no other file.

LIBRARIES = ("numpy", "scipy", "casadi")
Inputs = Mapping[str, str] | Iterable[str | Path] | None


@dataclass(frozen=True)
class Repeat:
    """What it takes to repeat a run: command line, files read with their SHA-256, seed, engine.

    `inputs` are the files, or a map from their names to their hashes; `backend` is what
    `Model.backend_report` says.
    """

    command: str | None = None
    inputs: Inputs = None
    seed: int | None = None
    backend: str = ""


def render(template: str, title: str, repeat: Repeat, **content: Any) -> str:
    """The page of `template` as text, which needs no network and no other file.

    Where `content` has a `view` (JSON of the 3-D view), plotly.js comes along.  The page runs
    these two scripts, named by their hashes, and no other: not even one that slipped into a name.
    Raises InputError where an input cannot be read.
    """
    from markupsafe import Markup

    script = resource("report.js")
    scripts = [script, *([plotly().source] if content.get("view") else [])]
    return str(
        environment()
        .get_template(template)
        .render(
            title=printable(title),
            css=Markup(resource("style.css")),
            script=Markup(script),
            script_hashes=" ".join(f"'sha256-{_digest(text)}'" for text in scripts),
            plotly=Markup(plotly().packed) if content.get("view") else "",
            version=__version__,
            environment=software(bool(content.get("view"))),
            command=None if repeat.command is None else printable(repeat.command),
            inputs={printable(k): printable(v) for k, v in digests(repeat.inputs).items()},
            seed=repeat.seed,
            backend=printable(repeat.backend),
            **content,
        )
    )


@cache
def environment() -> Environment:
    """Templates of this package: what is not marked as markup is escaped, what is missing fails."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    return Environment(
        loader=FunctionLoader(resource),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


@dataclass(frozen=True)
class Plotly:
    """plotly.js as `source`, and `packed` (gzip, base64) to a third of that."""

    source: str
    packed: str


@cache
def plotly() -> Plotly:
    import gzip

    from plotly.offline import get_plotlyjs

    source = get_plotlyjs()
    packed = gzip.compress(source.encode(), 9, mtime=0)
    return Plotly(source, base64.b64encode(packed).decode())


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def title_of(model: Model) -> str:
    """Robot and cell, once where they have the same name."""
    names = dict.fromkeys([model.chain.name, model.cell.name])
    return " – ".join(name for name in names if name)


def digests(inputs: Inputs) -> dict[str, str]:
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


def software(plotly: bool = False) -> str:
    """Python and the libraries that the numbers depend on; plotly where the page draws with it."""
    names = (*LIBRARIES, "plotly") if plotly else LIBRARIES
    versions = [f"{name} {metadata.version(name)}" for name in names]
    return ", ".join([f"Python {platform.python_version()}", *versions])


def resource(name: str) -> str:
    return (resources.files("elastocal.report") / name).read_text(encoding="utf-8")


MOST_CORRELATIONS_LISTED = 30
MOST_FAULTY = 100
Published = Mapping[str, tuple[float, float]]


def write_identification_report(
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
    atomic_write_text(path, identification_page(result, truth, command, inputs, seed, published))


def identification_page(
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
        **_identification_contents(result, truth, published or {}),
    )


def _identification_contents(
    result: Calibration, truth: Truth | None, published: Published
) -> dict[str, Any]:
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
    figures = drawn_for(result, residuals, summary, budget, space)
    return {
        "judgement": judgement(result, sections=True),
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
        "budget": None if budget is None else budget_table(result, budget),
        "floor": _floor(budget),
        "parameters": parameter_rows(result, truth, published),
        "combinations": combination_rows(result, truth),
        "endless": _endless(result),
        "undetermined": [_sentence(line) for line in undetermined_lines(result)],
        "correlations": correlation_lines(result, MOST_CORRELATIONS_LISTED),
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


def _floor(budget: ErrorBudget | None) -> str:
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
    from elastocal.report.residual_figures import MOST_IN_MATRIX, MOST_JOINT_DOTS

    total = len(residuals.value)
    shown = len(residuals.shown)
    in_joints = min(shown, MOST_JOINT_DOTS // residuals.positions)
    text = " Dots are a random choice of {} of {} readings; everything else uses all of them."
    return {
        "thinned": text.format(shown, total) if shown < total else "",
        "thinned_matrix": (
            f" The {MOST_IN_MATRIX} of {len(result.determined)} that correlate most."
            if len(result.determined) > MOST_IN_MATRIX
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
    return f"{capital(text)}."


def write_plan_report(
    plan: Plan,
    path: str | Path,
    command: str | None = None,
    inputs: Inputs = None,
) -> None:
    """Write the page to `path`, whole or not at all; arguments as for `plan_page`.

    Raises InputError where an input cannot be read or `path` cannot be written.
    """
    atomic_write_text(path, plan_page(plan, command, inputs))


def plan_page(plan: Plan, command: str | None = None, inputs: Inputs = None) -> str:
    """The page as text.

    `inputs` are the files read, or a map from their names to their SHA-256; `command` tells how
    to repeat the run.
    """
    return render(
        "plan.html.j2",
        title_of(plan.model),
        Repeat(command, inputs, plan.seed, plan.model.backend_report()),
        **_plan_contents(plan),
    )


def _plan_contents(plan: Plan) -> dict[str, Any]:
    from markupsafe import Markup

    space = plan_space(plan)
    lines = plan_lines(plan)
    return {
        "lead": plan_lead(plan),
        "headline": plan_headline(plan),
        "tone": plan_tone(plan),
        "verdict": [(label, capital(text)) for label, text in lines if label != "Warning"],
        "warnings": [text for label, text in lines if label == "Warning"],
        "steps": plan_steps(plan),
        "poses": pose_rows(plan, reasons=False),
        "reasons": reason_rows(plan),
        "stops": stop_rows(plan),
        "intervals": interval_rows(plan),
        "removed": removal_rows(plan),
        "curve": curve_rows(plan),
        "view": space_json(space),
        "drawn_from": space.shells.drawn_from,
        "figures": {name: Markup(svg) for name, svg in _plan_figures(plan, space).items()},
    }


def _plan_figures(plan: Plan, space: Space) -> dict[str, str]:
    from elastocal.report.arm_view import space_picture
    from elastocal.report.figures import plan_curve, plan_intervals, plan_removed

    return {
        "space": space_picture(space, "The arm in the poses of the plan"),
        "intervals": plan_intervals(plan) if plan.predicted else "",
        "removed": plan_removed(plan),
        "curve": plan_curve(plan) if plan.curve else "",
    }


MOST_CANDIDATES = 40
MOST_TESTS = 12
MOST_FAULTY_LISTED = 100


def write_diagnosis_report(
    diagnosis: Diagnosis,
    model: Model,
    path: str | Path,
    data: str,
    command: str | None = None,
    inputs: Inputs = None,
    seed: int | None = None,
) -> None:
    """Write the page to `path`, whole or not at all; arguments as for `diagnosis_page`.

    Raises InputError where an input cannot be read or `path` cannot be written.
    """
    atomic_write_text(path, diagnosis_page(diagnosis, model, data, command, inputs, seed))


def diagnosis_page(
    diagnosis: Diagnosis,
    model: Model,
    data: str,
    command: str | None = None,
    inputs: Inputs = None,
    seed: int | None = None,
) -> str:
    """The page as text.

    `model` is the arm that was diagnosed, `data` names its measurements; `inputs` are the files
    read, or a map from their names to their SHA-256; `command` and `seed` tell how to repeat it.
    """
    return render(
        "diagnosis.html.j2",
        title_of(model),
        Repeat(command, inputs, seed, model.backend_report()),
        **_diagnosis_contents(diagnosis, model),
        **_residuals(diagnosis),
        data=printable(data),
    )


def _diagnosis_contents(d: Diagnosis, model: Model) -> dict[str, Any]:
    from markupsafe import Markup

    kinds = model.chain.kinds
    lines = [(label, capital(text)) for label, text in diagnosis_lines(d)[1:]]
    alike = [together([effect_at(e) for e in rivals]) for rivals in d.indistinguishable]
    return {
        "headline": diagnosis_headline(d),
        "tone": d.findings[0].severity,
        "verdict": lines,
        "steps": diagnosis_steps(d),
        "warnings": [capital(printable(w)) for w in d.warnings],
        "readings": f"{counted(d.n_readings, 'reading')} in "
        f"{counted(d.n_configurations, 'configuration')}",
        "boxes": chain_boxes(d),
        "box": BOX_WIDTH,
        "places": likeliest_places(d),
        "figures": {name: Markup(svg) for name, svg in _diagnosis_figures(d).items()},
        "budget": ShownTable(BUDGET_HEADS, gap_rows(d)),
        "parameters": ShownTable(PARAMETER_HEADS, added_parameter_rows(d.effects), (0, 3)),
        "candidates": ShownTable(CANDIDATE_HEADS, hypothesis_rows(d, MOST_CANDIDATES), (0, 5)),
        "n_candidates": len(d.candidates),
        "alike": [capital(text) for text in alike],
        "structure": ShownTable(STRUCTURE_HEADS, structure_rows(d, MOST_TESTS)),
        "n_structure": len(d.structure),
        "noise": noise_floor_lines(d.noise, kinds),
        "faulty": ShownTable(FAULTY_HEADS, faulty_rows(d, MOST_FAULTY_LISTED), (1, 2)),
        "more_faulty": max(0, len(d.noise.faulty) - MOST_FAULTY_LISTED),
        "untested": ShownTable(UNTESTED_HEADS, untested_rows(d), (0, 1, 2)),
        "extra": [] if d.extra is None else extra_lines(d.extra),
        "pairs": ShownTable(PAIR_HEADS, [] if d.extra is None else pair_rows(d.extra)),
        "visits": extra_visits(d, kinds),
    }


def _residuals(d: Diagnosis) -> dict[str, Any]:
    """The residuals of the calibrated arm; no view where they are not known."""
    base = d.calibrated
    if base is None:
        return {"view": None, "residual_table": None, "view_caption": "", "time_caption": ""}
    residuals = residuals_by(base.observed, base.residual)
    space = residual_space(base.model, base.observed, base.x, base.residual)
    return {
        "view": space_json(space),
        "view_caption": view_caption(space, len(residuals.labels)),
        "time_caption": time_caption(base.observed),
        "residual_table": residual_table(base.observed, residuals),
    }


def _diagnosis_figures(d: Diagnosis) -> dict[str, str]:
    """Name → SVG, empty where there is nothing to draw."""
    from elastocal.report.figures import candidate_bars, diagnosis_waterfall, unknown_curves

    return {
        "waterfall": diagnosis_waterfall(d) if d.budget else "",
        "candidates": candidate_bars(d),
        "curves": unknown_curves(d) if d.curves else "",
        **_residual_figures(d),
    }


def _residual_figures(d: Diagnosis) -> dict[str, str]:
    from elastocal.report.arm_view import space_picture
    from elastocal.report.residual_figures import against_joints, by_region, over_time

    base = d.calibrated
    if base is None:
        return {}
    residuals = residuals_by(base.observed, base.residual)
    positions = marker_positions(base.model, base.observed, base.x)
    space = residual_space(base.model, base.observed, base.x, base.residual)
    return {
        "against_joints": against_joints(base.model.chain.kinds, residuals),
        "over_time": over_time(base.observed, residuals),
        "by_region": by_region(positions, residuals.value[:, : residuals.positions]),
        "space": space_picture(space, "Residuals of the calibrated arm as arrows"),
    }


# The report of any result, as `Result.report` asks for it: one HTML page.


def write_page(
    result: object, path: Path, inputs: Inputs, command: str | None, seed: int | None
) -> None:
    """Write the result's page, whole or not at all; `inputs` None are the files it came from.

    Raises InputError where an input cannot be read or `path` cannot be written.
    """
    write = next(write for kind, write in PAGES.items() if isinstance(result, kind))
    write(result, path, inputs, command, seed)


def _calibration(
    fit: Calibration, path: Path, inputs: Inputs, command: str | None, seed: int | None
) -> None:
    files = _files(fit.model, fit.observations.table.source) if inputs is None else inputs
    write_identification_report(fit, path, command=command, inputs=files, seed=seed)


def _plan(plan: Plan, path: Path, inputs: Inputs, command: str | None, seed: int | None) -> None:
    write_plan_report(plan, path, command, _files(plan.model) if inputs is None else inputs)


def _diagnosis(
    found: Diagnosis, path: Path, inputs: Inputs, command: str | None, seed: int | None
) -> None:
    assert found.model is not None  # `diagnose` states it
    files = _files(found.model, found.data) if inputs is None else inputs
    write_diagnosis_report(
        found, found.model, path, found.data, command=command, inputs=files, seed=seed
    )


def _compensation(
    found: Compensation, path: Path, inputs: Inputs, command: str | None, seed: int | None
) -> None:
    from markupsafe import Markup

    view = view_of(found)
    table = Path(found.targets.table.source)
    files = [table] if inputs is None and table.is_file() else inputs
    figures = [
        Markup('<img alt="{}" src="data:image/png;base64,{}">').format(
            kind, _png(view, found, kind)
        )
        for kind in view.figures
    ]
    page = render(
        "compensation.html.j2",
        printable(found.chain.name),
        Repeat(command, files, seed),
        shown=Markup(view.html(found)),
        drawn=figures,
    )
    atomic_write_text(path, page)


def _png(view: Any, found: Compensation, kind: str) -> str:
    import io

    picture = io.BytesIO()
    view.plot(found, kind, False).savefig(picture, format="png", dpi=110)
    return base64.b64encode(picture.getvalue()).decode()


def _files(model: Model, *tables: str) -> list[Path]:
    """The cell and the tables, as far as they are files."""
    named = [model.cell.path, *map(Path, tables)]
    return [path for path in named if path is not None and Path(path).is_file()]


PAGES: dict[type, Callable[[Any, Path, Inputs, str | None, int | None], None]] = {
    Calibration: _calibration,
    Plan: _plan,
    Diagnosis: _diagnosis,
    Compensation: _compensation,
}
