"""Results as HTML pages: identification, plan, diagnosis, compensation and what else there is.

Each page needs no network and no other file.  Its words and tables come from the result's view,
its figures are drawn here; the templates lie beside this module.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import platform
import re
from collections.abc import Callable, Iterable, Mapping
from datetime import date
from functools import cache, partial
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from elastocal import __version__
from elastocal.compensation.compensate import Compensation
from elastocal.diagnosis.changes import Comparison
from elastocal.diagnosis.diagnosis import Diagnosis
from elastocal.files import atomic_write_text, open_input
from elastocal.identification.error_budget import gap_budget
from elastocal.identification.result import Calibration
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.planning.plan import Plan
from elastocal.report.arm_view import (
    Space,
    plan_space,
    residual_space,
    space_json,
    space_picture,
    time_caption,
    view_caption,
)
from elastocal.report.changes_view import changes_contents, draw_map
from elastocal.report.diagnosis_view import diagnosis_contents
from elastocal.report.figures import (
    as_figures,
    candidate_bars,
    diagnosis_waterfall,
    drawn,
    effects_over_joints,
    plan_curve,
    plan_intervals,
    plan_removed,
    share_bars,
    svg_of,
    unknown_curves,
)
from elastocal.report.formatting import minus
from elastocal.report.identification_view import (
    Published,
    Truth,
    certificate_contents,
    identification_contents,
)
from elastocal.report.notebook import view_of
from elastocal.report.plan_view import plan_contents
from elastocal.report.residual_figures import (
    MOST_JOINT_DOTS,
    drawn_for,
    residual_figures,
)
from elastocal.report.residual_view import (
    Residuals,
    residual_table,
    residuals_by,
    residuals_of,
    summary_of,
)
from elastocal.screen import shown
from elastocal.text import printable

if TYPE_CHECKING:
    from jinja2 import Environment

FEWEST_SECTIONS = 4  # that are worth a list
LIBRARIES = ("numpy", "scipy", "casadi")
Inputs = Mapping[str, str] | Iterable[str | Path] | None


def write_page(
    result: object, path: Path, inputs: Inputs = None, command: str | None = None,
    seed: int | None = None, **told: Any,
) -> None:  # fmt: skip
    """Write the result's page, whole or not at all; arguments as for `page_of`.

    Where no `inputs` are named, they are the files that the result came from.  Raises InputError
    where an input cannot be read or `path` cannot be written.
    """
    inputs = sources(result) if inputs is None else inputs
    atomic_write_text(path, page_of(result, inputs, command, seed, **told))


def page_of(
    result: object, inputs: Inputs = None, command: str | None = None, seed: int | None = None,
    **told: Any,
) -> str:  # fmt: skip
    """The page of a result as text.

    `inputs` are the files read, or a map from their names to their SHA-256; `command` and `seed`
    tell how to repeat the run.  To a calibration `truth` (SI) adds true values, and `published`
    values (SI) and half widths that others found; `certificate` makes a certificate of it.  Raises
    InputError where an input cannot be read.

    Where the page has a 3-D view, plotly.js comes along.  It runs these two scripts, named by
    their hashes, and no other: not even one that slipped into a name.
    """
    from markupsafe import Markup

    template, contents = PAGES[type(result).__name__]
    if told.pop("certificate", False):
        template, contents = "certificate.html.j2", _certificate
    content: dict[str, Any] = {"seed": seed, "backend": ""} | contents(result, **told)
    drawn = bool(content.get("view"))
    source, packed = plotly() if drawn else ("", "")
    script = resource("report.js")
    return with_contents(
        environment()
        .get_template(template)
        .render(
            content
            | {
                "title": printable(content["title"]),
                "css": Markup(resource("style.css")),
                "script": Markup(script),
                "script_hashes": " ".join(
                    f"'sha256-{_digest(text)}'" for text in (script, source) if text
                ),
                "plotly": Markup(packed),
                "version": __version__,
                "date": date.today().isoformat(),
                "environment": software(drawn),
                "command": None if command is None else printable(command),
                "inputs": {printable(k): printable(v) for k, v in digests(inputs).items()},
                "backend": printable(content["backend"]),
            }
        )
    )


def with_contents(page: str) -> str:
    """The page with a list of its sections where `<nav></nav>` stands."""
    heads = re.findall(r"<h2>(.*?)</h2>", page)
    links = "".join(f'<a href="#part{k}">{head}</a>' for k, head in enumerate(heads))
    if len(heads) < FEWEST_SECTIONS:
        return page.replace("<nav></nav>\n", "", 1)
    number = iter(range(len(heads)))
    page = re.sub("<h2>", lambda _: f'<a id="part{next(number)}"></a><h2>', page)
    return page.replace("<nav></nav>", f'<nav aria-label="Contents">{links}</nav>', 1)


@cache
def environment() -> Environment:
    """Templates of this package: what is not marked as markup is escaped, what is missing fails."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    made = Environment(
        loader=FunctionLoader(resource),
        autoescape=True,
        # Texts come from files; what is marked as markup was made by this package.
        finalize=lambda value: shown(value) if type(value) is str else value,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["minus"] = minus
    return made


