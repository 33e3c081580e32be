"""Figures by matplotlib: SVG that stands in a page and follows its colours, or Figures to plot.

How a figure is drawn; values with their intervals; a diagnosis' curves and effects; a plan's curve;
residuals as a table and over configurations, joints and time; errors over the work space.
"""

from __future__ import annotations

import hashlib
import io
import math
import re
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from elastocal.diagnosis.diagnosis import Curve, Diagnosis
from elastocal.errors import ElastocalError
from elastocal.identification.prediction import over_the_workspace
from elastocal.identification.residuals import groupings
from elastocal.identification.result import Calibration
from elastocal.identification.weighted_problem import least_norm
from elastocal.model.manipulator import Model
from elastocal.model.observations import COMPONENTS, Observations
from elastocal.model.rigid import nominal_flanges
from elastocal.report.blocks import Figure, ShownTable
from elastocal.report.effect_names import driver_name, effect_at
from elastocal.report.formatting import length, short_name, signed, significant, typeset
from elastocal.text import printable
from elastocal.units import Array, IntArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing
    from matplotlib.figure import SubFigure

    from elastocal.planning.plan import Plan

# The colours of a figure by itself; a page has its style sheet's in their place, for light and
# dark, screen and print.
INK, GRID, FAINT = "#1c2226", "#e6e9eb", "#8a949b"
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
ARM = "#b9c4cc"
_VARIABLES = {
    INK: "var(--ink)",
    GRID: "var(--grid)",
    FAINT: "var(--faint)",
    ARM: "var(--arm)",
    **{colour: f"var(--series{k + 1})" for k, colour in enumerate(SERIES)},
}
_STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "elastocal",
    "font.family": "sans-serif",
    "font.size": 10.5,
    "text.parse_math": False,  # names from files are not formulas
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "axes.prop_cycle": None,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "figure.facecolor": "none",
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "xtick.labelsize": 9.0,
    "ytick.labelsize": 9.0,
    "path.simplify": False,
}
LAYOUT: Any = "constrained"  # half of what drawing takes


def style() -> AbstractContextManager[None]:
    """Defaults of matplotlib with this package's colours, whatever the user has configured."""
    import matplotlib.style
    from cycler import cycler

    cycle = cycler(color=SERIES)
    return matplotlib.style.context(["default", {**_STYLE, "axes.prop_cycle": cycle}])


def figure_of(block: Figure, place: SubFigure | None = None) -> Drawing | SubFigure:
    """matplotlib's Figure of a block, or what is drawn of it in a `place` of another figure."""
    from matplotlib.figure import Figure as Drawing

    with style():
        figure: Any = place or Drawing(figsize=(block.width, block.height), layout=LAYOUT)
        block.draw(figure)
        # What is made when drawing is made in this style.
        figure.get_figure(root=True).draw_without_rendering()
    return figure


def svg(block: Figure) -> str:
    from matplotlib.figure import Figure as Drawing

    with style():
        figure = Drawing(figsize=(block.width, block.height), layout=LAYOUT)
        block.draw(figure)
        text = rendered(figure)
    text = text[text.index("<svg") :]
    text = re.sub(r'<g id="[^"]*"', "<g", text)  # several figures share a page
    head = (
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
        rf'viewBox="\1" role="img" aria-label="{block.title}" '
        f'style="max-width:{block.width * 96:.0f}px">'
    )
    text = re.sub(r"<svg [^>]*viewBox=\"([^\"]*)\"[^>]*>", head, text, count=1)
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, variable)
    # Ids by order and title: matplotlib's hash the layout, whose last bits differ between runs.
    prefix = hashlib.sha256(block.title.encode()).hexdigest()[:8]
    number: dict[str, int] = {}

    def name(match: re.Match[str]) -> str:
        return f"{match[1]}f{prefix}-{number.setdefault(match[2], len(number))}"

    return re.sub(r'(id="|#)([a-z][0-9a-f]{10})\b', name, text)


def rendered(figure: Drawing) -> str:
    buffer = io.StringIO()
    nothing = {"Date": None, "Creator": None, "Format": None, "Type": None}
    figure.savefig(buffer, format="svg", metadata=nothing)
    return buffer.getvalue()


NO_LENGTH = 1e-6  # of a line that is a dot: of none at all a PNG has no caps


