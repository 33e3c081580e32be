"""Figures as SVG that stands in a page and follows its colours; those of plan and diagnosis."""

from __future__ import annotations

import hashlib
import io
import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.diagnosis import Curve, Diagnosis
from elastocal.errors import ElastocalError
from elastocal.identification.linear_solver import least_norm
from elastocal.model.manipulator import Model
from elastocal.report.causes_view import causes, family, share_text
from elastocal.report.diagnosis_view import error_steps
from elastocal.report.effect_names import driver_name, effect_at, name_of, place, probability
from elastocal.report.formatting import display, length, short_name, significant
from elastocal.report.residual_view import reach

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
    "font.size": 9.0,
    "text.parse_math": False,  # names from files are not formulas
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT,
    "axes.titlesize": 9.0,
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
    "path.simplify": False,
}
LAYOUT: Any = "constrained"  # half of what drawing takes
Draw = Callable[["Figure"], None]


def style() -> AbstractContextManager[None]:
    """Defaults of matplotlib with this package's colours, whatever the user has configured."""
    import matplotlib.style
    from cycler import cycler

    cycle = cycler(color=SERIES)
    return matplotlib.style.context(["default", {**_STYLE, "axes.prop_cycle": cycle}])


_as_figures: ContextVar[Any] = ContextVar("_as_figures", default=None)


@contextmanager
def as_figures(place: SubFigure | None = None) -> Iterator[None]:
    """Within it `drawn` gives matplotlib's Figures, or draws in a `place` of the user's own."""
    token = _as_figures.set(place or _as_figures.get() or "new ones")
    try:
        yield
    finally:
        _as_figures.reset(token)


def drawn(draw: Draw, width: float, height: float, title: str) -> Any:
    """The SVG element of what `draw` puts on a figure of the given size in inches.

    `title` says what the figure shows to those who cannot see it; it is not user text.
    """
    from matplotlib.figure import Figure, SubFigure

    place = _as_figures.get()
    with style():
        own = isinstance(place, SubFigure)
        figure: Any = place if own else Figure(figsize=(width, height), layout=LAYOUT)
        draw(figure)
        if place:
            whole = figure.get_figure(root=True)
            whole.draw_without_rendering()  # what is made when drawing is made in this style
            return figure
        return svg_of(figure, title)


def svg_of(figure: Figure, title: str) -> str:
    """The SVG element of a figure, in the colours of the page."""
    with style():
        text = rendered(figure)
    text = text[text.index("<svg") :]
    text = re.sub(r'<g id="[^"]*"', "<g", text)  # several figures share a page
    head = _head(title, figure.get_figwidth())
    text = re.sub(r"<svg [^>]*viewBox=\"([^\"]*)\"[^>]*>", head, text, count=1)
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, variable)
    return _numbered(text, title)


def rendered(figure: Figure) -> str:
    """matplotlib's SVG file of a figure."""
    buffer = io.StringIO()
    nothing = {"Date": None, "Creator": None, "Format": None, "Type": None}
    figure.savefig(buffer, format="svg", metadata=nothing)
    return buffer.getvalue()


def _numbered(text: str, title: str) -> str:
    """Ids by order and title: matplotlib's hash the layout, whose last bits differ between runs."""
    prefix = hashlib.sha256(title.encode()).hexdigest()[:8]
    number: dict[str, int] = {}

    def name(match: re.Match[str]) -> str:
        return f"{match[1]}f{prefix}-{number.setdefault(match[2], len(number))}"

    return re.sub(r'(id="|#)([a-z][0-9a-f]{10})\b', name, text)


def _head(title: str, width: float) -> str:
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
        rf'viewBox="\1" role="img" aria-label="{title}" style="max-width:{width * 96:.0f}px">'
    )


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


