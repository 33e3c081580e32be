"""The physical chain from commanded joints to the instrument's reading, with its effects."""

from __future__ import annotations

import textwrap

from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from style import Colours, draw, plt

from elastocal.model.effects.catalogue import CATALOGUE

STAGES = {
    "transmission": "what the gears make of q",
    "geometry": "where the links lead",
    "load": "what pulls at the arm",
    "compliance": "what gives way, at equilibrium",
    "tool": "where the markers sit",
    "tracker": "what the instrument reports",
}
WIDTH, HEIGHT, STEP = 2.9, 0.62, 0.92


def figure(colours: Colours) -> Figure:
    fig, axis = plt.subplots(figsize=(8.4, 6.0))
    axis.axis("off")
    for i, (stage, what) in enumerate(STAGES.items()):
        y = -i * STEP
        box = FancyBboxPatch(
            (0, y - HEIGHT / 2), WIDTH, HEIGHT, boxstyle="round,pad=0,rounding_size=0.08",
            facecolor=colours.one, alpha=0.22, edgecolor=colours.one,
        )  # fmt: skip
        axis.add_patch(box)
        axis.text(WIDTH / 2, y + 0.12, stage, ha="center", va="center", fontsize=12, weight="bold")
        axis.text(WIDTH / 2, y - 0.14, what, ha="center", va="center", fontsize=9.5)
        names = [effect.name for effect in CATALOGUE.values() if effect.stage == stage]
        text = "\n".join(textwrap.wrap(", ".join(names), 62, break_long_words=False))
        axis.text(WIDTH + 0.25, y, text, ha="left", va="center", fontsize=9.5, linespacing=1.35)
        _arrow(axis, y + STEP - HEIGHT / 2, y + HEIGHT / 2, colours)
    end = -len(STAGES) * STEP
    _arrow(axis, end + STEP - HEIGHT / 2, end + HEIGHT / 2, colours)
    axis.text(WIDTH / 2, STEP - 0.22, "commanded joints q", ha="center", fontsize=10.5)
    axis.text(WIDTH / 2, end + 0.04, "measured x, y, z of a marker", ha="center", fontsize=10.5)
    axis.set_xlim(-0.1, 8.3)
    axis.set_ylim(end - 0.05, STEP)
    return fig


def _arrow(axis: plt.Axes, start: float, end: float, colours: Colours) -> None:
    style = {"arrowstyle": "-|>", "color": colours.text, "shrinkA": 0, "shrinkB": 0}
    axis.annotate("", (WIDTH / 2, end), (WIDTH / 2, start), arrowprops=style)


if __name__ == "__main__":
    draw("chain", figure)
