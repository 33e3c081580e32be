"""What results show in a notebook: HTML, figures and data frames (found by elastocal.above)."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from html import escape
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from elastocal.compensation.compensate import (
    Compensation,
    commands_csv,
    in_file_units,
    joint_columns,
    summary,
)
from elastocal.diagnosis.changes import Comparison
from elastocal.diagnosis.diagnosis import Diagnosis
from elastocal.errors import InputError
from elastocal.identification.result import Calibration, Estimate
from elastocal.model.effects import effect_of
from elastocal.planning.plan import Plan
from elastocal.report.causes_view import cause_rows, causes, field_rows, place_rows
from elastocal.report.changes_view import change_rows, changes_frame, changes_lines, draw_map
from elastocal.report.diagnosis_view import (
    diagnosis_lines,
    diagnosis_steps,
    error_steps,
    gap_rows,
    hypothesis_rows,
)
from elastocal.report.effect_names import effect_at, name_of
from elastocal.report.formatting import display, length, minus
from elastocal.report.identification_view import (
    combination_rows,
    leading_lines,
    parameter_rows,
    signed_half,
    summary_lines,
    texts,
)
from elastocal.report.plan_picture import COLOURS, STYLE, draw_plan, pose_lines
from elastocal.report.plan_view import first_stops, plan_lines
from elastocal.report.residual_view import residuals_of
from elastocal.report.terminal import (
    comparison_text,
    compensation_text,
    diagnosis_text,
    identification_text,
    plan_text,
)
from elastocal.text import cell_meaning, did_you_mean, listed, printable, quoted
from elastocal.units import Array

if TYPE_CHECKING:
    import pandas as pd

MOST_BARS = 40
MOST_TICKS = 20


def residuals(result: Calibration, interactive: bool) -> Any:
    """Residual of every reading (at most 5000) over its configuration, one panel a component."""
    found = residuals_of(result)
    panels = [f"{c} in {u}" for c, u in zip(found.components, found.units, strict=True)]
    rows = found.shown
    at_poses = list(range(0, len(found.labels), -(-len(found.labels) // MOST_TICKS)))
    names = [printable(found.labels[k]) for k in at_poses]
    hover = [
        f"configuration {printable(found.labels[found.pose[i]])}, marker "
        f"{printable(found.markers[found.marker[i]])}"
        for i in rows
    ]
    if interactive:
        import plotly.graph_objects as go
        from plotly.subplots import make_subplots

        figure = make_subplots(rows=len(panels), cols=1, shared_xaxes=True)
        for k, title in enumerate(panels):
            for m, name in enumerate(found.markers):
                at = np.flatnonzero(found.marker[rows] == m)
                figure.add_trace(
                    go.Scatter(
                        x=found.pose[rows[at]], y=found.value[rows[at], k], mode="markers",
                        marker={"color": COLOURS[m % len(COLOURS)], "size": 5},
                        name=_plain(name), legendgroup=str(m), showlegend=k == 0,
                        text=[_plain(hover[i]) for i in at], hovertemplate="%{text}: %{y:.1f}",
                    ),
                    row=k + 1, col=1,
                )  # fmt: skip
            figure.update_yaxes(title_text=title, row=k + 1, col=1)
        figure.update_xaxes(title_text="configuration", row=len(panels), col=1, tickvals=at_poses,
                            ticktext=[_plain(name) for name in names])  # fmt: skip
        return figure.update_layout(height=160 + 180 * len(panels), template="plotly_white")

    def draw(figure: Any) -> None:
        grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        for k, (axes, title) in enumerate(zip(grid, panels, strict=True)):
            axes.axhline(0, color="#7f7f7f", linewidth=0.8)
            for m, name in enumerate(found.markers):
                at = rows[found.marker[rows] == m]
                axes.plot(found.pose[at], found.value[at, k], ".", markersize=4,
                          color=COLOURS[m % len(COLOURS)], label=printable(name))  # fmt: skip
            axes.set_ylabel(title)
        grid[-1].set_xticks(at_poses, names)
        grid[-1].set_xlabel("configuration")
        if 1 < len(found.markers) <= 12:
            figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper right", ncols=6)

    return _figure(draw, (9.0, 0.8 + 1.5 * len(panels)))


def parameters(result: Calibration, interactive: bool) -> Any:
    """Deviation of each identified parameter from nominal with its 95 % interval, each on a scale
    of its own; the numbers stand with the names."""
    kept = [e for e in result.ordinary if e.value is not None and e.ci95 is not None]
    kept = [e for e in kept if np.isfinite(e.ci95).all()][:MOST_BARS]  # type: ignore[arg-type]
    nominal = np.array([e.nominal for e in kept])
    value = np.array([e.value for e in kept], dtype=float) - nominal
    ends = np.array([e.ci95 for e in kept], dtype=float).reshape(-1, 2) - nominal[:, None]
    reach = np.maximum(np.abs(ends).max(axis=1, initial=0.0), np.finfo(float).tiny)
    axis = "deviation from nominal, each over its own largest"
    return _bars([_with_numbers(e) for e in kept], value / reach, axis, interactive,
                 ends / reach[:, None])  # fmt: skip


def _with_numbers(e: Estimate) -> str:
    """ "joint2.compliance  2.10 ± 0.05 µrad/(N·m)"."""
    value, half, unit, _ = texts(e, None)
    return f"{e.name}  {value} {signed_half(half)} {unit}"


def intervals(plan: Plan, interactive: bool) -> Any:
    """Half widths of the 95 % intervals that the plan promises, over the largest of their unit."""
    shown = [display(p.half_width, p.unit) for p in plan.predicted[:MOST_BARS]]
    names = [f"{p.name} ({unit})" for p, (_, unit) in zip(plan.predicted, shown, strict=False)]
    value = np.array([v for v, _ in shown])
    return _bars(names, value, "half width of the 95 % interval", interactive, logarithmic=True)


def budget(d: Diagnosis, interactive: bool) -> Any:
    """The gap budget: held-out rms error after each step, with its 95 % interval, and the noise."""
    steps = error_steps(d)
    ends = np.array([s.ci95 for s in steps]).reshape(-1, 2) * 1e6
    names = [*(name_of(s.step) for s in steps), "noise alone"]
    value = np.array([*(s.heldout_rms for s in steps), d.gap.noise_floor]) * 1e6
    ends = np.vstack([ends, [np.nan, np.nan]])
    wide = bool((value > 0).all()) and value.max() > 8 * value.min()
    return _bars(names, value, "rms error on held-out poses in µm", interactive, ends, wide)


def candidates(d: Diagnosis, interactive: bool) -> Any:
    """Probabilities of the ten best candidates, of an unknown effect and of none."""
    best = d.candidates[:10]
    names = [*map(effect_at, best), "an effect outside the catalogue", "no further effect"]
    value = np.array([*(c.probability for c in best), d.probability_unknown, d.probability_nothing])
    return _bars(names, value, "probability", interactive)


def shares(d: Diagnosis, interactive: bool) -> Any:
    """What the gap is made of, where many causes act at once: each one's share with its 90 %
    interval."""
    found = causes(d)
    value = np.array([c.share for c in found]) * 100
    ends = np.array([c.share_ci90 for c in found]).reshape(-1, 2) * 100
    axis = "share of the gap in %"
    return _bars([c.name for c in found], value, axis, interactive, ends)


def errors(c: Compensation, interactive: bool) -> Any:
    """Predicted error at the nominal commands, of the rows that are reached."""
    return _of_targets(c, c.before, "error at the nominal command in µm", interactive)


def uncertainties(c: Compensation, interactive: bool) -> Any:
    """Standard uncertainty of the tool's position at the new commands, of the rows reached."""
    return _of_targets(c, c.uncertainty.std, "standard uncertainty in µm", interactive)


