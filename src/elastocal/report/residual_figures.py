"""The figures of the identification report, each an SVG element."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from elastocal.errors import ElastocalError
from elastocal.identification.error_budget import ErrorBudget
from elastocal.identification.prediction import over_the_workspace
from elastocal.identification.residuals import GroupSummary, ResidualSummary
from elastocal.identification.result import Calibration
from elastocal.identification.smooth_part import SmoothPart
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.model.rigid import nominal_flanges
from elastocal.report.arm_view import Space, space_picture
from elastocal.report.figures import (
    FAINT,
    INK,
    SERIES,
    dots,
    drawn,
    micrometre_axis,
    panels_of,
    waterfall_of_steps,
)
from elastocal.report.formatting import display, length, short_name, significant
from elastocal.report.identification_view import before_and_after, budget_steps, rms_by_kind
from elastocal.report.residual_view import Residuals, reach, rms_by_pose, running_mean
from elastocal.text import printable
from elastocal.units import Array, IntArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 9.9
MOST_LABELS = 30
MOST_SMOOTH = 24  # smooth functions
MOST_JOINT_DOTS = 2000  # per joint; the running mean uses every reading


def by_configuration(residuals: Residuals) -> str:
    """Residual of every reading over its configuration, a panel per direction."""
    n = len(residuals.components)

    def draw(figure: Figure) -> None:
        panels = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
        for k, axes in enumerate(panels):
            _configuration_panel(axes, residuals, k)
        panels[-1].set_xlabel("configuration")
        every = range(0, len(residuals.labels), -(-len(residuals.labels) // MOST_LABELS))
        names = [short_name(residuals.labels[i]) for i in every]
        turn = 90 if max(map(len, names)) > 3 else 0
        panels[-1].set_xticks(list(every), names, rotation=turn)
        if 1 < len(residuals.markers) <= len(SERIES):
            figure.legend(
                *panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=6
            )

    return drawn(draw, WIDTH, 0.6 + 1.5 * n, "Residuals by configuration, marker and direction")


def _configuration_panel(axes: Axes, residuals: Residuals, k: int) -> None:
    many = len(residuals.markers)
    values = residuals.value[:, k]
    size = 2.6 if len(residuals.shown) <= 1500 else 1.6
    shift = 0.6 * (np.arange(many) - (many - 1) / 2) / many
    axes.axhline(0, color=FAINT, linewidth=0.8)
    if many > len(SERIES):
        at = residuals.shown
        x = residuals.pose[at] + shift[residuals.marker[at]]
        dots(axes, x, values[at], SERIES[0], size)
    else:
        for m, name in enumerate(residuals.markers):
            at = residuals.shown[residuals.marker[residuals.shown] == m]
            dots(axes, residuals.pose[at] + shift[m], values[at], SERIES[m], size, short_name(name))
    axes.grid(axis="x", visible=False)
    axes.set_xlim(-0.7, len(residuals.labels) - 0.3)
    axes.set_ylabel(f"{residuals.components[k]} in {residuals.units[k]}")
    alike = [i for i, unit in enumerate(residuals.units) if unit == residuals.units[k]]
    _limit(axes, values, reach(residuals.value[:, alike]))


def against_joints(kinds: Sequence[str], residuals: Residuals) -> str:
    """Residual over the position of each joint, of `kinds`, with the running mean by direction."""
    rows = -(-len(kinds) // 3)
    n = residuals.positions
    shown = residuals.shown
    if len(shown) * n > MOST_JOINT_DOTS:
        shown = np.random.default_rng(0).choice(shown, MOST_JOINT_DOTS // n, replace=False)

    def draw(figure: Figure) -> None:
        panels = panels_of(figure, len(kinds), min(3, len(kinds)), sharey=True)
        for j, (axes, kind) in enumerate(zip(panels, kinds, strict=True)):
            q = np.degrees(residuals.q[:, j]) if kind == "revolute" else residuals.q[:, j] * 1e3
            _over(axes, q, residuals, shown, 1.3)
            axes.set_xlabel(f"joint {j + 1} in {'°' if kind == 'revolute' else 'mm'}")
        figure.supylabel("residual in µm", fontsize=9)
        handles = panels[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside upper right", ncols=n)

    return drawn(draw, WIDTH, 0.4 + 2.0 * rows, "Residuals against joint positions")


def _over(
    axes: Axes, x: Array, residuals: Residuals, shown: IntArray, size: float,
    styles: Sequence[str] = ("-",),
) -> None:  # fmt: skip
    """Residuals of positions over x (observations,): dots of the `shown`, running means of all."""
    values = residuals.value[:, : residuals.positions]
    axes.axhline(0, color=FAINT, linewidth=0.8)
    for k, own in enumerate(values.T):
        dots(axes, x[shown], own[shown], SERIES[k], size)
    for k, own in enumerate(values.T):
        middle, mean, error = running_mean(x, own)
        axes.errorbar(middle, mean, 2 * error, color=SERIES[k], linewidth=1.4, elinewidth=0.8,
                      linestyle=styles[k % len(styles)],
                      label=residuals.components[k])  # fmt: skip
    height = reach(values)
    axes.set_ylim(-height, height)


def errors(result: Calibration) -> str:
    """Nominal, fitted, held-out and test rms on one axis, logarithmic where they differ much."""
    rows = [(name, v) for name, v in rms_by_kind(result) if np.isfinite(v) and v > 0]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for k, (name, v) in enumerate(rows):
            colour = SERIES[0] if name.startswith("nominal") else SERIES[1]
            axes.plot([v * 1e6], [-k], "o", color=colour, markersize=8)
            axes.annotate(length(v), (v * 1e6, -k), (0, 7), textcoords="offset points", ha="center")
        names = [name.replace(" (", "\n(") for name, _ in rows]
        axes.set_yticks([-k for k in range(len(rows))], names)
        axes.set_ylim(0.6 - len(rows), 0.7)
        sizes = [v for _, v in rows]
        if max(sizes, default=1.0) > 8 * min(sizes, default=1.0):
            axes.set_xscale("log")
            axes.margins(x=0.25)
        else:
            axes.set_xlim(0, 1.25e6 * max(sizes, default=1.0))
        micrometre_axis(axes, "rms error")

    return drawn(draw, WIDTH / 2, 2.9, "Nominal, fitted, held-out and test error")


def before_after(found: dict[str, Array]) -> str:
    """Histograms of error lengths (n,) in m by name, on one logarithmic axis."""
    every = np.maximum(np.concatenate(list(found.values())) * 1e6, 1e-6)
    low, high = np.quantile(every, 0.005), 1.001 * every.max()
    edges = np.geomspace(min(low, high / 2), high, 31)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for k, (name, e) in enumerate(found.items()):
            counts = np.histogram(np.clip(e * 1e6, edges[0], None), edges)[0] / len(e)
            axes.stairs(counts, edges, fill=True, color=SERIES[k], alpha=0.35)
            axes.stairs(counts, edges, color=SERIES[k], linewidth=1.4, label=name,
                        linestyle=("-", "--", ":")[k % 3])  # fmt: skip
        axes.set_xscale("log")
        micrometre_axis(axes, "length of the error")
        axes.set_ylabel("share of the readings")
        axes.legend(fontsize=8)

    return drawn(draw, WIDTH, 2.7, "Errors before and after calibration")


def held_out(result: Calibration, residuals: Residuals) -> str:
    """Held-out against fitted rms of every configuration: far above the line, few others help."""
    fitted, held = rms_by_pose(result, residuals)
    finite = np.isfinite(held)
    unit, factor = ("mm", 1e-3) if fitted.max(initial=0.0) > 5e3 else ("µm", 1.0)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        top = 1.08 * factor * max([*fitted, *held[finite], 1e-9])
        axes.plot([0, top], [0, top], color=FAINT, linewidth=1.0, label="no difference")
        dots(axes, fitted * factor, held * factor, SERIES[2], 4.0, "a configuration")
        axes.set_xlim(0, top)
        axes.set_ylim(0, top)
        axes.set_xlabel(f"fitted rms in {unit}")
        axes.set_ylabel(f"held-out rms in {unit}")
        axes.legend(loc="lower right", fontsize=8)
        if not finite.all():
            _remark(axes, f"{int((~finite).sum())} without held-out error")

    return drawn(draw, WIDTH / 2, 2.9, "Held-out against fitted error by configuration")


def _limit(axes: Axes, values: np.ndarray, height: float) -> None:
    axes.set_ylim(-height, height)
    if beyond := int((np.abs(values) > height).sum()):
        _remark(axes, f"{beyond} beyond this axis")


def _remark(axes: Axes, text: str) -> None:
    axes.text(0.01, 0.97, text, transform=axes.transAxes, va="top", fontsize=8)


def histogram(summary: ResidualSummary) -> str:
    """Standardised residuals beside what the noise model expects in each bin."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        _histogram_bars(axes, summary.whole, summary.edges, "residual / its standard deviation")
        axes.set_ylabel("values")
        axes.legend(loc="upper right", fontsize=8)

    return drawn(draw, WIDTH / 2, 2.9, "Histogram of standardised residuals beside the expected")


