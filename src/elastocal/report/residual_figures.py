"""Figures of residuals: over configurations, joints and time, against normal noise, in space."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from elastocal.errors import ElastocalError
from elastocal.identification.prediction import over_the_workspace
from elastocal.identification.residuals import ResidualSummary
from elastocal.identification.result import Calibration
from elastocal.identification.smooth_part import SmoothPart
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.model.rigid import nominal_flanges
from elastocal.report.arm_view import residual_arm
from elastocal.report.blocks import Figure, ShownArm
from elastocal.report.figures import FAINT, INK, SERIES, dots, panels_of
from elastocal.report.formatting import display, short_name, significant
from elastocal.report.residual_view import Residuals, reach, residuals_by, running_mean
from elastocal.text import printable
from elastocal.units import Array, IntArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

MOST_LABELS = 20
MOST_SMOOTH = 24  # smooth functions
MOST_JOINT_DOTS = 2000  # per joint; the running mean uses every reading


def residual_figures(
    model: Model, observed: Observations, x: Array, residual: Array
) -> Iterator[Figure | ShownArm]:
    """Where, when and in which poses an arm at parameter values x (parameters,) errs, by its
    `residual` (rows,)."""
    residuals = residuals_by(observed, residual)
    yield residual_arm(model, observed, x, residual)
    yield over_configurations(residuals)
    yield over_joints(model.chain.kinds, residuals)
    yield over_time(observed, residuals)


def _thinned(residuals: Residuals, most: int) -> str:
    """That the dots are a choice, where they are."""
    total, shown = len(residuals.value), min(len(residuals.shown), most)
    if shown == total:
        return ""
    return f" Dots are a random choice of {shown} of {total} readings; all else uses all of them."


def over_configurations(residuals: Residuals) -> Figure:
    """Residual of every reading over its configuration, a panel per direction."""
    n = len(residuals.components)
    several = 1 < len(residuals.markers) <= len(SERIES)

    def draw(figure: Drawing) -> None:
        panels = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
        for k, axes in enumerate(panels):
            _configuration_panel(axes, residuals, k)
        panels[-1].set_xlabel("configuration")
        every = range(0, len(residuals.labels), -(-len(residuals.labels) // MOST_LABELS))
        names = [short_name(residuals.labels[i]) for i in every]
        turn = 90 if max(map(len, names)) > 2 else 0
        panels[-1].set_xticks(list(every), names, rotation=turn)
        if several:
            found = panels[0].get_legend_handles_labels()
            figure.legend(*found, loc="outside upper right", ncols=6)

    caption = "Observed minus predicted, by configuration" + " and marker" * several + "."
    caption += _thinned(residuals, len(residuals.shown))
    title = "Residuals by configuration, marker and direction"
    return Figure("residuals", title, draw, 0.7 + 1.3 * n, caption)


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


def over_joints(kinds: Sequence[str], residuals: Residuals) -> Figure:
    """Residual over the position of each joint, of `kinds`, with the running mean by direction."""
    n, shown = residuals.positions, residuals.shown
    if len(shown) * n > MOST_JOINT_DOTS:
        shown = np.random.default_rng(0).choice(shown, MOST_JOINT_DOTS // n, replace=False)

    def draw(figure: Drawing) -> None:
        panels = panels_of(figure, len(kinds), 2, sharey=True)
        for j, (axes, kind) in enumerate(zip(panels, kinds, strict=True)):
            q = np.degrees(residuals.q[:, j]) if kind == "revolute" else residuals.q[:, j] * 1e3
            _over(axes, q, residuals, shown, 1.3)
            axes.set_xlabel(f"joint {j + 1} in {'°' if kind == 'revolute' else 'mm'}")
        figure.supylabel("residual in µm", fontsize=10)
        found = panels[0].get_legend_handles_labels()
        figure.legend(*found, loc="outside upper right", ncols=n)

    caption = (
        "Over joint positions; lines are means of equally many readings with twice their standard "
        "error. A wave or slope is an effect that the model lacks."
    )
    caption += _thinned(residuals, MOST_JOINT_DOTS // n)
    height = 0.5 + 1.75 * -(-len(kinds) // 2)
    return Figure("against_joints", "Residuals against joint positions", draw, height, caption)


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


def _limit(axes: Axes, values: np.ndarray, height: float) -> None:
    axes.set_ylim(-height, height)
    if beyond := int((np.abs(values) > height).sum()):
        _remark(axes, f"{beyond} beyond this axis")


def _remark(axes: Axes, text: str) -> None:
    axes.text(0.01, 0.97, text, transform=axes.transAxes, va="top", fontsize=8)


def normal_scores(summary: ResidualSummary) -> Figure:
    """Ordered residuals against normal order statistics, with the simultaneous 95 % band."""
    s = summary.whole.scores

    def draw(figure: Drawing) -> None:
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
        axes.legend(loc="upper left")

    caption = (
        "Residuals over their standard deviations, in order, against those of a normal "
        "distribution. If the noise model is right, all dots stay in the band in 95 % of tables. "
        "Ends that bend away are outliers; another slope is another size."
    )
    title = "Normal scores of the residuals with a 95 % band"
    return Figure("scores", title, draw, 3.4, caption)


def over_time(observed: Observations, residuals: Residuals) -> Figure:
    """Residual of every reading over time, or over the table's order where no time was recorded."""
    table, lead = observed.table, observed.lead
    if table.time is None:
        at, label = np.arange(len(lead), dtype=float), "reading, in the order of the table"
    else:
        seconds = table.time[lead]
        hours = float(np.ptp(seconds)) > 3 * 3600
        at, label = seconds / (3600 if hours else 60), f"time in {'h' if hours else 'min'}"

    def draw(figure: Drawing) -> None:
        axes = figure.subplots()
        _over(axes, at, residuals, residuals.shown, 1.5, ("-", "--", ":"))
        axes.set_xlabel(label)
        axes.set_ylabel("residual in µm")
        figure.legend(loc="outside upper right", ncols=residuals.positions)

    when = (
        "Over time"
        if table.time is not None
        else ("In the order of the table, which has no column time_s or time_min")
    )
    caption = (
        f"{when}; lines are means with twice their standard error. A slope is a drift, a step "
        "something that moved."
    )
    caption += _thinned(residuals, len(residuals.shown))
    return Figure("over_time", "Residuals over time", draw, 2.9, caption)