def _of_targets(c: Compensation, metres: Array, axis: str, interactive: bool) -> Any:
    rows = np.flatnonzero(c.reached)[:MOST_BARS]
    table = c.targets.table
    names = [table.configuration_labels[table.configuration[i]] for i in rows]
    return _bars(names, metres[rows] * 1e6, axis, interactive)


def poses(plan: Plan, interactive: bool) -> Any:
    """The arm in every pose; interactive: in space, to be turned."""
    cell, chain = plan.model.cell, plan.model.chain
    if not interactive:
        from matplotlib.style import context

        with context(["default", STYLE]):
            figure = draw_plan(
                cell, chain, plan.q, names=plan.configurations, group=plan.group,
                group_names=plan.group_names,
            )  # fmt: skip
        return _showing(figure)
    import plotly.graph_objects as go

    arms, markers = pose_lines(cell, chain, plan.q)
    figure = go.Figure()
    for k, name in enumerate(plan.configurations):
        colour = COLOURS[int(plan.group[k]) % len(COLOURS)]
        figure.add_trace(
            go.Scatter3d(
                x=arms[k, :, 0], y=arms[k, :, 1], z=arms[k, :, 2], mode="lines+markers",
                line={"color": colour, "width": 4}, marker={"size": 2, "color": colour},
                name=f"pose {name}",
            )
        )  # fmt: skip
        figure.add_trace(
            go.Scatter3d(
                x=markers[k, :, 0], y=markers[k, :, 1], z=markers[k, :, 2], mode="markers",
                marker={"size": 3, "color": colour, "symbol": "diamond"}, showlegend=False,
                text=[_plain(marker) for marker in cell.tool.markers], hoverinfo="text",
            )
        )  # fmt: skip
    tracker = cell.tracker.position
    figure.add_trace(
        go.Scatter3d(x=[tracker[0]], y=[tracker[1]], z=[tracker[2]], mode="markers",
                     marker={"size": 5, "color": "#1a1a1a"}, name="tracker")
    )  # fmt: skip
    axes = {f"{a}axis": {"title": {"text": f"{a} in m"}} for a in "xyz"}
    return figure.update_layout(scene={"aspectmode": "data", **axes}, height=640)