def _histogram_bars(axes: Axes, group: GroupSummary, edges: np.ndarray, label: str) -> None:
    axes.stairs(group.counts, edges, fill=True, color=SERIES[0], alpha=0.5, label="observed")
    axes.stairs(group.expected, edges, color=INK, linewidth=1.1, baseline=None, label="expected")
    beyond = f"{group.beyond} beyond this axis" if group.beyond else ""
    axes.set_xlabel("; ".join(text for text in (label, beyond) if text))


def scores(summary: ResidualSummary) -> str:
    """Ordered residuals against normal order statistics, with the simultaneous 95 % band."""
    s = summary.whole.scores

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.fill_between(s.expected, s.low, s.high, color=FAINT, alpha=0.3, linewidth=0,
                          label="95 % band for all together")  # fmt: skip
        ends = s.expected[[0, -1]]
        axes.plot(ends, ends, color=INK, linewidth=1.0, label="normal")
        outside = (s.observed < s.low) | (s.observed > s.high)
        axes.plot(s.expected[~outside], s.observed[~outside], "o", color=SERIES[0], markersize=2.6,
                  label="inside")  # fmt: skip
        if outside.any():
            axes.plot(s.expected[outside], s.observed[outside], "D", color=SERIES[1],
                      markersize=4.0, label="outside")  # fmt: skip
        axes.set_xlabel("expected of a normal distribution")
        axes.set_ylabel("observed")
        axes.legend(loc="upper left", fontsize=8)

    return drawn(draw, WIDTH / 2, 2.9, "Normal scores of the residuals with a 95 % band")


