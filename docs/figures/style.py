"""Colours and files of the documentation's figures: each drawn for light and for dark pages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"


@dataclass(frozen=True)
class Colours:
    """Okabe and Ito's colours, which the colour-blind can tell apart, on the page's ground."""

    ground: str
    text: str
    faint: str
    one: str
    two: str
    three: str
    four: str


SCHEMES = {
    "light": Colours("#ffffff", "#22262b", "#c3c8ce", "#0072b2", "#d55e00", "#009e73", "#7f7f7f"),
    "dark": Colours("#1e2129", "#dfe2e8", "#4c525e", "#56b4e9", "#e69f00", "#2fc79b", "#a9adb5"),
}


def draw(name: str, figure: Callable[[Colours], Figure]) -> None:
    """Write docs/images/NAME_light.svg and NAME_dark.svg, the same bytes at every run."""
    for scheme, colours in SCHEMES.items():
        settings = {
            "figure.facecolor": colours.ground,
            "axes.facecolor": colours.ground,
            "savefig.facecolor": colours.ground,
            "text.color": colours.text,
            "axes.labelcolor": colours.text,
            "axes.edgecolor": colours.text,
            "xtick.color": colours.text,
            "ytick.color": colours.text,
            "grid.color": colours.faint,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.grid": True,
            "grid.linewidth": 0.6,
            "axes.axisbelow": True,
            "font.size": 10,
            "legend.frameon": False,
            "svg.hashsalt": "elastocal",
            "svg.fonttype": "path",
        }
        with plt.rc_context(settings):
            drawn = figure(colours)
            path = IMAGES / f"{name}_{scheme}.svg"
            drawn.savefig(path, metadata={"Date": None}, bbox_inches="tight")
            plt.close(drawn)
    print(f"docs/images/{name}_light.svg, {name}_dark.svg")


def table_of(path: Path, heading: str) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the first Markdown table under a heading of a result file."""
    text = path.read_text(encoding="utf-8").split(heading, 1)[1]
    lines = [line for line in text.split("\n## ")[0].splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return rows[0], rows[2:]
