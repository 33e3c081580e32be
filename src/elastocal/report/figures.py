"""Figures by matplotlib: SVG that stands in a page and follows its colours, or Figures to plot."""

from __future__ import annotations

import hashlib
import io
import math
import re
import textwrap
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.diagnosis import Curve, Diagnosis
from elastocal.errors import ElastocalError
from elastocal.identification.weighted_problem import least_norm
from elastocal.model.manipulator import Model
from elastocal.report import blocks
from elastocal.report.effect_names import driver_name, effect_at
from elastocal.report.formatting import length, short_name, typeset

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

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


def figure_of(block: blocks.Figure, place: SubFigure | None = None) -> Figure | SubFigure:
    """matplotlib's Figure of a block, or what is drawn of it in a `place` of another figure."""
    from matplotlib.figure import Figure

    with style():
        figure: Any = place or Figure(figsize=(block.width, block.height), layout=LAYOUT)
        block.draw(figure)
        # What is made when drawing is made in this style.
        figure.get_figure(root=True).draw_without_rendering()
    return figure


def svg(block: blocks.Figure) -> str:
    """The SVG element of a block, in the colours of the page."""
    from matplotlib.figure import Figure

    with style():
        figure = Figure(figsize=(block.width, block.height), layout=LAYOUT)
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


def rendered(figure: Figure) -> str:
    """matplotlib's SVG file of a figure."""
    buffer = io.StringIO()
    nothing = {"Date": None, "Creator": None, "Format": None, "Type": None}
    figure.savefig(buffer, format="svg", metadata=nothing)
    return buffer.getvalue()


def dots(axes: Axes, x: NDArray, y: NDArray, colour: str, size: float, label: str = "") -> None:
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
    path = Path(np.repeat(points, 2, axis=0), codes)
    axes.add_patch(
        PathPatch(path, fill=False, edgecolor=colour, linewidth=size, capstyle="round", alpha=0.6)
    )
    axes.update_datalim(points)
    axes.autoscale_view()


def reach(values: NDArray) -> float:
    """Half height of an axis: all values, or 8 robust deviations where some lie far beyond."""
    size = np.abs(values[np.isfinite(values)])
    if not len(size) or size.max() == 0:
        return 1.0
    robust = 8 * 1.4826 * float(np.median(size))
    largest = 1.08 * float(size.max())
    return robust if 0 < robust < largest / 1.5 else largest


def panels_of(figure: Figure, n: int, across: int, **how: Any) -> list[Axes]:
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


@dataclass(frozen=True)
class Row:
    """A dot at `value` with an interval to both `ends`, where these are finite, and a `text`."""

    name: str
    value: float
    ends: tuple[float, float] = (math.nan, math.nan)
    text: str = ""
    colour: str = SERIES[0]
    small: bool = False


def rows_of_dots(
    name: str, title: str, rows: Sequence[Row], axis: str, caption: str = "",
    line: tuple[str, float] | None = None, logarithmic: bool = False, lengths: bool = False,
) -> blocks.Figure:  # fmt: skip
    """Values with their intervals, a row each, and a dashed line at one that has a name.

    `lengths`: values in µm, which may span decades.
    """
    # On two lines, cut where a name is longer.
    wrapped = [textwrap.wrap(typeset(short_name(r.name, 2 * LONGEST)), LONGEST) for r in rows]
    names = ["\n".join(w[:2]) + "…" * (len(w) > 2) for w in wrapped]
    lines = [name.count("\n") for name in names]
    at = np.cumsum([0.0, *(1 + 0.4 * (a + b) for a, b in pairwise(lines))])
    dashed = line if line is not None and math.isfinite(line[1]) else None
    known = [row.value for row in rows] + ([dashed[1]] if dashed else [])
    known = [v for v in known if math.isfinite(v)]
    wide = lengths and min(known, default=0) > 0 and max(known) > WIDE_RANGE * min(known)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for y, row in zip(at, rows, strict=True):
            axes.plot(row.ends, [y, y], color=row.colour, linewidth=1.1 if row.small else 2.0)
            axes.plot([row.value], [y], "o", color=row.colour, markersize=4 if row.small else 7)
            end = np.nanmax([row.value, row.ends[1]])
            axes.annotate(typeset(row.text), (end, y), (7, 0), textcoords="offset points",
                          va="center", fontsize=9)  # fmt: skip
        axes.set_yticks(at, names)
        for tick, row in zip(axes.get_yticklabels(), rows, strict=True):
            tick.set_fontsize(8.5 if row.small else 9.5)
        axes.set_ylim(at[-1] + 0.6, -0.9)
        if dashed:
            told = f"{dashed[0]} ({length(dashed[1] * 1e-6)})"
            axes.axvline(dashed[1], color=SERIES[1], linestyle="--", linewidth=1.2, label=told)
            figure.legend(loc="outside upper right")
        _scaled(axes, known, wide or logarithmic, lengths)
        axes.set_xlabel(axis)
        axes.grid(axis="y", visible=False)

    return blocks.Figure(name, title, draw, 0.95 + ROW * (float(at[-1]) + 1.5), caption)


