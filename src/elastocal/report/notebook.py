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
from rich.table import Table
from rich.text import Text

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
from elastocal.model.effects.catalogue import effect_of
from elastocal.planning.plan import Plan
from elastocal.report.arm_view import plan_figure, plan_space
from elastocal.report.causes_view import causes
from elastocal.report.changes_view import changes_frame, draw_map
from elastocal.report.diagnosis_terminal import print_comparison, print_diagnosis
from elastocal.report.diagnosis_view import error_steps
from elastocal.report.effect_names import effect_at, name_of
from elastocal.report.figures import SERIES, as_figures, drawn
from elastocal.report.formatting import ShownTable, display, length, minus, short_name
from elastocal.report.identification_view import signed_half, texts
from elastocal.report.plan_terminal import print_next, print_plan
from elastocal.report.plan_view import first_stops
from elastocal.report.residual_figures import by_configuration
from elastocal.report.residual_view import residuals_of
from elastocal.report.terminal import (
    print_compensation,
    print_result,
    printed_text,
    table_of,
)
from elastocal.text import cell_meaning, did_you_mean, listed, printable, quoted
from elastocal.units import Array

if TYPE_CHECKING:
    import pandas as pd

    from elastocal.diagnosis.next_poses import NextPoses
    from elastocal.measurements import Measurements

MOST_BARS = 40
MOST_TICKS = 20
LONGEST_NAME = 64


