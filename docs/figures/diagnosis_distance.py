"""How often the diagnosis is right against how far the nearest rival is, from the blind check."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import norm
from style import ROOT, Colours, draw, plt, table_of

RESULT = ROOT / "experiment_design" / "blind_diagnosis" / "result.md"


def figure(colours: Colours) -> Figure:
    _, rows = table_of(RESULT, "# Blind check")
    found: dict[str, dict[str, tuple[float, str]]] = {}
    for worlds, measure, _, measured, n, _ in rows:
        if worlds.startswith("… d "):
            found.setdefault(worlds, {})[measure] = float(measured.split()[0]), n
    labels = [f"{d[4:].replace(' to ', '–')}\nn = {row['right'][1]}" for d, row in found.items()]
    x = np.arange(len(found))
    right, outright, wrong = (
        np.array([row[name][0] for row in found.values()])
        for name in ("right", "named outright", "wrong name")
    )
    fig, axis = plt.subplots(figsize=(7.6, 3.8))
    axis.bar(x, outright, 0.62, color=colours.one, label="named outright")
    axis.bar(
        x, right - outright, 0.62, bottom=outright, color=colours.one, alpha=0.45,
        label="in a set of at most three",
    )  # fmt: skip
    axis.bar(x, wrong, 0.62, bottom=right, color=colours.two, label="another name")
    axis.bar(
        x, 1 - right - wrong, 0.62, bottom=right + wrong, color=colours.faint,
        label="nothing significant",
    )  # fmt: skip
    middle = np.array([0.5, 1.5, 2.5, 3.5, 4.5])
    axis.hlines(
        norm.cdf(middle / 2), x[:-1] - 0.31, x[:-1] + 0.31, color=colours.text, linewidth=1.8,
        label="Φ(d/2): the best test between two names",
    )  # fmt: skip
    axis.set_xticks(x, labels)
    axis.set_ylim(0, 1)
    axis.set_ylabel("share of the arms with one effect")
    axis.set_xlabel("d, distance to the nearest rival in standard deviations")
    axis.grid(axis="x", visible=False)
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.30), ncols=2, fontsize=9)
    return fig


if __name__ == "__main__":
    draw("diagnosis_distance", figure)
