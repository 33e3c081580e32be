"""The figures of the residuals' distribution, each an SVG element."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from elastocal.identification.residual_summary import GroupSummary, ResidualSummary
from elastocal.report.svg import FAINT, INK, SERIES, drawn
from elastocal.report.words import short_name

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 9.9
ACROSS = 6  # small histograms beside each other
MOST_PANELS = 18  # small histograms, of the most conspicuous groups


def histogram(summary: ResidualSummary) -> str:
    """Standardised residuals beside what the noise model expects in each bin."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        _bars(axes, summary.whole, summary.edges, "residual / its standard deviation")
        axes.set_ylabel("values")
        axes.legend(loc="upper right", fontsize=8)

    return drawn(draw, WIDTH / 2, 2.9, "Histogram of standardised residuals beside the expected")


def scores(summary: ResidualSummary) -> str:
    """Ordered residuals against normal order statistics, with the simultaneous 95 % band."""
    s = summary.whole.scores

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.fill_between(s.expected, s.low, s.high, color=FAINT, alpha=0.3, linewidth=0,
                          label="95 % band for all together")  # fmt: skip
        ends = s.expected[[0, -1]]
        axes.plot(ends, ends, color=INK, linewidth=1.0, label="normal")
        outside = (s.observed < s.low) | (s.observed > s.high)
        axes.plot(s.expected[~outside], s.observed[~outside], "o", color=SERIES[0], markersize=2.6,
                  label="inside")  # fmt: skip
        if outside.any():
            axes.plot(s.expected[outside], s.observed[outside], "D", color=SERIES[1],
                      markersize=4.0, label="outside")  # fmt: skip
        axes.set_xlabel("expected of a normal distribution")
        axes.set_ylabel("observed")
        axes.legend(loc="upper left", fontsize=8)

    return drawn(draw, WIDTH / 2, 2.9, "Normal scores of the residuals with a 95 % band")


def scatter_by_group(summary: ResidualSummary) -> str:
    """Observed over expected standard deviation of every listed group, with its chance band."""
    shown = [g for g in summary.groupings if g.groups]

    def draw(figure: Figure) -> None:
        if not shown:
            figure.text(0.5, 0.5, "no groups of at least 8 values", ha="center")
            return
        widths = [max(len(g.groups), 2) for g in shown]
        panels = figure.subplots(1, len(shown), sharey=True, squeeze=False, width_ratios=widths)[0]
        for axes, grouping in zip(panels, shown, strict=True):
            _scatter_panel(axes, grouping.groups)
            left_out = grouping.n_groups - len(grouping.groups)
            title = grouping.by + (f" ({left_out} more)" if left_out else "")
            axes.set_title(title)
        panels[0].set_ylabel("observed / expected scatter")
        largest = max(group.mean_square for g in shown for group in g.groups)
        panels[0].set_ylim(0, 1.12 * max(np.sqrt(largest), 1.6))
        handles: dict[str, Artist] = {}
        for axes in panels:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                handles.setdefault(label, handle)
        figure.legend(list(handles.values()), list(handles), loc="outside lower right", ncols=3)

    return drawn(draw, WIDTH, 3.4, "Scatter of each group of readings over the expected one")


def _scatter_panel(axes: Axes, groups: tuple[GroupSummary, ...]) -> None:
    x = np.arange(len(groups))
    f = np.array([g.dof for g in groups])
    low, high = (np.sqrt(stats.chi2.ppf(q, f) / f) for q in (0.025, 0.975))
    axes.axhline(1, color=INK, linewidth=0.8)
    axes.bar(x, high - low, 0.7, low, color=FAINT, alpha=0.3, label="chance alone, 95 % of each")
    value = np.sqrt([g.mean_square for g in groups])
    deviates = np.array([g.deviates for g in groups])
    for chosen, mark, colour, size, name in (
        (~deviates, "o", SERIES[0], 4.5, "as the noise model says"),
        (deviates, "D", SERIES[1], 5.5, "unlike the noise model"),
    ):
        if chosen.any():
            axes.plot(x[chosen], value[chosen], mark, color=colour, markersize=size, label=name)
    axes.set_xlim(-0.6, max(len(groups), 2) - 0.4)
    names = [short_name(g.name, 16) for g in groups]
    turn = 90 if max(map(len, names)) > 2 else 0
    axes.set_xticks(x.tolist(), names, rotation=turn)
    axes.grid(axis="x", visible=False)


def histograms_by_group(summary: ResidualSummary) -> str:
    """A small histogram of each of the most conspicuous groups, beside the expected one."""
    every = [(g, group) for g in summary.groupings for group in g.groups]
    least = sorted(group.p for _, group in every)[:MOST_PANELS]
    panels = [
        (f"{g.by} {short_name(group.name)}", group, g.edges)
        for g, group in every
        if group.p <= least[-1]
    ][:MOST_PANELS]
    rows = max(-(-len(panels) // ACROSS), 1)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(rows, ACROSS, squeeze=False).ravel()
        for axes, (title, group, edges) in zip(grid, panels, strict=False):
            _bars(axes, group, edges, "")
            axes.set_title(title, fontsize=7.5)
            axes.xaxis.label.set_fontsize(7)
            axes.tick_params(labelsize=7)
        for axes in grid[len(panels) :]:
            axes.set_visible(False)

    return drawn(draw, WIDTH, 0.2 + 1.45 * rows, "Histograms of standardised residuals by group")


def _bars(axes: Axes, group: GroupSummary, edges: np.ndarray, label: str) -> None:
    axes.stairs(group.counts, edges, fill=True, color=SERIES[0], alpha=0.5, label="observed")
    axes.stairs(group.expected, edges, color=INK, linewidth=1.1, baseline=None, label="expected")
    beyond = f"{group.beyond} beyond this axis" if group.beyond else ""
    axes.set_xlabel("; ".join(text for text in (label, beyond) if text))