def residuals(result: Calibration, interactive: bool) -> Any:
    """Residual of every reading (at most 5000) over its configuration, one panel a component."""
    found = residuals_of(result)
    if not interactive:
        with as_figures():
            return _showing(by_configuration(found))
    import plotly.graph_objects as go
    from plotly.subplots import make_subplots

    panels = [f"{c} in {u}" for c, u in zip(found.components, found.units, strict=True)]
    rows = found.shown
    at_poses = list(range(0, len(found.labels), -(-len(found.labels) // MOST_TICKS)))
    names = [printable(found.labels[k]) for k in at_poses]
    hover = [
        f"configuration {printable(found.labels[found.pose[i]])}, marker "
        f"{printable(found.markers[found.marker[i]])}"
        for i in rows
    ]
    figure = make_subplots(rows=len(panels), cols=1, shared_xaxes=True)
    for k, title in enumerate(panels):
        for m, name in enumerate(found.markers):
            at = np.flatnonzero(found.marker[rows] == m)
            figure.add_trace(
                go.Scatter(
                    x=found.pose[rows[at]], y=found.value[rows[at], k], mode="markers",
                    marker={"color": SERIES[m % len(SERIES)], "size": 5},
                    name=_plain(name), legendgroup=str(m), showlegend=k == 0,
                    text=[_plain(hover[i]) for i in at], hovertemplate="%{text}: %{y:.1f}",
                ),
                row=k + 1, col=1,
            )  # fmt: skip
        figure.update_yaxes(title_text=title, row=k + 1, col=1)
    figure.update_xaxes(title_text="configuration", row=len(panels), col=1, tickvals=at_poses,
                        ticktext=[_plain(name) for name in names])  # fmt: skip
    return figure.update_layout(height=160 + 180 * len(panels), template="plotly_white")


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


def gain(found: NextPoses, interactive: bool) -> Any:
    """The error at the test poses before and after the batch; none where it is not known yet."""
    g = found.gain
    value = np.array([g.before, g.after, g.model_before, g.model_after]) * 1e6
    names = ["measured so far", "with this batch"]
    names += [f"{name}, were the model right" for name in names]
    axis = "rms error at the test poses in µm"
    return _bars(names, np.where(np.isfinite(value), value, np.nan), axis, interactive)


def doubts(found: NextPoses, interactive: bool) -> Any:
    """Probability of each effect that the model may lack."""
    some = found.doubts[:MOST_BARS]
    names = [f"{name_of(effect)} at {where}" for effect, where, _ in some]
    return _bars(names, np.array([p for *_, p in some]), "probability", interactive)


def joints(table: Measurements, interactive: bool) -> Any:
    """Where each joint stood, in the middle of its range and from end to end."""
    q = in_file_units(table.q, table.kinds)
    ends = np.column_stack([q.min(axis=0), q.max(axis=0)]) if len(q) else np.zeros((q.shape[1], 2))
    axis = "middle and ends of the values, in ° or mm"
    return _bars(joint_columns(table.kinds), ends.mean(axis=1), axis, interactive, ends)


def poses(plan: Plan, interactive: bool) -> Any:
    """The arm in every pose; interactive: in space, to be turned."""
    if not interactive:
        return _showing(plan_figure(plan))
    import plotly.graph_objects as go

    figure = go.Figure()
    for pose in plan_space(plan).poses:
        colour = SERIES[pose.group % len(SERIES)]
        for points, how in (
            (pose.line, {
                "mode": "lines+markers", "line": {"color": colour, "width": 4},
                "marker": {"size": 2, "color": colour}, "name": f"pose {pose.name}",
            }),
            (pose.markers, {
                "mode": "markers", "marker": {"size": 3, "color": colour, "symbol": "diamond"},
                "showlegend": False, "text": [*map(_plain, pose.names)], "hoverinfo": "text",
            }),
        ):  # fmt: skip
            x, y, z = points.T
            figure.add_trace(go.Scatter3d(x=x, y=y, z=z, **how))
    tracker = plan.model.cell.tracker.position
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
                       marker={"color": SERIES[0], "size": 9}, error_x=error)
        )  # fmt: skip
        figure.update_xaxes(title_text=axis, type="log" if logarithmic else "linear")
        figure.update_yaxes(autorange="reversed")
        return figure.update_layout(height=140 + 28 * n, template="plotly_white")

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        at = np.arange(n)
        widths = np.nan_to_num(np.vstack([below, above]))
        axes.errorbar(value, at, xerr=widths, fmt="o", color=SERIES[0], elinewidth=1.6)
        axes.set_yticks(at, [short_name(name, LONGEST_NAME) for name in names])
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
    with as_figures():
        return _showing(drawn(draw, *size, ""))


def _showing(figure: Any) -> Any:
    """The figure, which a notebook can show although pyplot, whose hooks do so, is not loaded."""
    figure._repr_png_ = partial(_png, figure)
    return figure


def _instead(ax: Any) -> Any:
    """A part of the figure in the place of these axes."""
    spot = getattr(ax, "get_subplotspec", lambda: None)()
    if spot is None:
        raise InputError("`ax` takes axes that plt.subplots or Figure.subplots made")
    ax.remove()
    return spot.get_gridspec().figure.add_subfigure(spot)


def _png(figure: Any) -> bytes:
    picture = BytesIO()
    figure.savefig(picture, format="png", dpi=100, facecolor="white")
    return picture.getvalue()


def _plain(name: str) -> str:
    """A name for plotly, which reads some HTML in its texts."""
    return escape(short_name(name, LONGEST_NAME), quote=False)


MOST_ROWS = 60
Drawn = Callable[[Any, bool], Any]


@dataclass(frozen=True)
class View:
    """How one kind of result shows itself: `show` prints it on a console; `figures` by kind, the
    first is the default."""

    show: Callable[[Any, Any], None]
    frame: Callable[[Any], pd.DataFrame]
    figures: Mapping[str, Drawn]

    def text(self, result: Any) -> str:
        """What the command line prints."""
        return printed_text(self.show, result)

    def html(self, result: Any) -> str:
        """The same as HTML."""
        console = HtmlConsole()
        self.show(console, result)
        return "".join(console.parts)

    def plot(
        self, result: Any, kind: str | None, interactive: bool,
        of_page: Callable[[], Mapping[str, Any]] = dict, ax: Any = None,
    ) -> Any:  # fmt: skip
        """The figure `kind`: one of these, in the place of `ax` where that is given, or one
        `of_page`, by name, which stand still.

        Raises InputError for a kind that the result does not have.
        """
        chosen = next(iter(self.figures)) if kind is None else kind
        if chosen in self.figures and ax is None:
            return self.figures[chosen](result, interactive)
        if chosen in self.figures:
            with as_figures(_instead(ax)):
                return self.figures[chosen](result, False)
        found = of_page() if ax is None else {}
        if chosen not in found:
            every = [*self.figures, *(name for name in found if name not in self.figures)]
            hint = did_you_mean(chosen, every)
            raise InputError(f"no figure {quoted(chosen)}{hint}; there are {listed(every)}")
        return _showing(found[chosen])


def view_of(result: object) -> View:
    """The view of a result's type; TypeError for a type without one, a mistake of the program."""
    name = type(result).__name__
    if name not in VIEWS:
        raise TypeError(name)
    return VIEWS[name]


class HtmlConsole:
    """What is printed for a terminal of any width as HTML; every text is escaped."""

    width = 200

    def __init__(self) -> None:
        self.parts: list[str] = []

    def print(self, what: Any = "", **_: Any) -> None:
        """Add a table, its first MOST_ROWS rows, or a paragraph."""
        if isinstance(what, Table):
            self.parts.append(_html_table(what))
        elif text := str(what).strip():
            label = what.spans[0].end if isinstance(what, Text) and what.spans else 0
            first, rest = _readable(text[:label].strip()), _readable(text[label:])
            self.parts.append(f"<p><b>{first}</b> {rest}</p>" if label else f"<p>{rest}</p>")


def _readable(text: str) -> str:
    return escape(printable(text))


def _html_table(table: Table) -> str:
    head = "".join(f"<th>{_readable(str(column.header))}</th>" for column in table.columns)
    columns = [
        [minus(str(cell)) if column.justify == "right" else str(cell) for cell in column.cells]
        for column in table.columns
    ]
    rows = list(zip(*columns, strict=True))
    body = "".join(
        f"<tr>{''.join(f'<td>{_readable(cell)}</td>' for cell in row)}</tr>"
        for row in rows[:MOST_ROWS]
    )
    more = f"<p>… and {len(rows) - MOST_ROWS} more rows</p>" if len(rows) > MOST_ROWS else ""
    title = _readable(str(table.title or ""))
    return (
        f"<table><caption>{title}</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>{body}</tbody></table>{more}"
    )


def _show_readings(console: Any, table: Measurements) -> None:
    """What it has of each column: labels are counted, numbers from the least to the largest."""
    rows = [
        (name, str(len(np.unique(values.astype(str)))), "", "")
        if values.dtype == object
        else (name, str(len(np.unique(values))), f"{values.min():.6g}", f"{values.max():.6g}")
        for name, values in table.columns().items() if len(values)
    ]  # fmt: skip
    heads = ("column", "different", "least", "largest")
    title = f"{len(table)} rows of {printable(table.source)}"
    console.print(table_of(title, ShownTable(heads, rows, (0,))))


def _show_compensation(console: Any, c: Compensation) -> None:
    """Errors before and after, and what could not be reached; as HTML the commands too."""
    print_compensation(console, {"commands": summary(c, c.chain.kinds, commands=False)})
    if isinstance(console, HtmlConsole):
        chosen = ["configuration", *joint_columns(c.chain.kinds), "std_um", "status"]
        rows = [
            tuple("" if v != v else f"{v:.2f}" if isinstance(v, float) else str(v) for v in row)
            for row in _commands(c)[chosen].itertuples(index=False)
        ]
        words = (0, len(chosen) - 1)
        console.print(table_of("Commands", ShownTable(tuple(chosen), rows, words)))


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


def _next_frame(found: NextPoses) -> pd.DataFrame:
    """The poses, as of a plan; empty where none are needed."""
    import pandas as pd

    return pd.DataFrame() if found.plan is None else _plan_frame(found.plan)


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


def moved(c: Comparison, interactive: bool) -> Any:
    """How far the tool has moved over the workspace, from above and from the side."""
    if interactive:
        import plotly.graph_objects as go

        x, y, z = c.place.T
        marks = go.Scatter3d(
            x=x, y=y, z=z, mode="markers", hovertext=[length(float(v)) for v in c.distance],
            marker={"color": c.distance * 1e6, "size": 4, "colorbar": {"title": "µm"}},
        )  # fmt: skip
        return go.Figure(marks)
    return _figure(lambda figure: draw_map(figure, c), (8.0, 4.0))


VIEWS: dict[str, View] = {
    "Measurements": View(_show_readings, lambda t: t.to_dataframe(), {"joints": joints}),
    "NextPoses": View(print_next, _next_frame, {"gain": gain, "doubts": doubts}),
    "Comparison": View(print_comparison, changes_frame, {"moved": moved}),
    "Calibration": View(
        partial(print_result, details=True),
        _estimates,
        {"residuals": residuals, "parameters": parameters},
    ),
    "Plan": View(print_plan, _plan_frame, {"poses": poses, "intervals": intervals}),
    "Compensation": View(
        _show_compensation, _commands, {"errors": errors, "uncertainty": uncertainties}
    ),
    "Diagnosis": View(
        print_diagnosis,
        _candidates,
        {"budget": budget, "candidates": candidates, "shares": shares},
    ),
}
