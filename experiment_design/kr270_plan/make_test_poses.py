"""Draws the twenty invented test poses of this study: four at each level of joint 2.

The paper's test pose is not published.  These are drawn once, from what the work cell allows
under load, and then stand in test_poses.csv.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from elastocal.cell.work_cell import read_cell
from elastocal.model.choice import load_chain
from elastocal.planning.candidates import joint_space, sobol
from elastocal.planning.feasibility import Feasibility

HERE = Path(__file__).parent
PER_LEVEL = 4
SEED = 20


def main() -> None:
    cell = read_cell(HERE / "work_cell.toml")
    chain = load_chain(cell)
    feasibility = Feasibility(cell, chain)
    space = joint_space(cell, chain)
    streams = np.random.SeedSequence(SEED).spawn(space.n_groups)
    lines = ["q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg"]
    for group, stream in enumerate(streams):
        q = next(iter(sobol(space, group, stream)))
        for force in cell.design.loads:
            q = q[feasibility.check(q, force).ok]
        lines += [",".join(f"{v:.2f}" for v in np.degrees(pose)) for pose in q[:PER_LEVEL]]
    (HERE / "test_poses.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