CELLS = 6  # of the work space's longest side
FEWEST = 3  # readings from which on a cell is told
FEWEST_ON_MAP = 30  # poses


def uncertainty_map(result: Calibration) -> Figure | None:
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
        return None
    variance = np.trace(found.covariance, axis1=1, axis2=2)
    good = np.isfinite(variance)
    if good.sum() < FEWEST_ON_MAP:
        return None
    at = np.column_stack([np.hypot(nominal[:, 0], nominal[:, 1]), nominal[:, 2]])[good]

    what = printable(f"marker {point}" if point in markers else "tool")

    def draw(figure: Drawing) -> None:
        axes = figure.subplots()
        axes.set_title(what)
        _map(axes, at, 1e12 * variance[good], float(np.ptp(at, axis=0).max()) / CELLS)
        axes.set_xlabel("distance from the base's z axis in m")
        axes.set_ylabel("height over the base in m")

    caption = (
        "Expected error of the tool in µm (rms, measurement noise excluded), by where the nominal "
        "flange stands: poses over the joint limits, under the loads measured. It counts the "
        "covariance of the estimates, what these poses do not show, and possible model error."
    )
    title = "Expected error over the work space"
    return Figure("sureness", title, draw, 4.2, caption)


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
                  va="center", fontsize=9)  # fmt: skip
    high = low + side * (keys.max(axis=0) + 1)
    axes.set_xlim(float(low[0]) - 0.05 * side, float(high[0]) + 0.05 * side)
    axes.set_ylim(float(low[1]) - 0.05 * side, float(high[1]) + 0.05 * side)
    axes.set_aspect("equal")


def smooth_figure(result: Calibration) -> Figure | None:
    """Every function with its 95 % band, without what offsets and lengths can stand for."""
    found = [
        (part, unit)
        for part in result.smooth
        if part.scale and part.group.basis is not None
        for unit in part.sizes
    ][:MOST_SMOOTH]
    if not found:
        return None

    def draw(figure: Drawing) -> None:
        for axes, (part, unit) in zip(panels_of(figure, len(found), 2), found, strict=True):
            _panel(axes, part, unit)

    caption = (
        "With 95 % bands, and without the mean and the wave of one period per turn, for which "
        "offsets, lengths and tilts can stand."
    )
    height = 0.3 + 2.0 * -(-len(found) // 2)
    return Figure("smooth", "Smooth functions with their 95 % bands", draw, height, caption)


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
