"""The misfit over the compliances of joints 4 and 6: with a stretched wrist, and with one bent."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from style import ROOT, Colours, draw, plt

from elastocal.cell import read_cell
from elastocal.measurements import read_measurements
from elastocal.model.manipulator import Model
from elastocal.simulation import expand_plan, simulate, values_from

TUTORIAL = ROOT / "docs" / "tutorial"
TRUTH = {
    f"joint{i}.compliance": k
    for i, k in enumerate((1.8e-6, 2.1e-6, 3.4e-6, 1.2e-5, 1.5e-5, 2.2e-5), 1)
}
LOAD = np.array([0.0, 0.0, -98.0])
SIGMA = 10e-6 * np.sqrt(2.0)  # m, of a deflection's coordinate
BENT = np.deg2rad([22.96, 85.78, -125.42, 55.78, -74.89, 288.89])  # the pose that design chose


def misfit(model: Model, bent: bool) -> np.ndarray:
    """Information (2, 2) on the compliances of joints 4 and 6 where the others are fitted too."""
    plan = read_measurements(TUTORIAL / "poses.csv", joint_kinds=model.chain.kinds, observe="plan")
    truth = values_from(model, TRUTH)
    found = np.zeros((len(truth), len(truth)))
    poses = [plan.take(np.arange(len(plan)))]
    if bent:
        poses.append(replace(plan.take(np.array([0])), q=BENT[None, :]))
    for some in poses:
        rows = expand_plan(some, tuple(model.cell.tool.markers), 3, LOAD)
        table = simulate(model, rows, truth, np.random.default_rng(0), noise=False)
        B = model.regressor(table, truth).B / SIGMA
        found += B.T @ B
    names = list(model.names)
    two = [names.index("joint4.compliance"), names.index("joint6.compliance")]
    rest = [i for i in range(1, len(names)) if i not in two]  # joint 1 is seen by no pose
    across = found[np.ix_(two, rest)]
    return found[np.ix_(two, two)] - across @ np.linalg.solve(found[np.ix_(rest, rest)], across.T)


def figure(colours: Colours) -> Figure:
    model = Model(read_cell(Path(TUTORIAL / "cell.toml")))
    fig, axes = plt.subplots(1, 2, figsize=(8.4, 3.9), sharex=True, sharey=True)
    k = np.linspace(0.0, 40.0, 401)
    x, y = np.meshgrid(k, k)
    off = np.stack([x - 12.0, y - 22.0], axis=-1) * 1e-6
    for axis, bent in zip(axes, (False, True), strict=True):
        information = misfit(model, bent)
        away = np.sqrt(np.einsum("...i,ij,...j", off, information, off).clip(0.0))
        axis.contourf(x, y, away, [-1, 2], colors=[colours.one], alpha=0.35)
        axis.contour(x, y, away, [2, 6, 18], colors=[colours.one], linewidths=1.1)
        axis.plot(12, 22, "x", color=colours.two, markersize=9, markeredgewidth=2.2)
        axis.set_xlabel("compliance of joint 4, µrad/(N·m)")
        axis.set_aspect("equal")
        title = "eight poses and a ninth, q5 = −75°" if bent else "eight poses, q5 = 0"
        axis.set_title(title, fontsize=10.5)
    axes[0].set_ylabel("compliance of joint 6, µrad/(N·m)")
    axes[0].annotate(
        "any split of the sum fits", (27, 7), (21, 31), color=colours.text,
        arrowprops={"arrowstyle": "->", "color": colours.text},
    )  # fmt: skip
    fig.tight_layout()
    return fig


if __name__ == "__main__":
    draw("tutorial_valley", figure)
