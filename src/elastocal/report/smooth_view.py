"""What an identification says of its smooth functions: a row for each, and a figure of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elastocal.identification.result import Calibration
from elastocal.identification.smooth_part import SmoothPart
from elastocal.report.figures import FAINT, SERIES, drawn, panels_of
from elastocal.report.formatting import ShownTable, counted, display, significant
from elastocal.text import printable
from elastocal.units import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HEADS = ("smooth function", "rms", "95 %", "known to ±", "unit", "coefficients' worth")
MOST_DRAWN = 24
WIDTH = 9.9


def smooth_table(result: Calibration) -> ShownTable:
    """A row for each function and unit; what was left out has none."""
    rows = []
    for part in result.smooth:
        if not part.scale:
            continue
        for unit, (rms, (low, high), half) in part.sizes.items():
            numbers = [significant(display(v, unit)[0]) for v in (rms, low, high, half)]
            worth = f"{significant(part.effective, 2)} of {part.coefficients}"
            rows.append(
                (
                    printable(part.group.name), numbers[0], f"{numbers[1]} to {numbers[2]}",
                    numbers[3], display(0.0, unit)[1], worth,
                )
            )  # fmt: skip
    return ShownTable(HEADS, rows, (0, 4))


def smooth_lines(result: Calibration) -> list[str]:
    """The same as sentences, one for each function."""
    return [
        f"{name}: {rms} {unit} rms ({ends}), known to ± {half} {unit}, {worth} coefficients' worth"
        for name, rms, ends, half, unit, worth in smooth_table(result).rows
    ]


def counted_functions(result: Calibration) -> str:
    """ "; and 6 smooth functions of 648 coefficients", "" where there are none."""
    found = [part for part in result.smooth if part.scale]
    if not found:
        return ""
    n = sum(part.coefficients for part in found)
    return f"; and {counted(len(found), 'smooth function')} of {n} coefficients"


def smooth_figure(result: Calibration) -> str:
    """Every function with its 95 % band, without what offsets and lengths can stand for."""
    found = [
        (part, unit)
        for part in result.smooth
        if part.scale and part.group.basis is not None
        for unit in part.sizes
    ][:MOST_DRAWN]
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
