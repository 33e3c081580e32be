"""The figures of the plan report, each an SVG element."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from elastocal.design.plan import Plan
from elastocal.report.svg import FAINT, SERIES, drawn
from elastocal.report.units import display, significant
from elastocal.report.words import short_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH = 9.9
ROW = 0.26  # inches per bar or dot
LONGEST_NAME = 40
MOST_PARAMETERS = 60


def intervals(plan: Plan) -> str:
    """Predicted half widths of the 95 % intervals, a panel per unit."""
    units: dict[str, list[tuple[str, float]]] = {}
    for p in plan.predicted[:MOST_PARAMETERS]:
        shown, unit = display(p.half_width, p.unit)
        units.setdefault(unit, []).append((short_name(p.name, LONGEST_NAME), shown))
    heights = [len(rows) + 1.5 for rows in units.values()]

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(units), 1, squeeze=False, height_ratios=heights)[:, 0]
        for axes, (unit, rows) in zip(panels, units.items(), strict=True):
            for k, (_, half) in enumerate(rows):
                axes.plot([0, half], [k, k], color=SERIES[0], linewidth=5, solid_capstyle="butt")
                axes.annotate(significant(half, 2), (half, k), (5, 0), va="center", fontsize=8,
                              textcoords="offset points")  # fmt: skip
            axes.set_yticks(range(len(rows)), [name for name, _ in rows])
            axes.set_ylim(len(rows) - 0.4, -0.6)
            axes.set_xlim(0, 1.12 * max(half for _, half in rows))
            axes.set_xlabel(f"half width of the 95 % interval in {unit}")
            axes.grid(axis="y", visible=False)

    return drawn(draw, WIDTH, 0.5 + ROW * sum(heights) + 0.3 * len(units), "Predicted intervals")


def removed(plan: Plan) -> str:
    """How many candidates each rule of the cell removed, and how many are feasible."""
    c = plan.candidates
    rows = [(name.replace("_", " "), n) for name, n in c.removed_by.items() if n]
    rows.sort(key=lambda row: -row[1])
    rows.append(("feasible", c.feasible))

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for k, (name, n) in enumerate(rows):
            look: dict[str, Any] = {"facecolor": "none", "edgecolor": FAINT, "hatch": "////"}
            if name == "feasible":
                look = {"facecolor": SERIES[2]}
            axes.barh(k, n, height=0.62, **look)
            axes.annotate(f"{n}", (n, k), (5, 0), textcoords="offset points", va="center",
                          fontsize=8)  # fmt: skip
        axes.set_yticks(range(len(rows)), [name for name, _ in rows])
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.set_xlim(0, 1.15 * max(n for _, n in rows) + 1)
        axes.set_xlabel(f"of {c.tried} poses tried")
        axes.grid(axis="y", visible=False)

    return drawn(draw, WIDTH, 0.7 + 1.2 * ROW * len(rows), "What removed candidates")


def curve(plan: Plan) -> str:
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
        name = "ρ₀" if plan.criterion == "test_pose" else plan.criterion
        axes.set_ylabel(f"{name} in {plan.unit}" if plan.unit else name)
        axes.set_ylim(bottom=0)
        axes.legend(fontsize=8)

    return drawn(draw, WIDTH, 3.0, "Criterion against the number of poses")
