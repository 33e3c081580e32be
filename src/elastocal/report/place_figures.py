"""Residuals by time and by region of the work space, and the correlation matrix; SVG each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.result import Calibration
from elastocal.manipulator.observation import Observations
from elastocal.report.figures import MOST_LABELS, WIDTH
from elastocal.report.residuals import Residuals, reach, running_mean
from elastocal.report.svg import FAINT, SERIES, dots, drawn
from elastocal.report.units import significant
from elastocal.report.words import short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

CELLS = 6  # of the work space's longest side
FEWEST = 3  # readings from which on a cell is told
MOST_PARAMETERS = 48  # of the correlation matrix
MOST_WRITTEN = 16  # parameters up to which the numbers are written into it
STRONG = 0.9


def over_time(seen: Observations, residuals: Residuals) -> str:
    """Residual of every reading over time, or over the table's order where no time was recorded."""
    table, lead = seen.table, seen.lead
    n = residuals.positions
    if table.time is None:
        at, label = np.arange(len(lead), dtype=float), "reading, in the order of the table"
    else:
        seconds = table.time[lead]
        hours = float(np.ptp(seconds)) > 3 * 3600
        at, label = seconds / (3600 if hours else 60), f"time in {'h' if hours else 'min'}"
    values = residuals.value[:, :n]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.axhline(0, color=FAINT, linewidth=0.8)
        for k in range(n):
            dots(axes, at[residuals.shown], values[residuals.shown, k], SERIES[k], 1.5)
        for k in range(n):
            middle, mean, error = running_mean(at, values[:, k])
            axes.errorbar(middle, mean, 2 * error, color=SERIES[k], linewidth=1.4, elinewidth=0.8,
                          linestyle=("-", "--", ":")[k % 3],
                          label=residuals.components[k])  # fmt: skip
        height = reach(values)
        axes.set_ylim(-height, height)
        axes.set_xlabel(label)
        axes.set_ylabel("residual in µm")
        figure.legend(loc="outside upper right", ncols=n)

    return drawn(draw, WIDTH, 2.6, "Residuals over time")


def by_region(position: Array, residual: Array) -> str:
    """3-D rms residual (µm) of the readings in each part of the work space, from two sides.

    `position` (N, 3) m where the markers were, `residual` (N, 3) or (N, 1) in µm.
    """
    squared = (residual**2).sum(axis=1)
    views = ((0, 1, "from above"), (0, 2, "from the side"))
    side = max(float(np.ptp(position, axis=0).max()) / CELLS, 1e-3)

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, 2)
        for axes, (a, b, title) in zip(panels, views, strict=True):
            _map(axes, position[:, [a, b]], squared, side)
            axes.set_title(title)
            axes.set_xlabel(f"{'xyz'[a]} in m")
            axes.set_ylabel(f"{'xyz'[b]} in m")

    return drawn(draw, WIDTH, 3.9, "Rms residual by region of the work space")


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


def correlation_matrix(result: Calibration) -> str:
    """Correlations of the parameters that the data determine; empty where there are fewer than two.

    Size by the shade, sign by hatching or number, so that no colour has to be told apart.
    """
    names, r = correlations(result)
    n = len(names)
    if n < 2:
        return ""
    size = min(WIDTH, 2.2 + 0.32 * n)

    def draw(figure: Figure) -> None:
        from matplotlib.patches import Rectangle

        axes = figure.subplots()
        for i in range(n):
            for j in range(i):
                value = float(r[i, j])
                look: dict[str, Any] = {"hatch": "//////", "edgecolor": FAINT} if value < 0 else {}
                axes.add_patch(Rectangle((j - 0.5, i - 0.5), 1, 1, linewidth=0,
                                         facecolor=SERIES[0] if value > 0 else SERIES[1],
                                         alpha=0.8 * abs(value), **look))  # fmt: skip
                if n <= MOST_WRITTEN:
                    text = f"{value:+.2f}".replace("-", "−")
                    axes.text(j, i, text, ha="center", va="center", fontsize=7)
                elif abs(value) > STRONG:
                    axes.text(j, i, "+" if value > 0 else "−", ha="center", va="center", fontsize=8)
        shown = [short_name(name, MOST_LABELS) for name in names]
        axes.set_yticks(range(1, n), shown[1:], fontsize=8 if n < 30 else 6.5)
        axes.set_xticks(range(n - 1), shown[:-1], rotation=90, fontsize=8 if n < 30 else 6.5)
        axes.set_xlim(-0.5, n - 1.5)
        axes.set_ylim(n - 0.5, 0.5)
        axes.grid(False)
        axes.set_aspect("equal")

    return drawn(draw, size, 0.92 * size, "Correlations between the parameters")


def correlations(result: Calibration) -> tuple[list[str], Array]:
    """Names and correlations (n, n) of the determined parameters with a finite variance; of many,
    those that correlate most."""
    variance = np.diag(result.covariance)
    good = np.flatnonzero(np.isfinite(variance) & (variance > 0))
    sd = np.sqrt(variance[good])
    r = result.covariance[np.ix_(good, good)] / np.outer(sd, sd)
    names = [result.determined[k] for k in good]
    if len(names) > MOST_PARAMETERS:
        strongest = np.abs(r - np.eye(len(r))).max(axis=1)
        kept = np.sort(np.argsort(-strongest, kind="stable")[:MOST_PARAMETERS])
        names, r = [names[k] for k in kept], r[np.ix_(kept, kept)]
    return names, np.clip(r, -1.0, 1.0)
