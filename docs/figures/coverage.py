"""How often intervals at 95 % hold the truth, from the coverage study's own result."""

from __future__ import annotations

from matplotlib.figure import Figure
from style import ROOT, Colours, draw, plt, table_of

RESULT = ROOT / "experiment_design" / "coverage" / "result.md"
SHOWN = {
    "default": "identify, as it is",
    "OLS, CR2": "OLS, cluster-robust (CR2)",
    "OLS, eq. (8)": "OLS, eq. (8)",
    "eq. (14) by group": "weights of eq. (14) by group",
    "eq. (14) per residual": "weights of eq. (14) per residual",
}
MARKS = ("o", "s", "D", "^", "v")


def figure(colours: Colours) -> Figure:
    head, rows = table_of(RESULT, "Intervals at 95 %")
    fig, axis = plt.subplots(figsize=(6.2, 4.4))
    tints = (colours.one, colours.three, colours.four, colours.two, colours.two)
    y = [-i for i in range(len(rows))]
    for (name, label), mark, tint in zip(SHOWN.items(), MARKS, tints, strict=True):
        values = [float(row[head.index(name)]) for row in rows]
        hollow = "none" if mark == "v" else tint
        axis.plot(values, y, mark, color=tint, markerfacecolor=hollow, label=label, clip_on=False)
    axis.axvline(95, color=colours.text, linewidth=1)
    axis.text(95, 0.75, "what they say: 95 %", ha="center", fontsize=10)
    axis.set_yticks(y, [row[0] for row in rows])
    axis.set_xlim(0, 100)
    axis.set_xlabel("intervals that hold the truth, %")
    axis.legend(loc="upper center", bbox_to_anchor=(0.3, -0.14), ncols=2, fontsize=10)
    return fig


if __name__ == "__main__":
    draw("coverage", figure)
