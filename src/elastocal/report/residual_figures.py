"""Residuals as a table and as figures: over configurations, joints and time, on the arm; how sure
the arm's place is over its workspace; smooth functions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from elastocal.errors import ElastocalError
from elastocal.identification.prediction import over_the_workspace
from elastocal.identification.residuals import groupings
from elastocal.identification.result import Calibration
from elastocal.identification.smooth_part import SmoothPart
from elastocal.model.manipulator import Model
from elastocal.model.observations import COMPONENTS, Observations
from elastocal.model.rigid import nominal_flanges
from elastocal.report.arm_view import residual_arm
from elastocal.report.blocks import Figure, ShownArm, ShownTable
from elastocal.report.figures import FAINT, SERIES, dots, panels_of, reach
from elastocal.report.formatting import display, short_name, signed, significant
from elastocal.text import printable
from elastocal.units import Array, IntArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

MOST_DRAWN = 5000  # observations; figures of larger tables show a random choice of them
MOST_LABELS = 20
MOST_SMOOTH = 24  # smooth functions
MOST_JOINT_DOTS = 2000  # per joint; the running mean uses every reading


@dataclass(frozen=True)
class Residuals:
    """Residuals (observations, components) in µm (µrad for rotations) and where they belong.

    `pose` (observations,) counts configurations from 0 in the table's order, `labels` names
    them; `marker` indexes `markers`; `q` (observations, joints) in rad or m; `shown` are the
    observations to draw, all or a random choice.
    """

    components: tuple[str, ...]
    units: tuple[str, ...]
    value: Array
    pose: IntArray
    labels: tuple[str, ...]
    marker: IntArray
    markers: tuple[str, ...]
    q: Array
    shown: IntArray

    @property
    def lengths(self) -> Array:
        """The components that are lengths (observations, 3 or 1); they come first."""
        return self.value[:, : self.units.count("µm")]


def residuals_by(observed: Observations, residual: Array) -> Residuals:
    """Residuals (rows,) in m (rad) by observation."""
    table, names = observed.table, COMPONENTS[observed.kind]
    codes, first, pose = np.unique(observed.configuration, return_index=True, return_inverse=True)
    order = np.argsort(first)
    used, marker = np.unique(table.marker[observed.lead], return_inverse=True)
    n = len(observed.lead)
    shown = np.arange(n)
    if n > MOST_DRAWN:
        shown = np.sort(np.random.default_rng(0).choice(n, MOST_DRAWN, replace=False))
    return Residuals(
        components=names,
        units=tuple("µrad" if name.startswith("r") else "µm" for name in names),
        value=residual.reshape(-1, observed.size) * 1e6,
        pose=np.argsort(order)[pose],
        labels=tuple(table.configuration_labels[codes[k]] for k in order),
        marker=marker,
        markers=tuple(table.marker_names[k] for k in used),
        q=table.q[observed.lead],
        shown=shown,
    )


OF_RESIDUALS = (
    "Of a direction, mean and largest are signed. Of all others the length of the 3-D residual is "
    "given, and the mean is the length of the mean vector: near the rms, the residual is a common "
    "shift; near zero, it is scatter."
)
MOST_CONFIGURATIONS = 200


def residual_table(observed: Observations, residuals: Residuals) -> ShownTable:
    """Mean, rms and largest residual of every direction, marker, load state and configuration.

    Of a direction they are signed; else lengths of the 3-D residual, and of its mean vector.
    """
    rows: list[tuple[str, ...]] = []

    def add(name: str, sizes: Array, mean: str, largest: str, unit: str = "µm") -> None:
        rms = significant(float(np.sqrt((sizes**2).mean())))
        rows.append((name, str(len(sizes)), mean, rms, largest, unit))

    groups = {0: "direction"}
    columns = residuals.value.T
    for name, unit, value in zip(residuals.components, residuals.units, columns, strict=True):
        largest = float(value[np.argmax(np.abs(value))])
        add(name, value, signed(float(value.mean())), signed(largest), unit)
    every = np.ones(len(observed.value), dtype=bool)
    for by, code, names in groupings(observed, every):
        if by == "component":
            continue
        groups[len(rows)] = by
        for k, name in enumerate(names[:MOST_CONFIGURATIONS]):
            own = residuals.lengths[code[:: observed.size] == k]
            sizes, mean = np.linalg.norm(own, axis=1), float(np.linalg.norm(own.mean(axis=0)))
            add(printable(name), sizes, significant(mean), significant(float(sizes.max())))
    heads = ("readings of", "number", "mean", "rms", "largest", "unit")
    return ShownTable(heads, rows, (0, 5), groups, title="Residuals", note=OF_RESIDUALS)


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
    many, shown, values = len(residuals.markers), residuals.shown, residuals.value[:, k]
    size = 2.6 if len(shown) <= 1500 else 1.6
    x = residuals.pose + 0.6 * (residuals.marker - (many - 1) / 2) / many
    axes.axhline(0, color=FAINT, linewidth=0.8)
    if many > len(SERIES):
        dots(axes, x[shown], values[shown], SERIES[0], size)
    else:
        for m, name in enumerate(residuals.markers):
            at = shown[residuals.marker[shown] == m]
            dots(axes, x[at], values[at], SERIES[m], size, short_name(name))
    axes.grid(axis="x", visible=False)
    axes.set_xlim(-0.7, len(residuals.labels) - 0.3)
    unit = residuals.units[k]
    axes.set_ylabel(f"{residuals.components[k]} in {unit}")
    height = reach(residuals.value[:, [u == unit for u in residuals.units]])
    axes.set_ylim(-height, height)
    if beyond := int((np.abs(values) > height).sum()):
        told = f"{beyond} beyond this axis"
        axes.text(0.01, 0.97, told, transform=axes.transAxes, va="top", fontsize=8)


def over_joints(kinds: Sequence[str], residuals: Residuals) -> Figure:
    """Residual over the position of each joint, of `kinds`, with the running mean by direction."""
    n, shown = residuals.lengths.shape[1], residuals.shown
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
    axes.axhline(0, color=FAINT, linewidth=0.8)
    for k, own in enumerate(residuals.lengths.T):
        dots(axes, x[shown], own[shown], SERIES[k], size)
    for k, own in enumerate(residuals.lengths.T):
        axes.errorbar(*running_mean(x, own), color=SERIES[k], linewidth=1.4, elinewidth=0.8,
                      linestyle=styles[k % len(styles)],
                      label=residuals.components[k])  # fmt: skip
    height = reach(residuals.lengths)
    axes.set_ylim(-height, height)


def running_mean(x: Array, y: Array, bins: int = 12) -> tuple[Array, Array, Array]:
    """Mean x, mean y and twice its standard error in bins of equally many x.

    Where x takes few different values, each is a bin.
    """
    order = np.argsort(x, kind="stable")
    steps = np.flatnonzero(np.diff(x[order]) > 1e-9 * (np.abs(x).max(initial=0.0) + 1e-300)) + 1
    if len(steps) >= 1.5 * bins:
        parts = np.array_split(order, min(bins, max(len(x) // 8, 1)))
    else:
        parts = np.split(order, steps)
    parts = [p for p in parts if len(p) > 1]
    middle, mean = (np.array([v[p].mean() for p in parts]) for v in (x, y))
    return middle, mean, np.array([2 * y[p].std(ddof=1) / np.sqrt(len(p)) for p in parts])


def over_time(observed: Observations, residuals: Residuals) -> Figure:
    """Residual of every reading over time, or over the table's order where no time was recorded."""
    table, lead = observed.table, observed.lead
    if table.time is None:
        at, label = np.arange(len(lead), dtype=float), "reading, in the order of the table"
        when = "In the order of the table, which has no column time_s or time_min"
    else:
        hours = float(np.ptp(table.time[lead])) > 3 * 3600
        at, label = table.time[lead] / (3600 if hours else 60), f"time in {'h' if hours else 'min'}"
        when = "Over time"

    def draw(figure: Drawing) -> None:
        axes = figure.subplots()
        _over(axes, at, residuals, residuals.shown, 1.5, ("-", "--", ":"))
        axes.set_xlabel(label)
        axes.set_ylabel("residual in µm")
        figure.legend(loc="outside upper right", ncols=residuals.lengths.shape[1])

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

    def draw(figure: Drawing) -> None:
        axes = figure.subplots()
        axes.set_title(printable(f"marker {point}" if point in markers else "tool"))
        _map(axes, at, 1e12 * variance[good], float(np.ptp(at, axis=0).max()) / CELLS)
        axes.set_xlabel("distance from the base's z axis in m")
        axes.set_ylabel("height over the base in m")

    caption = (
        "Expected error of the tool in µm (rms, measurement noise excluded), by where the nominal "
        "flange stands: poses over the joint limits, under the loads measured. It counts the "
        "covariance of the estimates, what these poses do not show, and possible model error."
    )
    return Figure("sureness", "Expected error over the work space", draw, 4.2, caption)


