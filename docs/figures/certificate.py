"""Four plans of fifteen poses against the certified bound, from the plan study's own result."""

from __future__ import annotations

import re

from matplotlib.figure import Figure
from style import ROOT, Colours, draw, plt, table_of

RESULT = ROOT / "experiment_design" / "kr270_plan" / "result.md"
SECTION = "## KR 270-2, joint limits alone"


def figure(colours: Colours) -> Figure:
    head, rows = table_of(RESULT, SECTION)
    text = RESULT.read_text(encoding="utf-8").split(SECTION, 1)[1]
    bound = _number(r"ρ₀ ≥ ([\d.]+) µm", text)
    median = _number(r"the median has ρ₀ = ([\d.]+) µm", text)
    values = {row[0]: float(row[head.index("ρ₀ predicted, µm")]) for row in rows}
    realised = {row[0]: float(row[head.index("realised rms, µm")]) for row in rows}
    shown = {
        "best plan found": ("ours", values["ours"]),
        "D-optimal plan": ("D-optimal", values["D-optimal"]),
        "Table 2 of the paper": ("Table 2", values["Table 2"]),
        "random, median of 1000": ("", median),
    }
    fig, axis = plt.subplots(figsize=(8.0, 2.7))
    for i, (name, value) in enumerate(shown.values()):
        tint = colours.one if i == 0 else colours.four
        axis.barh(-i, value, 0.58, color=tint)
        axis.text(value + 0.05, -i, f"{value:.2f} µm", va="center", fontsize=9.5)
        if name in realised:
            kwargs = {"label": "realised in 500 simulated campaigns"} if i == 0 else {}
            axis.plot(realised[name], -i, "D", color=colours.text, markersize=5, **kwargs)
    axis.axvline(bound, color=colours.two, linewidth=1.8, label=f"certified bound, {bound:.2f} µm")
    axis.set_yticks([-i for i in range(len(shown))], list(shown))
    axis.set_xlim(0, 4.6)
    axis.set_xlabel("ρ₀, rms position error left at the test poses, µm")
    axis.grid(axis="y", visible=False)
    axis.legend(loc="upper center", bbox_to_anchor=(0.45, -0.24), ncols=2, fontsize=9)
    return fig


def _number(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    if found is None:
        raise LookupError(f"{RESULT.name} no longer states {pattern}")
    return float(found.group(1))


if __name__ == "__main__":
    draw("certificate", figure)
