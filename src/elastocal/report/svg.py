"""Matplotlib figures as SVG that stands in a page and follows its colours."""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Stand-ins that the page's style sheet replaces by colours for light and dark, screen and print.
INK, GRID, FAINT = "#010203", "#010204", "#010205"
SERIES = ("#010206", "#010207", "#010208", "#010209", "#01020a", "#01020b")
ARM = "#01020c"
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

Draw = Callable[["Figure"], None]


def style() -> AbstractContextManager[None]:
    """Defaults of matplotlib with this package's colours, whatever the user has configured."""
    import matplotlib.style
    from cycler import cycler

    cycle = cycler(color=SERIES)
    return matplotlib.style.context(["default", {**_STYLE, "axes.prop_cycle": cycle}])


def drawn(draw: Draw, width: float, height: float, title: str) -> str:
    """The SVG element of what `draw` puts on a figure of the given size in inches.

    `title` says what the figure shows to those who cannot see it; it is not user text.
    """
    from matplotlib.figure import Figure

    with style():
        figure = Figure(figsize=(width, height), layout="constrained")
        draw(figure)
        buffer = io.StringIO()
        nothing = {"Date": None, "Creator": None, "Format": None, "Type": None}
        figure.savefig(buffer, format="svg", metadata=nothing)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r'<g id="[^"]*"', "<g", text)  # several figures share a page
    text = re.sub(r"<svg [^>]*viewBox=\"([^\"]*)\"[^>]*>", _head(title, width), text, count=1)
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, variable)
    return _numbered(text, title)


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