def _map(axes: Axes, at: Array, squared: Array, side: float) -> None:
    """Cells of `side` m that hold places `at` (n, 2): the rms of `squared` (n,) as shade, text."""
    from matplotlib.patches import Rectangle

    low = at.min(axis=0)
    keys, code = np.unique(np.floor((at - low) / side), axis=0, return_inverse=True)
    count = np.bincount(code.ravel())
    rms = np.sqrt(np.bincount(code.ravel(), squared) / count)
    told = count >= FEWEST
    largest = float(rms[told].max(initial=0.0)) or 1.0
    for key, size in zip(keys[told], rms[told], strict=True):
        x, y = (low + side * key).tolist()
        axes.add_patch(Rectangle((x, y), side, side, facecolor=SERIES[0], linewidth=0,
                                 alpha=0.75 * size / largest))  # fmt: skip
        axes.text(x + side / 2, y + side / 2, significant(float(size), 2), ha="center",
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
            _smooth_panel(axes, part, unit)

    caption = (
        "With 95 % bands, and without the mean and the wave of one period per turn, for which "
        "offsets, lengths and tilts can stand."
    )
    height = 0.3 + 2.0 * -(-len(found) // 2)
    return Figure("smooth", "Smooth functions with their 95 % bands", draw, height, caption)


def _smooth_panel(axes: Axes, part: SmoothPart, unit: str) -> None:
    x, value, half = part.shape()
    x = np.degrees(x) if part.group.lasting else x / 3600
    axes.axhline(0, color=FAINT, linewidth=0.8)
    factor, text = display(1.0, unit)
    own = [c for c, u in enumerate(part.group.units) if u == unit]
    for k, c in enumerate(own):
        low, high = ((value[c] + sign * half[c]) * factor for sign in (-1, 1))
        colour = SERIES[k % len(SERIES)]
        axes.fill_between(x, low, high, color=colour, alpha=0.25, linewidth=0)
        axes.plot(x, value[c] * factor, color=colour, linewidth=1.2)
    axes.set_title(printable(part.group.name))
    axes.set_ylabel(text)
    axes.set_xlabel(f"{part.group.follows} in {'°' if part.group.lasting else 'h'}")
