"""The figures of the identification report, each an SVG element."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from elastocal.identification.result import Calibration
from elastocal.report.residuals import (
    Residuals,
    reach,
    rms_by_pose,
    running_mean,
)
from elastocal.report.svg import FAINT, SERIES, dots, drawn
from elastocal.report.units import length
from elastocal.report.verdict import rms_by_kind
from elastocal.report.words import short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 9.9
MOST_LABELS = 30
MOST_JOINT_DOTS = 2000  # per joint; the running mean uses every reading


def by_configuration(residuals: Residuals) -> str:
    """Residual of every reading over its configuration, a panel per direction."""
    n = len(residuals.components)

    def draw(figure: Figure) -> None:
        panels = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
        for k, axes in enumerate(panels):
            _configuration_panel(axes, residuals, k)
        panels[-1].set_xlabel("configuration")
        every = range(0, len(residuals.labels), -(-len(residuals.labels) // MOST_LABELS))
        names = [short_name(residuals.labels[i]) for i in every]
        turn = 90 if max(map(len, names)) > 3 else 0
        panels[-1].set_xticks(list(every), names, rotation=turn)
        if 1 < len(residuals.markers) <= len(SERIES):
            figure.legend(
                *panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=6
            )

    return drawn(draw, WIDTH, 0.6 + 1.5 * n, "Residuals by configuration, marker and direction")


def _configuration_panel(axes: Axes, residuals: Residuals, k: int) -> None:
    many = len(residuals.markers)
    values = residuals.value[:, k]
    size = 2.6 if len(residuals.shown) <= 1500 else 1.6
    shift = 0.6 * (np.arange(many) - (many - 1) / 2) / many
    axes.axhline(0, color=FAINT, linewidth=0.8)
    if many > len(SERIES):
        at = residuals.shown
        x = residuals.pose[at] + shift[residuals.marker[at]]
        dots(axes, x, values[at], SERIES[0], size)
    else:
        for m, name in enumerate(residuals.markers):
            at = residuals.shown[residuals.marker[residuals.shown] == m]
            dots(axes, residuals.pose[at] + shift[m], values[at], SERIES[m], size, short_name(name))
    axes.grid(axis="x", visible=False)
    axes.set_xlim(-0.7, len(residuals.labels) - 0.3)
    axes.set_ylabel(f"{residuals.components[k]} in {residuals.units[k]}")
    alike = [i for i, unit in enumerate(residuals.units) if unit == residuals.units[k]]
    _limit(axes, values, reach(residuals.value[:, alike]))


def against_joints(kinds: Sequence[str], residuals: Residuals) -> str:
    """Residual over the position of each joint, of `kinds`, with the running mean by direction."""
    rows = -(-len(kinds) // 3)
    n = residuals.positions
    values = residuals.value[:, :n]
    shown = residuals.shown
    if len(shown) * n > MOST_JOINT_DOTS:
        shown = np.random.default_rng(0).choice(shown, MOST_JOINT_DOTS // n, replace=False)
    height = reach(values)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(rows, min(3, len(kinds)), sharey=True, squeeze=False).ravel()
        for j, (axes, kind) in enumerate(zip(grid, kinds, strict=False)):
            q = np.degrees(residuals.q[:, j]) if kind == "revolute" else residuals.q[:, j] * 1e3
            axes.axhline(0, color=FAINT, linewidth=0.8)
            for k in range(n):
                dots(axes, q[shown], values[shown, k], SERIES[k], 1.3)
            for k in range(n):
                middle, mean, error = running_mean(q, values[:, k])
                axes.errorbar(middle, mean, 2 * error, color=SERIES[k], linewidth=1.4,
                              elinewidth=0.8, label=residuals.components[k])  # fmt: skip
            axes.set_xlabel(f"joint {j + 1} in {'°' if kind == 'revolute' else 'mm'}")
            axes.set_ylim(-height, height)
        for axes in grid[len(kinds) :]:
            axes.set_visible(False)
        figure.supylabel("residual in µm", fontsize=9)
        handles = grid[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside upper right", ncols=n)

    return drawn(draw, WIDTH, 0.4 + 2.0 * rows, "Residuals against joint positions")


def errors(result: Calibration) -> str:
    """Nominal, fitted, held-out and test rms on one axis, logarithmic where they differ much."""
    rows = [(name, v) for name, v in rms_by_kind(result) if np.isfinite(v) and v > 0]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for k, (name, v) in enumerate(rows):
            colour = SERIES[0] if name.startswith("nominal") else SERIES[1]
            axes.plot([v * 1e6], [-k], "o", color=colour, markersize=8)
            axes.annotate(length(v), (v * 1e6, -k), (0, 7), textcoords="offset points", ha="center")
        names = [name.replace(" (", "\n(") for name, _ in rows]
        axes.set_yticks([-k for k in range(len(rows))], names)
        axes.set_ylim(0.6 - len(rows), 0.7)
        sizes = [v for _, v in rows]
        if max(sizes, default=1.0) > 8 * min(sizes, default=1.0):
            axes.set_xscale("log")
            axes.margins(x=0.25)
        else:
            axes.set_xlim(0, 1.25e6 * max(sizes, default=1.0))
        axes.xaxis.set_major_formatter(lambda x, _: f"{x:g} µm" if x < 1e3 else f"{x / 1e3:g} mm")
        axes.xaxis.set_minor_formatter(lambda x, _: "")
        axes.set_xlabel("rms error")
        axes.grid(axis="y", visible=False)

    return drawn(draw, WIDTH / 2, 2.9, "Nominal, fitted, held-out and test error")


def held_out(result: Calibration, residuals: Residuals) -> str:
    """Held-out against fitted rms of every configuration: far above the line, few others help."""
    fitted, held = rms_by_pose(result, residuals)
    finite = np.isfinite(held)
    unit, factor = ("mm", 1e-3) if fitted.max(initial=0.0) > 5e3 else ("µm", 1.0)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        top = 1.08 * factor * max([*fitted, *held[finite], 1e-9])
        axes.plot([0, top], [0, top], color=FAINT, linewidth=1.0, label="no difference")
        dots(axes, fitted * factor, held * factor, SERIES[2], 4.0, "a configuration")
        axes.set_xlim(0, top)
        axes.set_ylim(0, top)
        axes.set_xlabel(f"fitted rms in {unit}")
        axes.set_ylabel(f"held-out rms in {unit}")
        axes.legend(loc="lower right", fontsize=8)
        if not finite.all():
            _remark(axes, f"{int((~finite).sum())} without held-out error")

    return drawn(draw, WIDTH / 2, 2.9, "Held-out against fitted error by configuration")


def _limit(axes: Axes, values: np.ndarray, height: float) -> None:
    axes.set_ylim(-height, height)
    if beyond := int((np.abs(values) > height).sum()):
        _remark(axes, f"{beyond} beyond this axis")


def _remark(axes: Axes, text: str) -> None:
    axes.text(0.01, 0.97, text, transform=axes.transAxes, va="top", fontsize=8)