CELLS = 6  # of the work space's longest side
FEWEST = 3  # readings from which on a cell is told
FEWEST_ON_MAP = 30  # poses


def over_time(observed: Observations, residuals: Residuals) -> str:
    """Residual of every reading over time, or over the table's order where no time was recorded."""
    table, lead = observed.table, observed.lead
    if table.time is None:
        at, label = np.arange(len(lead), dtype=float), "reading, in the order of the table"
    else:
        seconds = table.time[lead]
        hours = float(np.ptp(seconds)) > 3 * 3600
        at, label = seconds / (3600 if hours else 60), f"time in {'h' if hours else 'min'}"

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        _over(axes, at, residuals, residuals.shown, 1.5, ("-", "--", ":"))
        axes.set_xlabel(label)
        axes.set_ylabel("residual in µm")
        figure.legend(loc="outside upper right", ncols=residuals.positions)

    return drawn(draw, WIDTH, 2.6, "Residuals over time")


def uncertainty_map(result: Calibration) -> str:
    """How sure the tool's place is over reach and height, under the loads measured: rms in µm of
    each part of the workspace; empty where the model asks for more than joints and load."""
    model, point = result.model, None
    markers, load_point = model.cell.tool.markers, model.cell.tool.load_point
    # The point that the verdict speaks of.
    if (not load_point.any() and len(markers) != 1) or result.load_point_error is not None:
        point = next(iter(markers), "0,0,0")
    poses = over_the_workspace(model.cell, model, result.observations.table)
    try:
        found = result.position(poses.q, poses.force, point)
        nominal = nominal_flanges(model.chain, poses.q)[:, :3, 3]
    except ElastocalError:
        return ""
    variance = np.trace(found.covariance, axis1=1, axis2=2)
    good = np.isfinite(variance)
    if good.sum() < FEWEST_ON_MAP:
        return ""
    at = np.column_stack([np.hypot(nominal[:, 0], nominal[:, 1]), nominal[:, 2]])[good]

    what = printable(f"marker {point}" if point in markers else "tool")

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.set_title(what)
        _map(axes, at, 1e12 * variance[good], float(np.ptp(at, axis=0).max()) / CELLS)
        axes.set_xlabel("distance from the base's z axis in m")
        axes.set_ylabel("height over the base in m")

    return drawn(draw, WIDTH / 2, 3.6, "How sure the place of the tool is over the work space")


