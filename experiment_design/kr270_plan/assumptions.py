"""How much the bound leaves below Table 2, under other tools and test poses than the study's.

    .venv/bin/python experiment_design/kr270_plan/assumptions.py

Tool, markers and test pose of the paper are not published, so the margin between Table 2 and the
best possible plan is a range, not a number.  Joint limits alone; writes assumptions.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from compared import HERE, table_2

from elastocal.cell.arm_description import Tool
from elastocal.cell.plan_wishes import TargetPose
from elastocal.cell.work_cell import Cell, read_cell
from elastocal.model.manipulator import Model
from elastocal.planning.candidates import draw, joint_space, shares_of
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.information import plan_forces
from elastocal.planning.relaxation import relax
from elastocal.planning.setup import Known, set_up
from elastocal.planning.test_poses import test_poses

CANDIDATES = 20_000
SETS = 5  # sets of twenty test poses, drawn over the joint limits
AROUND = {"M1": (0.25, 0.0, 0.0), "M2": (-0.1, 0.2, 0.11), "M3": (-0.1, -0.2, 0.11)}
TOOLS = {
    "load at (0.20, 0, 0.25) m, three markers 0.25 m about the flange": ((0.20, 0.0, 0.25), AROUND),
    "load at (0.05, 0, 0.60) m, the same markers": ((0.05, 0.0, 0.60), AROUND),
    "load at (0.40, 0, 0) m, the same markers": ((0.40, 0.0, 0.0), AROUND),
    "load at (0.20, 0, 0.25) m, one marker 0.25 m beside the flange": (
        (0.20, 0.0, 0.25),
        {"M1": (0.25, 0.0, 0.0)},
    ),
    "load at (0.20, 0, 0.25) m, one marker at the load point": (
        (0.20, 0.0, 0.25),
        {"M1": (0.20, 0.0, 0.25)},
    ),
}


def main() -> None:
    cell = read_cell(HERE / "joint_limits.toml")
    lines = [
        "# How far Table 2 is from the best possible plan",
        "",
        f"`assumptions.py`: ρ₀ of Table 2 over the certified bound on ρ₀ (pool of {CANDIDATES}, "
        f"three poses per level), for {SETS} sets of twenty test poses drawn over the limits.",
        "",
        "| tool | ρ₀ of Table 2 over the bound | efficiency of Table 2 |",
        "|---|---|---|",
    ]
    for name, (load, markers) in TOOLS.items():
        tool = Tool(np.array(load), {k: np.array(v) for k, v in markers.items()})
        ratio = np.array(margins(replace(cell, tool=tool)))
        lines.append(
            f"| {name} | {ratio.min():.2f} to {ratio.max():.2f} | "
            f"{1 / ratio.max() ** 2:.2f} to {1 / ratio.min() ** 2:.2f} |"
        )
        print(lines[-1], flush=True)
    (HERE / "assumptions.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def margins(cell: Cell) -> list[float]:
    """ρ₀ of Table 2 over the bound, for each set of test poses."""
    model, forces = Model(cell), plan_forces(cell)
    space = joint_space(cell, model.chain)
    drawn = draw(cell, model.chain, forces, Feasibility(cell, model.chain), CANDIDATES, 0)
    found = []
    for seed in range(SETS):
        rng = np.random.default_rng(seed)
        q = np.concatenate([space.poses(rng.uniform(size=(4, 5)), level) for level in range(5)])
        spec = replace(cell.design, test_poses=tuple(TargetPose(pose) for pose in q))
        targets = test_poses(replace(cell, design=spec), model.chain)
        setup = set_up(model, drawn.q, 15, targets, Known())
        pool = setup.pool(drawn.q, drawn.group)
        bound = relax(setup.problem(pool, shares_of(cell))).bound
        found.append(float(np.sqrt(setup.value(table_2(model)) / bound)))
    return found


if __name__ == "__main__":
    main()