def _bars(
    names: Sequence[str], value: Array, axis: str, interactive: bool, ends: Array | None = None,
    logarithmic: bool = False,
) -> Any:  # fmt: skip
    """Dots at `value` (n,), with intervals to both `ends` (n, 2) where these are finite."""
    n = len(names)
    ends = np.full((n, 2), np.nan) if ends is None else ends
    below, above = np.abs(value[:, None] - ends).T
    if interactive:
        import plotly.graph_objects as go

        error = {"type": "data", "symmetric": False, "array": np.nan_to_num(above),
                 "arrayminus": np.nan_to_num(below)}  # fmt: skip
        figure = go.Figure(
            go.Scatter(x=value, y=[_plain(name) for name in names], mode="markers",
                       marker={"color": COLOURS[0], "size": 9}, error_x=error)
        )  # fmt: skip
        figure.update_xaxes(title_text=axis, type="log" if logarithmic else "linear")
        figure.update_yaxes(autorange="reversed")
        return figure.update_layout(height=140 + 28 * n, template="plotly_white")

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        at = np.arange(n)
        widths = np.nan_to_num(np.vstack([below, above]))
        axes.errorbar(value, at, xerr=widths, fmt="o", color=COLOURS[0], elinewidth=1.6)
        axes.set_yticks(at, [_axis_label(printable(name)) for name in names])
        axes.set_ylim(n - 0.4, -0.6)
        axes.margins(x=0.06)
        if logarithmic:
            axes.set_xscale("log")
        elif not (value < 0).any():
            axes.set_xlim(left=min(0.0, *np.nan_to_num(ends[:, 0])) if n else 0.0)
        axes.set_xlabel(axis)
        axes.grid(axis="x")

    return _figure(draw, (8.0, 0.9 + 0.32 * max(n, 1)))


def _figure(draw: Any, size: tuple[float, float]) -> Any:
    """A matplotlib Figure that shows itself in a notebook and belongs to no global state."""
    from matplotlib.figure import Figure
    from matplotlib.style import context

    with context(["default", STYLE]):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
    return _showing(figure)


def _showing(figure: Any) -> Any:
    """The figure, which a notebook can show although pyplot, whose hooks do so, is not loaded."""
    figure._repr_png_ = partial(_png, figure)
    return figure


def _png(figure: Any) -> bytes:
    picture = BytesIO()
    figure.savefig(picture, format="png", dpi=100)
    return picture.getvalue()


def _axis_label(name: str, most: int = 64) -> str:
    return name if len(name) <= most else name[: most - 1] + "…"


def _plain(name: str) -> str:
    """A name for plotly, which reads some HTML in its texts."""
    text = _axis_label(printable(name))
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


MOST_ROWS = 60
MOST_CANDIDATES_SHOWN = 8
Drawn = Callable[[Any, bool], Any]


