"""Figures of results for notebooks, by matplotlib, or by plotly to turn and zoom."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.compensation.compensate import Compensation
from elastocal.design.plan import Plan
from elastocal.diagnosis.result import Diagnosis
from elastocal.identification.result import Calibration
from elastocal.report.diagnosis_rows import error_steps
from elastocal.report.diagnosis_words import effect_at, name_of
from elastocal.report.plan_picture import COLOURS, STYLE, draw_plan, pose_lines
from elastocal.report.residuals import residuals_of
from elastocal.report.units import display
from elastocal.report.words import printable

Array = NDArray[np.float64]
MOST_BARS = 40


@dataclass(frozen=True)
class Bars:
    """Horizontal intervals: `value`, and `low` to `high` where they are finite."""

    names: tuple[str, ...]
    value: Array
    low: Array
    high: Array
    axis: str


def residuals(result: Calibration, interactive: bool) -> Any:
    """Residual of every reading (at most 5000) over its configuration, one panel a component."""
    found = residuals_of(result)
    panels = [f"{c} in {u}" for c, u in zip(found.components, found.units, strict=True)]
    rows = found.shown
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
        figure.update_xaxes(title_text="configuration", row=len(panels), col=1)
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
        grid[-1].set_xlabel("configuration")
        if 1 < len(found.markers) <= 12:
            figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper right", ncols=6)

    return _figure(draw, (9.0, 0.8 + 1.5 * len(panels)))


def parameters(result: Calibration, interactive: bool) -> Any:
    """Deviation of each identified parameter from nominal in units of its 95 % half width."""
    kept = [e for e in result.estimates if e.value is not None and e.ci95 is not None]
    kept = [e for e in kept if np.isfinite(e.ci95).all()][:MOST_BARS]  # type: ignore[arg-type]
    value = np.array([e.value - e.nominal for e in kept if e.value is not None])
    ends = np.array([e.ci95 for e in kept], dtype=float).reshape(-1, 2)
    nominal = np.array([e.nominal for e in kept])
    half = np.maximum((ends[:, 1] - ends[:, 0]) / 2, np.finfo(float).tiny)
    bars = Bars(
        tuple(e.name for e in kept), value / half, (ends[:, 0] - nominal) / half,
        (ends[:, 1] - nominal) / half,
        "deviation from nominal, in half widths of the 95 % interval",
    )  # fmt: skip
    return _bars(bars, interactive)


def intervals(plan: Plan, interactive: bool) -> Any:
    """Half widths of the 95 % intervals that the plan promises, over the largest of their unit."""
    shown = [display(p.half_width, p.unit) for p in plan.predicted[:MOST_BARS]]
    names = [f"{p.name} ({unit})" for p, (_, unit) in zip(plan.predicted, shown, strict=False)]
    value = np.array([v for v, _ in shown])
    nothing = np.full(len(value), np.nan)
    return _bars(
        Bars(tuple(names), value, nothing, nothing, "half width of the 95 % interval"), interactive,
        logarithmic=True,
    )  # fmt: skip


def budget(d: Diagnosis, interactive: bool) -> Any:
    """The gap budget: held-out rms error after each step, with its 95 % interval, and the noise."""
    steps = error_steps(d)
    ends = np.array([s.ci95 for s in steps]).reshape(-1, 2) * 1e6
    names = [*(name_of(s.step) for s in steps), "noise alone"]
    value = np.array([*(s.heldout_rms for s in steps), d.gap.noise_floor]) * 1e6
    low, high = (np.append(ends[:, k], np.nan) for k in (0, 1))
    positive = bool((value > 0).all())
    bars = Bars(tuple(names), value, low, high, "rms error on held-out poses in µm")
    return _bars(bars, interactive, logarithmic=positive and value.max() > 8 * value.min())


def candidates(d: Diagnosis, interactive: bool) -> Any:
    """Probabilities of the ten best candidates, of an unknown effect and of none."""
    best = d.candidates[:10]
    names = [*map(effect_at, best), "an effect outside the catalogue", "no further effect"]
    value = np.array([*(c.probability for c in best), d.probability_unknown, d.probability_nothing])
    nothing = np.full(len(value), np.nan)
    return _bars(Bars(tuple(names), value, nothing, nothing, "probability"), interactive)


def errors(c: Compensation, interactive: bool) -> Any:
    """Predicted error at the nominal commands, of the rows that are reached."""
    return _of_targets(c, c.before, "error at the nominal command in µm", interactive)


def uncertainties(c: Compensation, interactive: bool) -> Any:
    """Standard uncertainty of the tool's position at the new commands, of the rows reached."""
    return _of_targets(c, c.uncertainty.std, "standard uncertainty in µm", interactive)


def _of_targets(c: Compensation, metres: Array, axis: str, interactive: bool) -> Any:
    rows = np.flatnonzero(c.reached)[:MOST_BARS]
    table = c.targets.table
    names = tuple(table.configuration_labels[table.configuration[i]] for i in rows)
    nothing = np.full(len(rows), np.nan)
    return _bars(Bars(names, metres[rows] * 1e6, nothing, nothing, axis), interactive)


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


def _bars(bars: Bars, interactive: bool, logarithmic: bool = False) -> Any:
    n = len(bars.names)
    below, above = (np.abs(bars.value - end) for end in (bars.low, bars.high))
    if interactive:
        import plotly.graph_objects as go

        error = {"type": "data", "symmetric": False, "array": np.nan_to_num(above),
                 "arrayminus": np.nan_to_num(below)}  # fmt: skip
        figure = go.Figure(
            go.Scatter(x=bars.value, y=[_plain(name) for name in bars.names], mode="markers",
                       marker={"color": COLOURS[0], "size": 9}, error_x=error)
        )  # fmt: skip
        figure.update_xaxes(title_text=bars.axis, type="log" if logarithmic else "linear")
        figure.update_yaxes(autorange="reversed")
        return figure.update_layout(height=140 + 28 * n, template="plotly_white")

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        at = np.arange(n)
        widths = np.nan_to_num(np.vstack([below, above]))
        axes.errorbar(bars.value, at, xerr=widths, fmt="o", color=COLOURS[0], elinewidth=1.6)
        axes.set_yticks(at, [_short(printable(name)) for name in bars.names])
        axes.set_ylim(n - 0.4, -0.6)
        if logarithmic:
            axes.set_xscale("log")
        elif not (bars.value < 0).any():
            axes.set_xlim(left=min(0.0, *np.nan_to_num(bars.low)) if n else 0.0)
        axes.set_xlabel(bars.axis)
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


def _short(name: str, most: int = 44) -> str:
    return name if len(name) <= most else name[: most - 1] + "…"


def _plain(name: str) -> str:
    """A name for plotly, which reads some HTML in its texts."""
    text = _short(printable(name))
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