def _map(axes: Axes, at: Array, squared: Array, side: float) -> None:
    from matplotlib.patches import Rectangle

    low = at.min(axis=0)
    cell = np.floor((at - low) / side).astype(np.int64)
    keys, code = np.unique(cell, axis=0, return_inverse=True)
    count = np.bincount(code.ravel())
    rms = np.sqrt(np.bincount(code.ravel(), squared) / count)
    told = count >= FEWEST
    largest = float(rms[told].max(initial=0.0)) or 1.0
    for key, size, enough in zip(keys, rms, told, strict=True):
        if not enough:
            continue
        corner = low + side * key
        shade = 0.75 * size / largest
        axes.add_patch(Rectangle((float(corner[0]), float(corner[1])), side, side,
                                 facecolor=SERIES[0], alpha=shade, linewidth=0))  # fmt: skip
        middle = corner + side / 2
        axes.text(float(middle[0]), float(middle[1]), significant(float(size), 2), ha="center",
                  va="center", fontsize=8)  # fmt: skip
    high = low + side * (keys.max(axis=0) + 1)
    axes.set_xlim(float(low[0]) - 0.05 * side, float(high[0]) + 0.05 * side)
    axes.set_ylim(float(low[1]) - 0.05 * side, float(high[1]) + 0.05 * side)
    axes.set_aspect("equal")


def smooth_figure(result: Calibration) -> str:
    """Every function with its 95 % band, without what offsets and lengths can stand for."""
    found = [
        (part, unit)
        for part in result.smooth
        if part.scale and part.group.basis is not None
        for unit in part.sizes
    ][:MOST_SMOOTH]
    if not found:
        return ""
    rows = -(-len(found) // 3)

    def draw(figure: Figure) -> None:
        panels = panels_of(figure, len(found), min(3, len(found)))
        for axes, (part, unit) in zip(panels, found, strict=True):
            _panel(axes, part, unit)

    return drawn(draw, WIDTH, 0.3 + 2.2 * rows, "Smooth functions with their 95 % bands")


def _panel(axes: Axes, part: SmoothPart, unit: str) -> None:
    x, value, half = part.shape()
    shown = _places(x, part)
    axes.axhline(0, color=FAINT, linewidth=0.8)
    own = [c for c, u in enumerate(part.group.units) if u == unit]
    factor, text = display(1.0, unit)
    for k, c in enumerate(own):
        colour = SERIES[k % len(SERIES)]
        low, high = ((value[c] + sign * half[c]) * factor for sign in (-1, 1))
        axes.fill_between(shown, low, high, color=colour, alpha=0.25, linewidth=0)
        axes.plot(shown, value[c] * factor, color=colour, linewidth=1.2)
    axes.set_title(printable(part.group.name))
    axes.set_ylabel(text)
    axes.set_xlabel(f"{part.group.follows} in {'°' if part.group.lasting else 'h'}")


def _places(x: Array, part: SmoothPart) -> Array:
    return np.degrees(x) if part.group.lasting else x / 3600


def residual_figures(
    model: Model, observed: Observations, x: Array, residuals: Residuals, space: Space, title: str
) -> dict[str, str]:
    """Where, when and in which poses an arm at parameter values x (parameters,) errs, as SVG."""
    return {
        "against_joints": against_joints(model.chain.kinds, residuals),
        "over_time": over_time(observed, residuals),
        "space": space_picture(space, title),
    }


def drawn_for(
    result: Calibration,
    residuals: Residuals,
    summary: ResidualSummary | None,
    budget: ErrorBudget | None,
    space: Space,
) -> dict[str, str]:
    """Every figure of an identification's page: name → SVG, empty where nothing is to be drawn."""
    spread = before_and_after(result, budget)
    found = residual_figures(
        result.model, result.observations, result.x, residuals, space,
        "Residuals as arrows on the posed arm",
    ) | {
        "errors": errors(result),
        "held_out": held_out(result, residuals),
        "by_configuration": by_configuration(residuals),
        "waterfall": "",
        "smooth": smooth_figure(result),
        "sureness": uncertainty_map(result),
        "spread": before_after(spread) if spread else "",
    }  # fmt: skip
    if budget is not None:
        steps = budget_steps(result, budget)
        found["waterfall"] = waterfall_of_steps(steps, budget.floor, budget.floor_name)
    if summary is not None:
        found["histogram"] = histogram(summary)
        found["scores"] = scores(summary)
    return found