def _scaled(axes: Axes, known: Sequence[float], logarithmic: bool, lengths: bool) -> None:
    from matplotlib.ticker import LogLocator

    axes.margins(x=0.18)  # with room for texts
    if logarithmic:
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
) -> blocks.Figure:  # fmt: skip
    """Steps (name, held-out rms in m, 95 % interval), and the `floor` (m) that noise leaves."""
    rows = [Row(n, v * 1e6, (low * 1e6, high * 1e6), length(v)) for n, v, (low, high) in steps]
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


def unknown_curves(d: Diagnosis) -> blocks.Figure:
    """How the unknown effect depends on what drives it: smooth curves with bands of 2 sd."""
    across = min(2, len(d.curves))

    def draw(figure: Figure) -> None:
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
    return blocks.Figure("curves", title, draw, height, caption)


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


@dataclass(frozen=True)
class EffectShape:
    """What a found effect of a joint does to it, reading by reading: `q` (N,) and, in rad or m too,
    `explained` (N,) its motion, `seen` (N,) that with the residual left; `side` (N,) from where
    the joint came, zero where nobody says."""

    name: str
    kind: str
    q: NDArray
    seen: NDArray
    explained: NDArray
    side: NDArray


def effect_shapes(d: Diagnosis) -> list[EffectShape]:
    """Of every named effect at a joint whose offset the model has.

    With b = ∂p/∂q_j of a reading, bᵀr/bᵀb is the joint's motion that explains most of r: of the
    effect, and of the effect with the residual that is left where it and all other parameters are
    fitted (a component-plus-residual plot; to first order).
    """
    base, found = d.calibrated, []
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
        found.append(
            EffectShape(effect_at(f), model.chain.kinds[joint], table.q[lead, joint], seen,
                        explained, side)
        )  # fmt: skip
    return found


def effects_over_joints(d: Diagnosis) -> blocks.Figure | None:
    """Every found effect of a joint over that joint's position, with the residuals behind it."""
    shapes = effect_shapes(d)
    if not shapes:
        return None

    def draw(figure: Figure) -> None:
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
    return blocks.Figure("effects", title, draw, 0.6 + 2.2 * len(shapes), caption)


def _effect(axes: Axes, shape: EffectShape) -> None:
    revolute = shape.kind == "revolute"
    q = np.degrees(shape.q) if revolute else shape.q * 1e3
    sides = np.unique(np.sign(shape.side))
    for k, side in enumerate(sides):
        own = np.sign(shape.side) == side
        told = "" if len(sides) == 1 else f" ({'from below' if side > 0 else 'from above'})"
        dots(axes, q[own], 1e6 * shape.seen[own], SERIES[k], 1.8, f"readings{told}")
        axes.plot(q[own], 1e6 * shape.explained[own], "_", color=SERIES[k], markersize=9,
                  markeredgewidth=1.8, label=f"effect{told}")  # fmt: skip
    axes.set_title(shape.name, loc="left")
    axes.set_xlabel(f"joint in {'°' if revolute else 'mm'}")
    axes.set_ylabel(f"motion in {'µrad' if revolute else 'µm'}")
    height = reach(1e6 * np.concatenate([shape.seen, shape.explained]))
    axes.set_ylim(-height, height)


def plan_curve(plan: Plan) -> blocks.Figure:
    """The criterion of the best plan found against its number of poses, with its bound."""
    points = plan.curve
    bounded = [(s.poses, s.bound) for s in points if s.bound is not None]

    def draw(figure: Figure) -> None:
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

    return blocks.Figure("curve", "Criterion against the number of poses", draw, 3.0)