def panels_of(figure: Figure, n: int, across: int, **how: Any) -> list[Axes]:
    """The first `n` axes of a grid `across` wide; the others are not seen."""
    grid = figure.subplots(max(-(-n // across), 1), across, squeeze=False, **how).ravel()
    for axes in grid[n:]:
        axes.set_visible(False)
    return list(grid[:n])


WIDTH = 9.9
STEP_HEIGHT = 0.42  # inches per step
LONGEST_NAME = 46
# A budget that spans more than this is drawn on a logarithmic axis.
WIDE_RANGE = 8.0


def waterfall_of_steps(
    steps: Sequence[tuple[str, float, tuple[float, float]]],
    floor: float | None,
    floor_name: str,
) -> str:
    """SVG of the steps (name, rms in m, 95 % interval) and the `floor` (m) that noise leaves."""
    rms = np.array([value for _, value, _ in steps])
    ends = np.array([ci95 for *_, ci95 in steps]).reshape(-1, 2)
    floor = math.nan if floor is None else floor
    known = [v for v in (*rms, floor) if math.isfinite(v) and v > 0]

    def draw(figure: Figure) -> None:
        from matplotlib.ticker import LogLocator

        axes = figure.subplots()
        for k, (value, (low, high)) in enumerate(zip(rms * 1e6, ends * 1e6, strict=True)):
            if k:
                label = "taken away" if k == 1 else None
                axes.plot([rms[k - 1] * 1e6, value], [k, k], color=SERIES[5], linewidth=7,
                          solid_capstyle="butt", label=label)  # fmt: skip
            axes.plot([low, high], [k, k], color=SERIES[0], linewidth=1.6,
                      label="95 % interval" if k == 0 else None)  # fmt: skip
            axes.plot([value], [k], "o", color=SERIES[0], markersize=7,
                      label="remaining error" if k == 0 else None)  # fmt: skip
            axes.annotate(length(rms[k]), (value, k), (0, 7), textcoords="offset points",
                          ha="center", fontsize=8)  # fmt: skip
        if math.isfinite(floor):
            axes.axvline(floor * 1e6, color=SERIES[1], linestyle="--", linewidth=1.2,
                         label=f"{floor_name} ({length(floor)})")  # fmt: skip
        axes.set_yticks(range(len(rms)), [short_name(name, LONGEST_NAME) for name, *_ in steps])
        axes.set_ylim(len(rms) - 0.4, -0.75)
        if known and max(known) > WIDE_RANGE * min(known):
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.margins(x=0.1)
        else:
            axes.set_xlim(0, 1.15e6 * max(known, default=1.0))
        micrometre_axis(axes, "3-D rms error on held-out poses")
        figure.legend(loc="outside upper right", ncols=4, fontsize=8)

    return drawn(draw, WIDTH, 1.1 + STEP_HEIGHT * len(rms), "Error budget, step by step")


def micrometre_axis(axes: Axes, label: str) -> None:
    """Lengths in µm across, ticked as "50 µm" or "2 mm"."""
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:g} µm" if x < 1e3 else f"{x / 1e3:g} mm")
    axes.xaxis.set_minor_formatter(lambda x, _: "")
    axes.set_xlabel(label)
    axes.grid(axis="y", visible=False)


def _name_rows(axes: Axes, names: Sequence[str]) -> None:
    """A row for each name, the first on top."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)


BAR_HEIGHT = 0.34  # inches per bar
MOST_BARS = 10
LONGEST_ENTRY = 24  # what moves, written along the height of a small panel
# Unit of a curve's axis → (factor, unit shown).
ABSCISSA = {
    "rad": (180 / math.pi, "°"),
    "s": (1 / 60, "min"),
    "N m": (1.0, "N·m"),
    "of the largest load": (1.0, "parts of the largest"),
}
ORDINATE = {"m": (1e6, "µm"), "rad": (1e6, "µrad"), "1": (1e6, "ppm")}


def diagnosis_waterfall(d: Diagnosis) -> str:
    """The gap budget of a diagnosis as a waterfall."""
    steps = [(name_of(s.step), s.heldout_rms, s.ci95) for s in error_steps(d)]
    return waterfall_of_steps(steps, d.gap.noise_floor, "noise alone")


def candidate_bars(d: Diagnosis) -> str:
    """Probability of the best candidates, of nothing, and of an effect outside the catalogue."""
    rows = [(effect_at(c), c.probability, SERIES[0], "") for c in d.candidates[:MOST_BARS]]
    rows.append(("an effect outside the catalogue", d.probability_unknown, SERIES[1], "////"))
    rows.append(("no further effect", d.probability_nothing, FAINT, "...."))

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for k, (_, p, colour, hatch) in enumerate(rows):
            axes.barh(k, p, height=0.62, facecolor=colour if not hatch else "none",
                      edgecolor=colour, hatch=hatch)  # fmt: skip
            axes.text(p + 0.012, k, probability(p), va="center", fontsize=8)
        _name_rows(axes, [_axis_name(name) for name, *_ in rows])
        axes.set_xlim(0, 1.1)
        axes.set_xticks(np.linspace(0, 1, 6))
        axes.set_xlabel("probability")

    return drawn(draw, WIDTH, 0.7 + BAR_HEIGHT * len(rows), "Probability of every candidate")


def share_bars(d: Diagnosis) -> str:
    """What the gap is made of: the share of every finding with its 90 % interval, and below it
    what it does at each of its places."""
    rows: list[tuple[str, float, tuple[float, float], bool, str]] = []
    for cause in causes(d):
        colour = SERIES[0] if cause.named else SERIES[1]
        rows.append((cause.name, cause.share, cause.share_ci90, True, colour))
        if len(cause.parts) > 1:
            rows += [
                (f"{place(c.where)}, {family(c)}", c.share, c.share_ci90, False, colour)
                for c in cause.parts
            ]
    ends = [end for row in rows for end in row[2] if math.isfinite(end)]
    least, most = min(0.0, *ends, 0.0), max(0.01, *ends, 0.01)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for k, (_, share, ci90, whole, colour) in enumerate(rows):
            axes.barh(k, 100 * share, height=0.62 if whole else 0.34, facecolor=colour,
                      edgecolor="none", alpha=1.0 if whole else 0.45)  # fmt: skip
            both = [100 * end for end in ci90]
            axes.plot(both, [k, k], color=INK, linewidth=1.4, solid_capstyle="butt")
            axes.plot(both, [k, k], "|", color=INK, markersize=7 if whole else 5)
            axes.annotate(share_text(share), (max(100 * share, both[1]), k), (6, 0),
                          textcoords="offset points", va="center", fontsize=8)  # fmt: skip
        _name_rows(axes, [_axis_name(name) for name, *_ in rows])
        for tick, row in zip(axes.get_yticklabels(), rows, strict=True):
            tick.set_fontsize(9 if row[3] else 8)
        axes.set_xlim(100 * least, 112 * most)
        axes.set_xlabel("share of the gap in %, with 90 % interval")

    return drawn(draw, WIDTH, 0.7 + 0.8 * BAR_HEIGHT * len(rows), "Causes of the remaining error")


def unknown_curves(d: Diagnosis) -> str:
    """How the unknown effect depends on what drives it: smooth curves with bands of 2 sd."""

    def draw(figure: Figure) -> None:
        panels = panels_of(figure, len(d.curves), min(2, len(d.curves)))
        for axes, curve in zip(panels, d.curves, strict=True):
            _curve(axes, curve)
        handles = panels[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside upper right", ncols=2, fontsize=8)

    title = "Error curves of the joints" if d.groups else "Shape of the unknown dependence"
    return drawn(draw, WIDTH, 0.4 + 2.6 * -(-len(d.curves) // 2), title)


def _curve(axes: Axes, curve: Curve) -> None:
    wide, x_unit = ABSCISSA.get(curve.x_unit, (1.0, curve.x_unit))
    high, y_unit = ORDINATE.get(curve.y_unit, (1.0, curve.y_unit))
    x, y, sd = (np.array(v) for v in (curve.x, curve.y, curve.sd))
    axes.axhline(0, color=FAINT, linewidth=0.8)
    axes.fill_between(x * wide, (y - 2 * sd) * high, (y + 2 * sd) * high, color=SERIES[0],
                      alpha=0.25, linewidth=0, label="± 2 standard deviations")  # fmt: skip
    axes.plot(x * wide, y * high, color=INK, linewidth=1.4, label="estimated shape")
    axes.set_xlabel(f"{_axis_name(driver_name(curve.driver))} in {x_unit}")
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


def effects_over_joints(d: Diagnosis) -> str:
    """Every found effect of a joint over that joint's position, with the residuals behind it."""
    shapes = effect_shapes(d)
    if not shapes:
        return ""

    def draw(figure: Figure) -> None:
        panels = panels_of(figure, len(shapes), min(2, len(shapes)))
        for axes, shape in zip(panels, shapes, strict=True):
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
            axes.set_ylabel(f"motion of the joint in {'µrad' if revolute else 'µm'}")
            height = reach(1e6 * np.concatenate([shape.seen, shape.explained]))
            axes.set_ylim(-height, height)
            # Above the axes: inside, it would hide readings.
            axes.legend(fontsize=7, loc="lower right", bbox_to_anchor=(1, 1), ncols=2)

    return drawn(
        draw, WIDTH, 0.3 + 2.7 * -(-len(shapes) // 2), "Found effects over the joints they act at"
    )


def _axis_name(text: str) -> str:
    return short_name(text, LONGEST_NAME)


PLAN_ROW = 0.26  # inches per bar or dot
MOST_PARAMETERS = 60
LONGEST_PARAMETER = 40


def plan_intervals(plan: Plan) -> str:
    """Predicted half widths of the 95 % intervals, a panel per unit."""
    units: dict[str, list[tuple[str, float]]] = {}
    for p in plan.predicted[:MOST_PARAMETERS]:
        shown, unit = display(p.half_width, p.unit)
        units.setdefault(unit, []).append((short_name(p.name, LONGEST_PARAMETER), shown))
    heights = [len(rows) + 1.5 for rows in units.values()]

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(units), 1, squeeze=False, height_ratios=heights)[:, 0]
        for axes, (unit, rows) in zip(panels, units.items(), strict=True):
            for k, (_, half) in enumerate(rows):
                axes.plot([0, half], [k, k], color=SERIES[0], linewidth=5, solid_capstyle="butt")
                axes.annotate(significant(half, 2), (half, k), (5, 0), va="center", fontsize=8,
                              textcoords="offset points")  # fmt: skip
            _name_rows(axes, [name for name, _ in rows])
            axes.set_xlim(0, 1.12 * max(half for _, half in rows))
            axes.set_xlabel(f"half width of the 95 % interval in {unit}")

    return drawn(
        draw, WIDTH, 0.5 + PLAN_ROW * sum(heights) + 0.3 * len(units), "Predicted intervals"
    )


def plan_removed(plan: Plan) -> str:
    """How many candidates each rule of the cell removed, and how many are feasible."""
    # What designs plans is slow to import, and other figures do not need it.
    from elastocal.report.plan_view import removed

    c = plan.candidates
    rows = [*removed(plan), ("feasible", c.feasible)]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for k, (name, n) in enumerate(rows):
            look: dict[str, Any] = {"facecolor": "none", "edgecolor": FAINT, "hatch": "////"}
            if name == "feasible":
                look = {"facecolor": SERIES[2]}
            axes.barh(k, n, height=0.62, **look)
            axes.annotate(f"{n}", (n, k), (5, 0), textcoords="offset points", va="center",
                          fontsize=8)  # fmt: skip
        _name_rows(axes, [name for name, _ in rows])
        axes.set_xlim(0, 1.15 * max(n for _, n in rows) + 1)
        axes.set_xlabel(f"of {c.tried} poses tried")

    return drawn(draw, WIDTH, 0.7 + 1.2 * PLAN_ROW * len(rows), "What removed candidates")


def plan_curve(plan: Plan) -> str:
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
        axes.legend(fontsize=8)

    return drawn(draw, WIDTH, 3.0, "Criterion against the number of poses")