@dataclass(frozen=True)
class View:
    """How one kind of result shows itself; `figures` by kind, the first is the default."""

    text: Callable[[Any], str]
    html: Callable[[Any], str]
    frame: Callable[[Any], pd.DataFrame]
    figures: Mapping[str, Drawn]

    def plot(
        self, result: Any, kind: str | None, interactive: bool,
        of_page: Callable[[], Mapping[str, Any]] = dict,
    ) -> Any:  # fmt: skip
        """The figure `kind`: one of these, or one `of_page`, by name, which stand still.

        Raises InputError for a kind that the result does not have.
        """
        chosen = next(iter(self.figures)) if kind is None else kind
        if chosen in self.figures:
            return self.figures[chosen](result, interactive)
        found = of_page()
        if chosen not in found:
            every = [*self.figures, *(name for name in found if name not in self.figures)]
            hint = did_you_mean(chosen, every)
            raise InputError(f"no figure {quoted(chosen)}{hint}; there are {listed(every)}")
        return _showing(found[chosen])


def view_of(result: object) -> View:
    """The view of a result's type; TypeError for a type without one, a mistake of the program."""
    for kind, view in VIEWS.items():
        if isinstance(result, kind):
            return view
    raise TypeError(type(result).__name__)


def _identification_html(result: Calibration) -> str:
    known = [row for row in parameter_rows(result, None) if row.determined]
    rows = [
        (r.name if r.effect else minus(r.name), minus(r.value), minus(r.interval), r.unit,
         minus(r.nominal))
        for r in (*known, *combination_rows(result, None))
    ]  # fmt: skip
    heads = ("parameter", "value", "95 %", "unit", "nominal")
    table = _table("Identification", heads, rows)
    return _lines(leading_lines(result)) + table + _lines(summary_lines(result))


def _plan_html(plan: Plan) -> str:
    frame = _plan_frame(plan)
    rows = [tuple(_short(v) for v in row) for row in frame.itertuples(index=False)]
    return _table("Measurement plan", list(frame.columns), rows) + _lines(plan_lines(plan))


def _diagnosis_html(d: Diagnosis) -> str:
    tables = {
        "What the gap is made of": cause_rows(d),
        "Place by place": place_rows(d),
        "Corrections without a name": field_rows(d),
        "Gap budget (3-D rms error on held-out poses)": gap_rows(d),
    }
    if not d.groups:
        tables["Candidates"] = hypothesis_rows(d, MOST_CANDIDATES_SHOWN)
    lines = _lines(diagnosis_lines(d) + [("Next", step) for step in diagnosis_steps(d)])
    return lines + "".join(_table(title, t.heads, t.rows) for title, t in tables.items() if t.rows)


def _compensation_html(c: Compensation) -> str:
    told = summary(c, c.chain.kinds, commands=False)
    rows = [
        (name, *("–" if v is None else length(v * 1e-6) for v in told[key].values()))
        for name, key in (
            ("nominal command", "error_before_um"),
            ("new command", "error_after_um"),
            ("standard uncertainty", "std_um"),
            ("within, at 95 %", "within95_um"),
        )
    ]
    frame = _commands(c)
    chosen = ["configuration", *joint_columns(c.chain.kinds), "std_um", "status"]
    commands = [
        tuple("" if v != v else _short(v) for v in row)
        for row in frame[chosen].itertuples(index=False)
    ]
    reached = f"{told['reached']} of {told['n']} targets reached by the {told['point']}"
    lines = [("Reached", f"{reached}; targets in the {told['frame']} frame.")]
    return (
        _lines([*lines, *(("Warning", text) for text in c.warnings)])
        + _table("Position of the tool, predicted", ("", "rms", "95 %", "max"), rows)
        + _table("Commands", chosen, commands)
    )


def _short(value: object) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def _table(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose every cell is escaped; the first MOST_ROWS rows."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>"
        for row in rows[:MOST_ROWS]
    )
    more = f"<p>… and {len(rows) - MOST_ROWS} more rows</p>" if len(rows) > MOST_ROWS else ""
    return (
        f"<table><caption>{escape(title)}</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>{body}</tbody></table>{more}"
    )


def _lines(lines: Sequence[tuple[str, str]]) -> str:
    return "".join(f"<p><b>{escape(label)}:</b> {escape(text)}</p>" for label, text in lines)