@cache
def plotly() -> tuple[str, str]:
    """plotly.js, and the same packed (gzip, base64) to a third of that."""
    from plotly.offline import get_plotlyjs

    source = get_plotlyjs()
    packed = gzip.compress(source.encode(), 9, mtime=0)
    return source, base64.b64encode(packed).decode()


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def figures_of(result: object) -> dict[str, Any]:
    """The figures of a result's page as matplotlib's, by name; none where it has no model."""
    if isinstance(result, Diagnosis) and result.model is None:
        return {}
    contents = PAGES[type(result).__name__][1]
    with as_figures():
        return {name: f for name, f in contents(result).get("figures", {}).items() if f}


def sources(result: Any) -> list[Path]:
    """The cell and the tables that a result came from, as far as they are files."""
    if isinstance(result, Comparison):
        named = [result.old.model.cell.path, result.old.source, result.new.source]
    elif isinstance(result, Compensation):
        named = [result.targets.table.source]
    elif not hasattr(result, "model"):
        named = [result.source]
    else:
        named = [result.model.cell.path]
        if isinstance(result, Calibration):
            named.append(result.observations.table.source)
        elif isinstance(result, Diagnosis):
            named.append(result.data)
    return [Path(path) for path in named if path is not None and Path(path).is_file()]


def digests(inputs: Inputs) -> dict[str, str]:
    """File name → SHA-256; a map is taken as it is."""
    if inputs is None or isinstance(inputs, Mapping):
        return dict(inputs or {})
    found = {}
    for path in inputs:
        with open_input(path, "input file") as handle:
            found[str(path)] = hashlib.file_digest(handle, "sha256").hexdigest()  # type: ignore[arg-type]
    return found


def software(plotly: bool = False) -> str:
    """Python and the libraries that the numbers depend on; plotly where the page draws with it."""
    names = (*LIBRARIES, "plotly") if plotly else LIBRARIES
    versions = [f"{name} {metadata.version(name)}" for name in names]
    return ", ".join([f"Python {platform.python_version()}", *versions])


def resource(name: str) -> str:
    return (resources.files("elastocal.report") / name).read_text(encoding="utf-8")


# What the page of each kind of result shows, by the names that its template has for it.


def _calibration(
    result: Calibration, truth: Truth | None = None, published: Published | None = None
) -> dict[str, Any]:
    residuals, summary, budget = residuals_of(result), summary_of(result), gap_budget(result)
    space = residual_space(result.model, result.observations, result.x, result.residual)
    figures = drawn_for(result, residuals, summary, budget, space)
    return {
        **_of(result.model, figures),
        **identification_contents(result, summary, budget, truth, published),
        **_residuals(result.observations, residuals, space),
        "n_markers": len(residuals.markers),
        **_thinning(residuals),
    }


def _certificate(result: Calibration) -> dict[str, Any]:
    return {**_of(result.model, {}), **certificate_contents(result, gap_budget(result))}


