"""The figures of the diagnosis report, each an SVG element."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from elastocal.diagnosis.result import Curve, Diagnosis
from elastocal.report.diagnosis_rows import error_steps
from elastocal.report.diagnosis_words import driver_name, effect_at, name_of, probability
from elastocal.report.svg import FAINT, INK, SERIES, drawn
from elastocal.report.waterfall import waterfall as waterfall_of
from elastocal.report.words import short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 9.9
ROW = 0.34  # inches per bar
MOST_BARS = 10
LONGEST_NAME = 46
LONGEST_ENTRY = 24  # what moves, written along the height of a small panel
# Unit of a curve's axis → (factor, unit shown).
ABSCISSA = {
    "rad": (180 / math.pi, "°"),
    "s": (1 / 60, "min"),
    "N m": (1.0, "N·m"),
    "of the largest load": (1.0, "parts of the largest"),
}
ORDINATE = {"m": (1e6, "µm"), "rad": (1e6, "µrad"), "1": (1e6, "ppm")}


def waterfall(d: Diagnosis) -> str:
    """The gap budget of a diagnosis as a waterfall."""
    steps = [(name_of(s.step), s.heldout_rms, s.ci95) for s in error_steps(d)]
    return waterfall_of(steps, d.gap.noise_floor, "noise alone")


def candidates(d: Diagnosis) -> str:
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
        axes.set_yticks(range(len(rows)), [_name(name) for name, *_ in rows])
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.set_xlim(0, 1.1)
        axes.set_xticks(np.linspace(0, 1, 6))
        axes.set_xlabel("probability")
        axes.grid(axis="y", visible=False)

    return drawn(draw, WIDTH, 0.7 + ROW * len(rows), "Probability of every candidate")


def curves(d: Diagnosis) -> str:
    """How the unknown effect depends on what drives it: smooth curves with bands of 2 sd."""
    across = min(2, len(d.curves))
    down = -(-len(d.curves) // 2)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(down, across, squeeze=False).ravel()
        for axes, curve in zip(grid, d.curves, strict=False):
            _curve(axes, curve)
        for axes in grid[len(d.curves) :]:
            axes.set_visible(False)
        handles = grid[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside upper right", ncols=2, fontsize=8)

    return drawn(draw, WIDTH, 0.4 + 2.6 * down, "Shape of the unknown dependence")


def _curve(axes: Axes, curve: Curve) -> None:
    wide, x_unit = ABSCISSA.get(curve.x_unit, (1.0, curve.x_unit))
    high, y_unit = ORDINATE.get(curve.y_unit, (1.0, curve.y_unit))
    x, y, sd = (np.array(v) for v in (curve.x, curve.y, curve.sd))
    axes.axhline(0, color=FAINT, linewidth=0.8)
    axes.fill_between(x * wide, (y - 2 * sd) * high, (y + 2 * sd) * high, color=SERIES[0],
                      alpha=0.25, linewidth=0, label="± 2 standard deviations")  # fmt: skip
    axes.plot(x * wide, y * high, color=INK, linewidth=1.4, label="estimated shape")
    axes.set_xlabel(f"{_name(driver_name(curve.driver))} in {x_unit}")
    axes.set_ylabel(f"{short_name(driver_name(curve.entry), LONGEST_ENTRY)} in {y_unit}")


def _name(text: str) -> str:
    return short_name(text, LONGEST_NAME)
