"""Figures by matplotlib: SVG that stands in a page and follows its colours, or Figures to plot."""

from __future__ import annotations

import hashlib
import io
import math
import re
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from elastocal.engine import least_norm
from elastocal.identification.noise_summary import groupings
from elastocal.identification.prediction import over_the_workspace
from elastocal.messages import ElastocalError, printable
from elastocal.model.effects.base import index
from elastocal.model.manipulator import Model
from elastocal.model.observations import COMPONENTS, Observations
from elastocal.model.rigid import nominal_flanges
from elastocal.report import blocks as say
from elastocal.units import Array, IntArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing
    from matplotlib.figure import SubFigure

    from elastocal.diagnosis.diagnosis import Curve, Diagnosis
    from elastocal.identification.result import Calibration
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
    **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.labelcolor", "ytick.labelcolor"), INK),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), FAINT),
    **dict.fromkeys(("axes.facecolor", "figure.facecolor"), "none"),
    **dict.fromkeys(("legend.fontsize", "xtick.labelsize", "ytick.labelsize"), 9.0),
    "font.size": 10.5,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.prop_cycle": f"cycler(color={list(SERIES)})",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "path.simplify": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "elastocal",
    "text.parse_math": False,  # names from files are not formulas
}
LAYOUT: Any = "constrained"  # half of what drawing takes
WIDTH = 5.6  # inches


def style() -> AbstractContextManager[None]:
    import matplotlib.style

    return matplotlib.style.context(["default", _STYLE])


def figure_of(block: say.Figure, place: SubFigure | None = None) -> Drawing | SubFigure:
    """matplotlib's Figure of a block, or what is drawn of it in a `place` of another figure."""
    from matplotlib.figure import Figure as Drawing

    with style():
        figure: Any = place or Drawing(figsize=(WIDTH, block.height), layout=LAYOUT)
        block.draw(figure)
        # What is made when drawing is made in this style.
        figure.get_figure(root=True).draw_without_rendering()
    return figure