def _estimates(result: Calibration) -> pd.DataFrame:
    """One row per parameter, SI units: NaN where the data do not determine it alone."""
    import pandas as pd

    rows = [
        {
            "parameter": e.name,
            "unit": e.unit,
            "value": e.value,
            "std": e.std,
            "ci95_low": None if e.ci95 is None else e.ci95[0],
            "ci95_high": None if e.ci95 is None else e.ci95[1],
            "nominal": e.nominal,
            "held": e.held,
            "identifiable": e.identifiable,
            "combined_with": ", ".join(e.combined_with),
            "note": e.note,
        }
        for e in result.estimates
    ]
    frame = pd.DataFrame(rows)
    numbers = ["value", "std", "ci95_low", "ci95_high", "nominal", "held"]
    return frame.astype(dict.fromkeys(numbers, float))


def _plan_frame(plan: Plan) -> pd.DataFrame:
    """One row per pose: joints in ° or mm, place in the order, and the load where it states one."""
    import pandas as pd

    columns: dict[str, Any] = {"configuration": list(plan.configurations)}
    kinds = plan.model.chain.kinds
    columns |= dict(zip(joint_columns(kinds), in_file_units(plan.q, kinds).T, strict=True))
    if plan.level_joint is not None:
        columns["level"] = plan.group + 1
    order = first_stops(plan)
    columns["order"] = [order.get(k) for k in range(len(plan.q))]
    if (plan.load >= 0).any():
        for k, axis in enumerate("xyz"):
            columns[f"force_{axis}_N"] = plan.forces[plan.load, k]
    return pd.DataFrame(columns)


def _candidates(d: Diagnosis) -> pd.DataFrame:
    """One row per hypothesis, best first; whether it is held to be real; `score` in nats.

    What was found only where all causes are judged together comes first, without a score.
    """
    import pandas as pd

    found = {(f.effect, f.where): f for f in d.effects}
    tried = {(c.effect, c.where) for c in d.candidates}
    rows = [
        {
            "effect": f.effect, "where": f.where, "stage": effect_of(f.effect).stage,
            "probability": f.probability, "score": np.nan, "detectable": np.nan, "found": True,
            "gap_reduction": f.gap_reduction,
        }
        for key, f in found.items() if key not in tried
    ]  # fmt: skip
    for c in d.candidates:
        f = found.get((c.effect, c.where))
        rows.append(
            {
                "effect": c.effect, "where": c.where, "stage": c.stage,
                "probability": c.probability, "score": c.score, "detectable": c.detectable,
                "found": f is not None,
                "gap_reduction": np.nan if f is None else f.gap_reduction,
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def _commands(c: Compensation) -> pd.DataFrame:
    """One row per target: the columns of the commands file, NaN where a target is not reached."""
    import pandas as pd

    text = io.StringIO(commands_csv(c, c.chain.kinds))
    frame = pd.read_csv(text, dtype={"configuration": str}, keep_default_na=False, na_values=[""])
    if "configuration" in frame:
        frame["configuration"] = frame["configuration"].map(cell_meaning, na_action="ignore")
    return frame


def _comparison_html(c: Comparison) -> str:
    shown = change_rows(c)
    return _lines(changes_lines(c)) + _table("Parameter by parameter", shown.heads, shown.rows)


def moved(c: Comparison, interactive: bool) -> Any:
    """How far the tool has moved over the workspace, from above and from the side."""
    from matplotlib.figure import Figure

    if interactive:
        import plotly.graph_objects as go

        x, y, z = c.place.T
        marks = go.Scatter3d(
            x=x, y=y, z=z, mode="markers", hovertext=[length(float(v)) for v in c.distance],
            marker={"color": c.distance * 1e6, "size": 4, "colorbar": {"title": "µm"}},
        )  # fmt: skip
        return go.Figure(marks)
    figure = Figure(figsize=(8, 4), layout="constrained")
    draw_map(figure, c, "C0", "0.4")
    return figure


VIEWS: dict[type, View] = {
    Comparison: View(comparison_text, _comparison_html, changes_frame, {"moved": moved}),
    Calibration: View(
        identification_text,
        _identification_html,
        _estimates,
        {"residuals": residuals, "parameters": parameters},
    ),
    Plan: View(plan_text, _plan_html, _plan_frame, {"poses": poses, "intervals": intervals}),
    Compensation: View(
        compensation_text,
        _compensation_html,
        _commands,
        {"errors": errors, "uncertainty": uncertainties},
    ),
    Diagnosis: View(
        diagnosis_text,
        _diagnosis_html,
        _candidates,
        {"budget": budget, "candidates": candidates, "shares": shares},
    ),
}