def dots(axes: Axes, x: Array, y: Array, colour: str, size: float, label: str = "") -> None:
    """Scatter as one path of round caps: a third of the bytes of a marker per point."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    finite = np.isfinite(x) & np.isfinite(y)
    points = np.column_stack([x[finite], y[finite]])
    if label:
        axes.plot([], [], "o", color=colour, markersize=size + 1, label=label)
    if not len(points):
        return
    codes = np.tile([Path.MOVETO, Path.LINETO], len(points))
    ends = np.repeat(points, 2, axis=0)
    ends[1::2] += NO_LENGTH * (np.ptp(points, axis=0) + np.abs(points).max())
    how: dict[str, Any] = {"linewidth": size, "capstyle": "round", "snap": False, "alpha": 0.6}
    axes.add_patch(PathPatch(Path(ends, codes), fill=False, edgecolor=colour, **how))
    axes.update_datalim(points)
    axes.autoscale_view()


def reach(values: Array) -> float:
    """Half height of an axis: all values, or 8 robust deviations where some lie far beyond."""
    size = np.abs(values[np.isfinite(values)])
    if not len(size) or size.max() == 0:
        return 1.0
    robust = 8 * 1.4826 * float(np.median(size))
    largest = 1.08 * float(size.max())
    return robust if 0 < robust < largest / 1.5 else largest


def panels_of(figure: Drawing, n: int, across: int, **how: Any) -> list[Axes]:
    """The first `n` axes of a grid `across` wide; the others are not seen."""
    grid = figure.subplots(max(-(-n // across), 1), across, squeeze=False, **how).ravel()
    for axes in grid[n:]:
        axes.set_visible(False)
    return list(grid[:n])


ROW = 0.27  # inches per line of a name
LONGEST = 25  # letters of a name, which has two lines at most
# Lengths that span more than this are drawn on a logarithmic axis.
WIDE_RANGE = 8.0
DENSE = 25.0  # below which three ticks a decade have room
NO_ENDS = (math.nan, math.nan)


def rows_of_dots(
    name: str, title: str, rows: Sequence[tuple[str, float, tuple[float, float], str]], axis: str,
    caption: str = "", line: tuple[str, float] | None = None, lengths: bool = False,
) -> Figure:  # fmt: skip
    """Rows (name, value, both ends of its interval or NaN, text), a dot each, and a dashed line at
    a value that has a name.  `lengths`: values in µm, which may span decades."""
    # On two lines, cut where a name is longer.
    wrapped = [textwrap.wrap(typeset(short_name(n, 2 * LONGEST)), LONGEST) for n, *_ in rows]
    names = ["\n".join(w[:2]) + "…" * (len(w) > 2) for w in wrapped]
    lines = [name.count("\n") for name in names]
    at = np.cumsum([0.0, *(1 + 0.4 * (a + b) for a, b in pairwise(lines))])
    dashed = line if line is not None and math.isfinite(line[1]) else None
    known = [value for _, value, *_ in rows] + ([dashed[1]] if dashed else [])
    known = [v for v in known if math.isfinite(v)]

    def draw(figure: Drawing) -> None:
        axes = figure.subplots()
        for y, (_, value, ends, text) in zip(at, rows, strict=True):
            axes.plot(ends, [y, y], color=SERIES[0], linewidth=2.0)
            axes.plot([value], [y], "o", color=SERIES[0], markersize=7)
            axes.annotate(typeset(text), (np.nanmax([value, ends[1]]), y), (7, 0), va="center",
                          textcoords="offset points", fontsize=9)  # fmt: skip
        axes.set_yticks(at, names, fontsize=9.5)
        axes.set_ylim(at[-1] + 0.6, -0.9)
        if dashed:
            told = f"{dashed[0]} ({length(dashed[1] * 1e-6)})"
            axes.axvline(dashed[1], color=SERIES[1], linestyle="--", linewidth=1.2, label=told)
            figure.legend(loc="outside upper right")
        _scaled(axes, known, lengths)
        axes.set_xlabel(axis)
        axes.grid(axis="y", visible=False)

    return Figure(name, title, draw, 0.95 + ROW * (float(at[-1]) + 1.5), caption)


def _scaled(axes: Axes, known: Sequence[float], lengths: bool) -> None:
    from matplotlib.ticker import LogLocator

    axes.margins(x=0.18)  # with room for texts
    if lengths and min(known, default=0) > 0 and max(known) > WIDE_RANGE * min(known):
        axes.set_xscale("log")
        dense = (1.0, 2.0, 5.0) if max(known) < DENSE * min(known) else (1.0, 3.0)
        axes.xaxis.set_major_locator(LogLocator(subs=dense, numticks=9))
    elif min(known, default=0) >= 0 and axes.get_xlim()[1] > 0:
        low = axes.dataLim.x0
        axes.set_xlim(left=min(0.0, low) if math.isfinite(low) else 0.0)
    if lengths:
        axes.xaxis.set_major_formatter(lambda x, _: f"{x:g} µm" if x < 1e3 else f"{x / 1e3:g} mm")
        axes.xaxis.set_minor_formatter(lambda x, _: "")


def waterfall(
    name: str, steps: Sequence[tuple[str, float, tuple[float, float]]],
    floor: tuple[str, float] | None,
) -> Figure:  # fmt: skip
    """Steps (name, held-out rms in m, 95 % interval), and the `floor` (m) that noise leaves."""
    rows = [(n, v * 1e6, (low * 1e6, high * 1e6), length(v)) for n, v, (low, high) in steps]
    caption = (
        "Held-out 3-D rms error with its 95 % interval, as the model gains one part after the "
        "other. "
    )
    caption += "The noise level is unknown." if floor is None else "Dashed: the noise level."
    line = None if floor is None else (floor[0], floor[1] * 1e6)
    title = "Error budget, step by step"
    return rows_of_dots(name, title, rows, "held-out rms error", caption, line, lengths=True)


# Of a diagnosis

LONGEST_ENTRY = 24  # what moves, written along the height of a small panel
# Unit of a curve's axis → (factor, unit shown).
ABSCISSA = {
    "rad": (180 / math.pi, "°"),
    "s": (1 / 60, "min"),
    "N m": (1.0, "N·m"),
    "of the largest load": (1.0, "parts of the largest"),
}
ORDINATE = {"m": (1e6, "µm"), "rad": (1e6, "µrad"), "1": (1e6, "ppm")}


def unknown_curves(d: Diagnosis) -> Figure:
    """How the unknown effect depends on what drives it: smooth curves with bands of 2 sd."""
    across = min(2, len(d.curves))

    def draw(figure: Drawing) -> None:
        panels = panels_of(figure, len(d.curves), across)
        for axes, curve in zip(panels, d.curves, strict=True):
            _curve(axes, curve)
        handles = panels[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside upper right", ncols=2)

    title = "Error curves of the joints" if d.groups else "Shape of the unknown dependence"
    caption = (
        "Motion of the arm beyond the model, as a smooth function of its driver. If the band "
        "includes zero, the data show nothing."
    )
    height = 0.5 + 2.1 * -(-len(d.curves) // across)
    return Figure("curves", title, draw, height, caption)


def _curve(axes: Axes, curve: Curve) -> None:
    wide, x_unit = ABSCISSA.get(curve.x_unit, (1.0, curve.x_unit))
    high, y_unit = ORDINATE.get(curve.y_unit, (1.0, curve.y_unit))
    x, y, sd = (np.array(v) for v in (curve.x, curve.y, curve.sd))
    axes.axhline(0, color=FAINT, linewidth=0.8)
    axes.fill_between(x * wide, (y - 2 * sd) * high, (y + 2 * sd) * high, color=SERIES[0],
                      alpha=0.25, linewidth=0, label="± 2 standard deviations")  # fmt: skip
    axes.plot(x * wide, y * high, color=INK, linewidth=1.4, label="estimated shape")
    axes.set_xlabel(f"{short_name(driver_name(curve.driver), LONGEST_ENTRY)} in {x_unit}")
    axes.set_ylabel(f"{short_name(driver_name(curve.entry), LONGEST_ENTRY)} in {y_unit}")


MOST_SHAPES = 6


# A found effect of a joint, reading by reading: name, kind of joint, its place q (N,), in rad or m
# its motion with the residual left and without it (N,), from where it came (N,), 0 where unknown.
EffectShape = tuple[str, str, Array, Array, Array, Array]


def effect_shapes(d: Diagnosis) -> list[EffectShape]:
    """Of every named effect at a joint whose offset the model has.

    With b = ∂p/∂q_j of a reading, bᵀr/bᵀb is the joint's motion that explains most of r: of the
    effect, and of the effect with the residual that is left where it and all other parameters are
    fitted (a component-plus-residual plot; to first order).
    """
    base, found = d.calibrated, list[EffectShape]()
    if base is None or base.planned:
        return []
    model, observed = base.model, base.observed
    wanted = [f for f in d.effects if f"{f.where}.offset" in model.names and f.parameters]
    B = model.regressor(observed.table, base.x, observations=observed).B if wanted else None
    for f in wanted[:MOST_SHAPES]:
        assert B is not None
        more = model.cell.model.with_effect(f.effect, f.where, f.settings)
        new = {p.name: p.value for p in f.parameters}
        values = dict(zip(model.names, base.x, strict=True)) | new
        try:
            full = Model.assembled(model.chain, replace(model.cell, model=more))
            x = np.array([values[name] for name in full.names])
            moved = full.predict(observed.table, x, observed)
        except (ElastocalError, KeyError):
            continue  # what it needs besides is not in the table
        moved = moved - model.predict(observed.table, base.x, observed)
        left = base.residual - moved + B @ least_norm(B, moved)
        b = B[:, model.names.index(f"{f.where}.offset")].reshape(-1, observed.size)
        size = (b**2).sum(axis=1)
        good = size > 0.1 * np.median(size)
        seen, explained = (
            (b * v.reshape(b.shape)).sum(axis=1)[good] / size[good] for v in (moved + left, moved)
        )
        joint, table = int(f.where.removeprefix("joint")) - 1, observed.table
        lead = observed.lead[good]
        side = np.zeros(len(lead)) if table.approach is None else table.approach[lead, joint]
        kind = model.chain.kinds[joint]
        found.append((effect_at(f), kind, table.q[lead, joint], seen, explained, side))
    return found


def effects_over_joints(d: Diagnosis) -> Figure | None:
    shapes = effect_shapes(d)
    if not shapes:
        return None

    def draw(figure: Drawing) -> None:
        panels = panels_of(figure, len(shapes), 1)
        for axes, shape in zip(panels, shapes, strict=True):
            _effect(axes, shape)
        found = [axes.get_legend_handles_labels() for axes in panels]
        handles, labels = max(found, key=lambda each: len(each[1]))
        figure.legend(handles, labels, loc="outside upper right", ncols=2, fontsize=8.5)

    caption = (
        "Dashes: the effect found, as a motion of its joint. Dots: the same with what is left of "
        "each reading when all is fitted."
    )
    title = "Found effects over the joints they act at"
    return Figure("effects", title, draw, 0.6 + 2.2 * len(shapes), caption)


def _effect(axes: Axes, shape: EffectShape) -> None:
    name, kind, q, seen, explained, side = shape
    revolute = kind == "revolute"
    q = np.degrees(q) if revolute else q * 1e3
    sides = np.unique(np.sign(side))
    for k, one in enumerate(sides):
        own = np.sign(side) == one
        told = "" if len(sides) == 1 else f" ({'from below' if one > 0 else 'from above'})"
        dots(axes, q[own], 1e6 * seen[own], SERIES[k], 1.8, f"readings{told}")
        axes.plot(q[own], 1e6 * explained[own], "_", color=SERIES[k], markersize=9,
                  markeredgewidth=1.8, label=f"effect{told}")  # fmt: skip
    axes.set_title(name, loc="left")
    axes.set_xlabel(f"joint in {'°' if revolute else 'mm'}")
    axes.set_ylabel(f"motion in {'µrad' if revolute else 'µm'}")
    height = reach(1e6 * np.concatenate([seen, explained]))
    axes.set_ylim(-height, height)


def plan_curve(plan: Plan) -> Figure:
    points = plan.curve
    bounded = [(s.poses, s.bound) for s in points if s.bound is not None]

    def draw(figure: Drawing) -> None:
        axes = figure.subplots()
        axes.plot([s.poses for s in points], [s.value for s in points], "o-", color=SERIES[0],
                  markersize=6, label="best plan found")  # fmt: skip
        if bounded:
            axes.plot([n for n, _ in bounded], [bound for _, bound in bounded], "_--",
                      color=SERIES[1], markersize=12,
                      label="no plan can be better (on the pool)")  # fmt: skip
        axes.set_xticks([s.poses for s in points])
        axes.set_xlabel("poses")
        name = "ρ₀" if plan.of_test_poses else plan.criterion
        axes.set_ylabel(f"{name} in {plan.unit}" if plan.unit else name)
        axes.set_ylim(bottom=0)
        axes.legend()

    return Figure("curve", "Criterion against the number of poses", draw, 3.0)


# Of residuals

MOST_DRAWN = 5000  # observations; figures of larger tables show a random choice of them
MOST_LABELS = 20
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


def _thinned(residuals: Residuals, most: int) -> str:
    """That the dots are a choice, where they are."""
    total, shown = len(residuals.value), min(len(residuals.shown), most)
    if shown == total:
        return ""
    return f" Dots are a random choice of {shown} of {total} readings; all else uses all of them."


def over_configurations(residuals: Residuals) -> Figure:
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


def over_time(observed: Observations, residuals: Residuals) -> Iterator[Figure]:
    if observed.table.time is None:
        return
    at, unit = observed.table.time[observed.lead] / 60, "min"
    if float(np.ptp(at)) > 180:
        at, unit = at / 60, "h"

    def draw(figure: Drawing) -> None:
        axes = figure.subplots()
        _over(axes, at, residuals, residuals.shown, 1.5, ("-", "--", ":"))
        axes.set_xlabel(f"time in {unit}")
        axes.set_ylabel("residual in µm")
        figure.legend(loc="outside upper right", ncols=residuals.lengths.shape[1])

    caption = (
        "Over time; lines are means with twice their standard error. A slope is a drift, a step "
        "something that moved."
    )
    caption += _thinned(residuals, len(residuals.shown))
    yield Figure("over_time", "Residuals over time", draw, 2.9, caption)


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