def svg(block: say.Figure) -> str:
    from matplotlib.figure import Figure as Drawing

    with style():
        figure = Drawing(figsize=(WIDTH, block.height), layout=LAYOUT)
        block.draw(figure)
        text = rendered(figure)
    text = text[text.index("<svg") :]
    text = re.sub(r'<g id="[^"]*"', "<g", text)  # several figures share a page
    head = (
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
        rf'viewBox="\1" role="img" aria-label="{block.title}" '
        f'style="max-width:{WIDTH * 96:.0f}px">'
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

ROW = 0.27  # inches per line of a name
LONGEST = 25  # letters of a name, which has two lines at most
# Lengths that span more than this are drawn on a logarithmic axis.
WIDE_RANGE = 8.0
DENSE, SPARSE = 25.0, 200.0  # below which three ticks a decade have room, and two
NO_ENDS = (math.nan, math.nan)


def rows_of_dots(
    name: str, title: str, rows: say.Steps, axis: str, caption: str = "", line: say.Floor = None,
    lengths: bool = True, told: bool = True,
) -> say.Figure:  # fmt: skip
    """Rows (name, value, both ends of its interval or NaN), a dot each, and a dashed line at a
    value that has a name.  `lengths`: values in m, which may span decades, written beside the dots
    where `told`."""
    scale = 1e6 if lengths else 1.0
    # On two lines, cut where a name is longer.
    wrapped = [
        textwrap.wrap(say.typeset(say.short_name(n, 2 * LONGEST)), LONGEST) for n, *_ in rows
    ]
    names = ["\n".join(w[:2]) + "…" * (len(w) > 2) for w in wrapped]
    lines = [name.count("\n") for name in names]
    at = np.cumsum([0.0, *(1 + 0.4 * (a + b) for a, b in pairwise(lines))])
    dashed = line if line is not None and math.isfinite(line[1]) else None
    known = [value for _, value, _ in rows] + ([dashed[1]] if dashed else [])
    known = [scale * v for v in known if math.isfinite(v)]

    def draw(figure: Drawing) -> None:
        axes = figure.subplots()
        for y, (_, value, ends) in zip(at, rows, strict=True):
            low, x, high = scale * np.array([ends[0], value, ends[1]])
            axes.plot([low, high], [y, y], color=SERIES[0], linewidth=2.0)
            axes.plot([x], [y], "o", color=SERIES[0], markersize=7)
            text = say.length(value) if lengths and told else ""
            axes.annotate(text, (np.nanmax([x, high]), y), (7, 0), va="center",
                          textcoords="offset points", fontsize=9)  # fmt: skip
        axes.set_yticks(at, names, fontsize=9.5)
        axes.set_ylim(at[-1] + 0.6, -0.9)
        if dashed:
            label = f"{dashed[0]} ({say.length(dashed[1])})"
            at_line = scale * dashed[1]
            axes.axvline(at_line, color=SERIES[1], linestyle="--", linewidth=1.2, label=label)
            figure.legend(loc="outside upper right")
        _scaled(axes, known, lengths)
        axes.set_xlabel(axis)
        axes.grid(axis="y", visible=False)

    return say.Figure(name, title, draw, 0.95 + ROW * (float(at[-1]) + 1.5), caption)


def _scaled(axes: Axes, known: Sequence[float], lengths: bool) -> None:
    from matplotlib.ticker import LogLocator, MaxNLocator

    axes.margins(x=0.18)  # with room for texts
    axes.xaxis.set_major_locator(MaxNLocator(5))  # "1.25 mm" is long
    least, span = min(known, default=0), max(known, default=0) / max(min(known, default=0), 1e-300)
    if lengths and least > 0 and span > WIDE_RANGE:
        axes.set_xscale("log")
        subs = (1.0, 2.0, 5.0) if span < DENSE else (1.0, 3.0)[: 1 + (span < SPARSE)]
        axes.xaxis.set_major_locator(LogLocator(subs=subs, numticks=9))
    elif least >= 0 and axes.get_xlim()[1] > 0:
        low = axes.dataLim.x0
        axes.set_xlim(left=min(0.0, low) if math.isfinite(low) else 0.0)
    if lengths:
        axes.xaxis.set_major_formatter(lambda x, _: f"{x:g} µm" if x < 1e3 else f"{x / 1e3:g} mm")
        axes.xaxis.set_minor_formatter(lambda x, _: "")


def waterfall(name: str, steps: say.Steps, floor: say.Floor, of: str) -> say.Figure:
    noise = "The noise level is unknown." if floor is None else "Dashed: the noise level."
    how = "with its 95 % interval, as the model gains one part after the other"
    caption, title = f"Held-out {of} error {how}. {noise}", "Error budget, step by step"
    return rows_of_dots(name, title, steps, "held-out rms error", caption, floor)


Panel: TypeAlias = Callable[["Axes"], object]  # draws into its axes


def panelled(
    name: str, title: str, panels: Sequence[Panel], caption: str, height: float,
    across: int = 1, columns: int = 2, **share: Any,
) -> say.Figure:  # fmt: skip
    """In a grid `across` wide, under one legend of `columns`."""

    def draw(figure: Drawing) -> None:
        rows = max(-(-len(panels) // across), 1)
        grid = figure.subplots(rows, across, squeeze=False, **share).ravel()
        for axes in grid[len(panels) :]:
            axes.set_visible(False)
        for axes, panel in zip(grid, panels, strict=False):
            panel(axes)
        legends = [axes.get_legend_handles_labels() for axes in grid]
        handles, labels = max(legends, key=lambda each: len(each[1]))
        if labels:
            figure.legend(handles, labels, loc="outside upper right", ncols=columns)

    return say.Figure(name, title, draw, height, caption)


def level(axes: Axes, height: float) -> None:
    """As far above zero, which has a line, as below it."""
    axes.axhline(0, color=FAINT, linewidth=0.8)
    axes.set_ylim(-height, height)


def stroke(axes: Axes, x: Array, y: Array, how: str, colour: str, **more: Any) -> None:
    size = {"markersize": 1.6, "markeredgewidth": 1.8} | more
    axes.plot(x, y, how, color=colour, linewidth=1.4, **size)


def dots(axes: Axes, x: Array, y: Array, colour: str, size: float, label: str = "") -> None:
    """One line of round caps: a third of the bytes of a marker per point."""
    if label:
        axes.plot([], [], "o", color=colour, markersize=size + 1, label=label)
    at = np.stack([x, y])[:, np.isfinite(x) & np.isfinite(y), None]
    short = NO_LENGTH * np.abs(at).max(axis=1, keepdims=True, initial=0.0)
    ends = np.concatenate([at, at + short, np.full(at.shape, np.nan)], axis=2).reshape(2, -1)
    axes.plot(*ends, color=colour, linewidth=size, solid_capstyle="round", alpha=0.6, snap=False)


def running_mean(x: Array, y: Array, bins: int = 12) -> tuple[Array, Array, Array]:
    """Mean x, mean y and twice its standard error in bins of equally many x; where x takes few
    different values, each is a bin."""
    order = np.argsort(x, kind="stable")
    steps = np.flatnonzero(np.diff(x[order]) > 1e-9 * (np.abs(x).max(initial=0.0) + 1e-300)) + 1
    if len(steps) >= 1.5 * bins:
        parts = np.array_split(order, min(bins, max(len(x) // 8, 1)))
    else:
        parts = np.split(order, steps)
    parts = [p for p in parts if len(p) > 1]
    middle, mean = (np.array([v[p].mean() for p in parts]) for v in (x, y))
    return middle, mean, np.array([2 * y[p].std(ddof=1) / np.sqrt(len(p)) for p in parts])


def reach(values: Array) -> float:
    """Half height of an axis: all values, or 8 robust deviations where some lie far beyond."""
    size = np.abs(values[np.isfinite(values)])
    if not len(size) or size.max() == 0:
        return 1.0
    robust = 8 * 1.4826 * float(np.median(size))
    largest = 1.08 * float(size.max())
    return robust if 0 < robust < largest / 1.5 else largest


def _in_unit(kind: str, q: Array) -> tuple[Array, str]:
    return (np.degrees(q), "°") if kind == "revolute" else (q * 1e3, "mm")


LONGEST_ENTRY = 24  # what moves, written along the height of a small panel
# Unit of a curve's axis → (factor, unit shown).
ABSCISSA = {
    "rad": (180 / math.pi, "°"),
    "s": (1 / 60, "min"),
    "N m": (1.0, "N·m"),
    "of the largest load": (1.0, "parts of the largest"),
}
ORDINATE = {"m": (1e6, "µm"), "rad": (1e6, "µrad"), "1": (1e6, "ppm")}
COARSER = {"µm": "mm", "µrad": "mrad"}  # from 1000 on


def unknown_curves(d: Diagnosis) -> say.Figure:
    def panel(axes: Axes, curve: Curve) -> None:
        wide, x_unit = ABSCISSA.get(curve.x_unit, (1.0, curve.x_unit))
        high, y_unit = ORDINATE.get(curve.y_unit, (1.0, curve.y_unit))
        if y_unit in COARSER and high * max(map(abs, curve.y)) >= 1000:
            high, y_unit = high / 1000, COARSER[y_unit]
        x, y, sd = wide * np.array(curve.x), high * np.array(curve.y), high * np.array(curve.sd)
        stroke(axes, x, 0 * x, "-", FAINT)
        axes.fill_between(x, y - 2 * sd, y + 2 * sd, color=SERIES[0], alpha=0.25, linewidth=0,
                          label="± 2 standard deviations")  # fmt: skip
        stroke(axes, x, y, "-", INK, label="estimated shape")
        driver, entry = (
            say.short_name(say.driver_name(name), LONGEST_ENTRY)
            for name in (curve.driver, curve.entry)
        )
        axes.set(xlabel=f"{driver} in {x_unit}", ylabel=f"{entry} in {y_unit}")

    panels = [partial(panel, curve=curve) for curve in d.curves]
    title = "Error curves of the joints" if d.groups else "Shape of the unknown dependence"
    caption = (
        "Motion of the arm beyond the model, as a smooth function of its driver. If the band "
        "includes zero, the data show nothing."
    )
    across = min(2, len(panels))
    return panelled("curves", title, panels, caption, 0.5 + 2.1 * -(-len(panels) // across), across)


MOST_SHAPES, NO_COLUMNS = 6, np.zeros((0, 0))


def effects_over_joints(d: Diagnosis) -> Iterator[say.Figure]:
    """With b = ∂p/∂q_j of a reading, bᵀr/bᵀb is the joint's motion that explains most of r: of the
    effect, and of the effect with the residual that is left where it and all other parameters are
    fitted (a component-plus-residual plot; to first order)."""
    base, panels = d.calibrated, list[Panel]()
    if base is None or base.planned:
        return
    model, observed, table = base.model, base.observed, base.observed.table
    wanted = [f for f in d.effects if f"{f.where}.offset" in model.names and f.parameters]
    B = model.regressor(table, base.x, observations=observed).B if wanted else NO_COLUMNS
    for f in wanted[:MOST_SHAPES]:
        more = model.cell.model.with_effect(f.effect, f.where, f.settings)
        values = dict(zip(model.names, base.x, strict=True))
        values |= {p.name: p.value for p in f.parameters}
        try:
            full = Model.assembled(model.chain, replace(model.cell, model=more))
            x = np.array([values[name] for name in full.names])
            moved = full.predict(table, x, observed) - model.predict(table, base.x, observed)
        except (ElastocalError, KeyError):
            continue  # what it needs besides is not in the table
        left = base.residual - moved + B @ least_norm(B, moved)
        b = B[:, model.names.index(f"{f.where}.offset")].reshape(-1, observed.size)
        size = (b**2).sum(axis=1)
        good = size > 0.1 * np.median(size)
        seen, explained = (
            1e6 * (b * v.reshape(b.shape)).sum(axis=1)[good] / size[good]
            for v in (moved + left, moved)
        )
        joint, lead = index(f.where), observed.lead[good]
        # From where the joint came, 0 where that is not known.
        came = (
            np.zeros(len(lead)) if table.approach is None else np.sign(table.approach[lead, joint])
        )
        each = model.chain.kinds[joint], table.q[lead, joint], came, seen, explained
        panels.append(partial(_by_side, say.effect_at(f), joint + 1, *each))
    caption = (
        "Dashes: the effect found, as a motion of its joint. Dots: the same with what is left of "
        "each reading when all is fitted."
    )
    title = "Found effects over the joints they act at"
    if panels:
        yield panelled("effects", title, panels, caption, 0.6 + 2.2 * len(panels))


def _by_side(
    title: str, joint: int, kind: str, q: Array, came: Array, seen: Array, explained: Array,
    axes: Axes,
) -> None:  # fmt: skip
    level(axes, reach(np.concatenate([seen, explained])))
    (q, unit), sides = _in_unit(kind, q), np.unique(came)
    for k, one in enumerate(sides):
        own = came == one
        told = "" if len(sides) == 1 else f" ({'from below' if one > 0 else 'from above'})"
        dots(axes, q[own], seen[own], SERIES[k], 1.8, f"readings{told}")
        stroke(axes, q[own], explained[own], "_", SERIES[k], markersize=9, label=f"effect{told}")
    motion = f"motion in {'µrad' if kind == 'revolute' else 'µm'}"
    axes.set(xlabel=f"joint {joint} in {unit}", ylabel=motion)
    axes.set_title(title)


def plan_curve(plan: Plan) -> say.Figure:
    n, value = (np.array([getattr(s, name) for s in plan.curve]) for name in ("poses", "value"))
    bound = np.array([math.nan if s.bound is None else s.bound for s in plan.curve])
    name = "ρ₀" if plan.of_test_poses else plan.criterion
    unit = f" in {plan.unit}" if plan.unit else ""

    def panel(axes: Axes) -> None:
        told = "no plan can be better (on the pool)"
        stroke(axes, n, bound, "_--", SERIES[1], markersize=12, label=told)
        stroke(axes, n, value, "o-", SERIES[0], markersize=6, label="best plan found")
        stroke(axes, n[:1], np.zeros(1), "", SERIES[0])  # zero is seen
        axes.set(xlabel="poses", ylabel=f"{name}{unit}")
        _ticks(axes, n.tolist(), [*map(str, n)])

    return panelled("curve", "Criterion against the number of poses", [panel], "", 3.0)


def _ticks(axes: Axes, places: Sequence[float], names: Sequence[str]) -> None:
    axes.set_xticks(places, names, rotation=90 if max(map(len, names)) > 2 else 0)


MOST_DRAWN = 5000  # observations; figures of larger tables show a random choice of them
MOST_LABELS = 20
MOST_JOINT_DOTS = 2000  # per joint; the running mean uses every reading
OF_RESIDUALS = (
    "Of a direction, mean and largest are signed. Of all others the length of the residual is "
    "given, and the mean is the length of the mean vector: near the rms, the residual is a common "
    "shift; near zero, it is scatter."
)
MOST_CONFIGURATIONS = 200


class Residuals:
    """Residuals (observations, components) of a model at x in µm (µrad for rotations) as figures
    and a table; `shown` are the observations to draw, all or a random choice."""

    def __init__(self, model: Model, observed: Observations, x: Array, residual: Array) -> None:
        self.fit, self.observed = (model, observed, x, residual), observed
        self.components = COMPONENTS[observed.kind]
        self.units = ["µrad" if name.startswith("r") else "µm" for name in self.components]
        self.value = residual.reshape(-1, observed.size) * 1e6
        self.lengths = self.value[:, : self.units.count("µm")]  # they come first
        n = len(observed.lead)
        self.shown = np.arange(n)
        if n > MOST_DRAWN:
            self.shown = np.sort(np.random.default_rng(0).choice(n, MOST_DRAWN, replace=False))

    def figures(self) -> tuple[say.Figure, say.Figure]:
        return self.by_configuration(), self.over_joints()

    def others(self) -> Iterator[say.Block]:
        if self.observed.table.time is not None:
            yield self.over_time(self.observed.table.time[self.observed.lead] / 60)
        yield self.table()

    def _thinned(self, drawn: int) -> str:
        total = len(self.value)
        if drawn >= total:
            return ""
        return f" Dots are a random choice of {drawn} of {total} readings; all else uses all."

    def by_configuration(self) -> say.Figure:
        table, shown = self.observed.table, self.shown
        codes, first, own = np.unique(
            self.observed.configuration, return_index=True, return_inverse=True
        )
        order = np.argsort(first)  # as the table has them
        labels = [table.configuration_labels[codes[k]] for k in order]
        used, marker = np.unique(table.marker[self.observed.lead], return_inverse=True)
        many = len(used)
        x = np.argsort(order)[own] + 0.6 * (marker - (many - 1) / 2) / many
        several = 1 < many <= len(SERIES)
        every = range(0, len(labels), -(-len(labels) // MOST_LABELS))

        def panel(axes: Axes, name: str, unit: str, values: Array) -> None:
            height = reach(self.value[:, [u == unit for u in self.units]])
            level(axes, height)
            for m in range(many if several else 1):
                at = shown[marker[shown] == m] if several else shown
                label = say.short_name(table.marker_names[used[m]]) if several else ""
                dots(axes, x[at], values[at], SERIES[m], 2.6 if len(shown) <= 1500 else 1.6, label)
            axes.set_ylabel(f"{name} in {unit}")
            if name == self.components[-1]:
                axes.set_xlabel("configuration")
            if beyond := int((np.abs(values) > height).sum()):
                axes.text(0.01, 0.97, f"{beyond} beyond this axis", transform=axes.transAxes,
                          va="top", fontsize=8)  # fmt: skip
            _ticks(axes, every, [say.short_name(labels[i]) for i in every])

        each = zip(self.components, self.units, self.value.T, strict=True)
        panels = [partial(panel, name=n, unit=u, values=v) for n, u, v in each]
        caption = "Observed minus predicted, by configuration" + " and marker" * several + "."
        return panelled(
            "residuals", "Residuals by configuration, marker and direction", panels,
            caption + self._thinned(len(shown)), 0.7 + 1.3 * len(panels), columns=6, sharex=True,
        )  # fmt: skip

    def _over(
        self, axes: Axes, x: Array, shown: IntArray, size: float, lines: Sequence[str]
    ) -> None:
        level(axes, reach(self.lengths))
        for k, v in enumerate(self.lengths.T):
            dots(axes, x[shown], v[shown], SERIES[k], size)
        for k, v in enumerate(self.lengths.T):
            axes.errorbar(*running_mean(x, v), color=SERIES[k], linewidth=1.4, elinewidth=0.8,
                          linestyle=lines[k % len(lines)], label=self.components[k])  # fmt: skip

    def over_joints(self) -> say.Figure:
        n, shown, kinds = self.lengths.shape[1], self.shown, self.fit[0].chain.kinds
        if len(shown) * n > MOST_JOINT_DOTS:
            shown = np.random.default_rng(0).choice(shown, MOST_JOINT_DOTS // n, replace=False)

        def panel(axes: Axes, k: int, j: int) -> None:
            q, unit = _in_unit(kinds[j], at[:, j])
            self._over(axes, q, shown, 1.3, "-")
            axes.set(xlabel=f"joint {j + 1} in {unit}", ylabel="" if k % 2 else "residual in µm")

        at = self.observed.table.q[self.observed.lead]
        moved = np.flatnonzero(np.ptp(at, axis=0) > 0)
        panels = [partial(panel, k=k, j=int(j)) for k, j in enumerate(moved)]
        caption = (
            "Over joint positions; lines are means of equally many readings with twice their "
            "standard error. A wave or slope is an effect that the model lacks."
        )
        return panelled(
            "against_joints", "Residuals against joint positions", panels,
            caption + self._thinned(len(shown)), 0.5 + 1.75 * -(-len(panels) // 2), 2, n,
            sharey=True,
        )  # fmt: skip

    def over_time(self, minutes: Array) -> say.Figure:
        at, unit = (minutes / 60, "h") if float(np.ptp(minutes)) > 180 else (minutes, "min")

        def panel(axes: Axes) -> None:
            self._over(axes, at, self.shown, 1.5, ("-", "--", ":"))
            axes.set(xlabel=f"time in {unit}", ylabel="residual in µm")

        caption = (
            "Over time; lines are means with twice their standard error. A slope is a drift, a "
            "step something that moved."
        )
        return panelled(
            "over_time", "Residuals over time", [panel], caption + self._thinned(len(self.shown)),
            2.9, columns=3,
        )  # fmt: skip

    def table(self) -> say.ShownTable:
        """Of a direction signed; else lengths of the 3-D residual, and of its mean vector."""
        # Names with values (n,) that have a sign, or with vectors (n, components), in their unit.
        found: list[tuple[str, Array, str]] = [
            *zip(self.components, self.value.T, self.units, strict=True)
        ]
        groups = {0: "direction"}
        every = np.ones(len(self.observed.value), dtype=bool)
        for by, code, names in groupings(self.observed, every):
            if by != "component":
                groups[len(found)] = by
                own = code[:: self.observed.size]
                found += [(printable(name), self.lengths[own == k], "µm")
                          for k, name in enumerate(names[:MOST_CONFIGURATIONS])]  # fmt: skip
        rows = []
        for name, values, unit in found:
            signed = values.ndim == 1
            sizes = np.abs(values) if signed else np.linalg.norm(values, axis=1)
            told = say.signed if signed else say.significant
            mean = float(values.mean() if signed else np.linalg.norm(values.mean(axis=0)))
            largest = float(values[sizes.argmax()] if signed else sizes.max())
            rms = float(np.sqrt((sizes**2).mean()))
            # Of the mean the digits that so many readings determine.
            known = say.with_uncertainty(mean, rms / math.sqrt(len(sizes)))[0]
            rows.append((name, str(len(sizes)), known, say.significant(rms), told(largest), unit))
        heads = ("readings of", "number", "mean", "rms", "largest", "unit")
        return say.ShownTable(heads, rows, (0, 5), groups, title="Residuals", note=OF_RESIDUALS)


CELLS = 6  # of the work space's longest side
FEWEST = 3  # readings from which on a cell is told
FEWEST_ON_MAP = 30  # poses


def uncertainty_map(result: Calibration) -> say.Figure | None:
    """Expected error over reach and height, under the loads measured; None where none is expected,
    or where the model asks for more than joints and load."""
    if result.predicted is None:  # as where only distances were read; nor has the verdict one
        return None
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
    low, side = at.min(axis=0), float(np.ptp(at, axis=0).max()) / CELLS
    keys, code = np.unique(np.floor((at - low) / side), axis=0, return_inverse=True)
    count = np.bincount(code.ravel())
    rms = np.sqrt(np.bincount(code.ravel(), 1e12 * variance[good]) / count)
    told = count >= FEWEST
    largest = float(rms[told].max(initial=0.0)) or 1.0
    ends = low - 0.05 * side, low + side * (keys.max(axis=0) + 1.05)

    def draw(figure: Drawing) -> None:
        from matplotlib.patches import Rectangle

        axes = figure.subplots()
        for (x, y), size in zip(
            (low + side * keys[told]).tolist(), rms[told].tolist(), strict=True
        ):
            axes.add_patch(Rectangle((x, y), side, side, facecolor=SERIES[0], linewidth=0,
                                     alpha=0.75 * size / largest))  # fmt: skip
            text = say.significant(size, 2 if size < 100 else 3)
            axes.text(x + side / 2, y + side / 2, text, ha="center", va="center", fontsize=9)
        axes.set(xlim=[end[0] for end in ends], ylim=[end[1] for end in ends], aspect="equal",
                 xlabel="distance from the base's z axis in m", ylabel="height over the base in m",
                 title=printable(f"marker {point}" if point in markers else "tool"))  # fmt: skip

    caption = (
        "Expected error of the tool in µm (rms, measurement noise excluded), by where the nominal "
        "flange stands: poses over the joint limits, under the loads measured. It counts the "
        "covariance of the estimates, what these poses do not show, and possible model error."
    )
    return say.Figure("sureness", "Expected error over the work space", draw, 4.2, caption)