def _diagnosis(d: Diagnosis) -> dict[str, Any]:
    model, base = d.model, d.calibrated
    assert model is not None  # `diagnose` states it
    figures = {
        "causes": share_bars(d) if d.components else "",
        "waterfall": diagnosis_waterfall(d) if d.budget else "",
        "candidates": candidate_bars(d),
        "curves": unknown_curves(d) if d.curves else "",
        "effects": effects_over_joints(d),
    }
    shown: dict[str, Any] = {"view": None}
    if base is not None:
        residuals = residuals_by(base.observed, base.residual)
        space = residual_space(base.model, base.observed, base.x, base.residual)
        shown = _residuals(base.observed, residuals, space)
        title = "Residuals of the calibrated arm as arrows"
        figures |= residual_figures(base.model, base.observed, base.x, residuals, space, title)
    return {**_of(model, figures), **diagnosis_contents(d, model.chain.kinds), **shown}


def _plan(plan: Plan) -> dict[str, Any]:
    space = plan_space(plan)
    figures = {
        "space": space_picture(space, "The arm in the poses of the plan"),
        "intervals": plan_intervals(plan) if plan.predicted else "",
        "removed": plan_removed(plan),
        "curve": plan_curve(plan) if plan.curve else "",
    }
    return {
        **_of(plan.model, figures),
        **plan_contents(plan),
        "seed": plan.seed,
        "view": space_json(space),
        "drawn_from": space.shells.drawn_from,
    }


def _shown(what: str, found: Any) -> dict[str, Any]:
    """What a notebook shows of it, and its figures."""
    from markupsafe import Markup

    view = view_of(found)
    drawn = [Markup(svg_of(view.plot(found, kind, False), kind)) for kind in view.figures]
    title = found.chain.name if isinstance(found, Compensation) else found.source
    return {"what": what, "title": title, "shown": Markup(view.html(found)), "drawn": drawn}


def _of(model: Model, figures: Mapping[str, str]) -> dict[str, Any]:
    """Robot and cell, once where they have the same name; the figures (SVG, empty where there is
    nothing to draw); what evaluated the model."""
    from markupsafe import Markup

    names = dict.fromkeys([model.chain.name, model.cell.name])
    return {
        "title": " – ".join(name for name in names if name),
        "figures": {n: Markup(f) if isinstance(f, str) else f for n, f in figures.items()},
        "backend": model.backend_report(),
    }


def _residuals(observed: Observations, residuals: Residuals, space: Space) -> dict[str, Any]:
    return {
        "view": space_json(space),
        "view_caption": view_caption(space, len(residuals.labels)),
        "time_caption": time_caption(observed),
        "residual_table": residual_table(observed, residuals),
    }


def _thinning(residuals: Residuals) -> dict[str, str]:
    """Sentences on how many readings the scatter plots show, empty where it is all."""
    total, shown = len(residuals.value), len(residuals.shown)
    in_joints = min(shown, MOST_JOINT_DOTS // residuals.positions)
    text = " Dots are a random choice of {} of {} readings; everything else uses all of them."
    return {
        "thinned": text.format(shown, total) if shown < total else "",
        "thinned_joints": text.format(in_joints, total) if in_joints < total else "",
    }


def _comparison(c: Comparison) -> dict[str, Any]:
    draw = partial(draw_map, c=c)
    figures = {"map": drawn(draw, 8.0, 3.6, "How far the tool has moved")}
    return {**_of(c.old.model, figures), **changes_contents(c)}


PAGES: dict[str, tuple[str, Callable[..., dict[str, Any]]]] = {
    "Calibration": ("identification.html.j2", _calibration),
    "Comparison": ("changes.html.j2", _comparison),
    "Plan": ("plan.html.j2", _plan),
    "Diagnosis": ("diagnosis.html.j2", _diagnosis),
    "Compensation": ("shown.html.j2", partial(_shown, "Compensation")),
    "Measurements": ("shown.html.j2", partial(_shown, "Readings")),
    "NextPoses": ("shown.html.j2", partial(_shown, "Next poses")),
}
