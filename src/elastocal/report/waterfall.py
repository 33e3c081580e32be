"""The gap budget as a waterfall: what each step takes away, and what remains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from elastocal.report.svg import SERIES, drawn
from elastocal.report.units import length
from elastocal.report.words import short_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH = 9.9
ROW = 0.42  # inches per step
LONGEST_NAME = 46
# A budget that spans more than this is drawn on a logarithmic axis.
WIDE_RANGE = 8.0


def waterfall(
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
        axes.xaxis.set_major_formatter(lambda x, _: _tick(x))
        axes.xaxis.set_minor_formatter(lambda x, _: "")
        axes.set_xlabel("3-D rms error on held-out poses")
        axes.grid(axis="y", visible=False)
        figure.legend(loc="outside upper right", ncols=4, fontsize=8)

    return drawn(draw, WIDTH, 1.1 + ROW * len(rms), "Gap budget, step by step")


def _tick(micrometres: float) -> str:
    """ "50 µm", "2 mm"."""
    return f"{micrometres:g} µm" if micrometres < 1e3 else f"{micrometres / 1e3:g} mm"
