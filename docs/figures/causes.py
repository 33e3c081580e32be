"""What the diagnosis says of a real arm: how the error falls, and the share of each joint."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from style import ROOT, Colours, draw, plt, table_of

RESULT = ROOT / "experiment_design" / "real_arms" / "diagnosis.md"
HEADING = "## UR10, 600 poses\n"
NAMES = {"joint_curve": "gear error", "gravity_sag": "gravity sag", "move_lag": "lag"}
STEPS = {"base_frame": "base and tool", "geometry": "+ geometry", "noise_floor": "noise alone"}


def figure(colours: Colours) -> Figure:
    head, rows = table_of(RESULT, HEADING)
    named = [row for row in rows if row[head.index("effects")].split(",")[0] in NAMES]
    text = RESULT.read_text(encoding="utf-8").split(HEADING, 1)[1].split("\n## ")[0]
    steps = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in text.split("| step |", 1)[1].splitlines()[2:] if line.startswith("|")
    ]  # fmt: skip
    fig, (left, right) = plt.subplots(1, 2, figsize=(9.2, 3.4), width_ratios=[1, 1.15])
    labels = [STEPS.get(s[0], "+ " + s[0].partition(":")[0].replace("_", " ")) for s in steps]
    errors = np.array([1e3 * float(s[1]) for s in steps])
    y = np.arange(len(steps))
    shades = [colours.faint if s[0] == "noise_floor" else colours.one for s in steps]
    left.barh(y, errors, 0.6, color=shades)
    for k, error in enumerate(errors):
        left.annotate(f"{error:.0f}", (error, k), (4, 0), textcoords="offset points", va="center")
    left.set_yticks(y, labels)
    left.set_ylim(len(steps) - 0.5, -0.5)
    left.set_xlim(0, 1.15 * errors.max())
    left.set_xlabel("rms error on held-out poses, µm")
    at = np.arange(len(named))
    shares = np.array([float(row[head.index("share of the gap, %")]) for row in named])
    ends = np.array([[float(v) for v in row[head.index("90 %")].split(" to ")] for row in named])
    right.barh(at, shares, 0.6, color=colours.three)
    right.hlines(at, ends[:, 0], ends[:, 1], color=colours.text, linewidth=1.6)
    effect, place = head.index("effects"), head.index("place")
    where = [
        f"{NAMES[row[effect].split(',')[0]]}, {row[place].replace('joint', 'joint ')}"
        for row in named
    ]
    right.set_yticks(at, where)
    right.set_ylim(len(named) - 0.5, -0.5)
    right.set_xlim(left=0)
    right.set_xlabel("share of the squared error, % (line: 90 % interval)")
    for axis in (left, right):
        axis.grid(axis="y", visible=False)
    fig.tight_layout()
    return fig


if __name__ == "__main__":
    draw("causes", figure)
