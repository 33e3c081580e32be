"""A small valid campaign on disk, to be spoilt one way at a time."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from support.robots import KR270

CELL = """\
[robot]
urdf = "arm.urdf"

[tool.markers_m]
M1 = [0.2, 0.05, 0.1]

[model]
effects = ["base_frame", "joint_offset", "marker_position"]
"""


def write_campaign(folder: Path, poses: int = 12) -> tuple[Path, Path]:
    """cell.toml, arm.urdf and an exact data.csv (degrees, millimetres) in `folder`."""
    from support.cells import random_poses, table_of

    from elastocal.cell.work_cell import read_cell
    from elastocal.model.manipulator import Model

    shutil.copyfile(KR270, folder / "arm.urdf")
    cell = folder / "cell.toml"
    cell.write_text(CELL, encoding="utf-8")
    model = Model(read_cell(cell))
    q = random_poses(model.chain, poses, seed=4)
    position = model.predict(table_of(q, np.zeros(3), ("M1",))).reshape(-1, 3)
    rng = np.random.default_rng(5)
    rows = np.hstack([np.degrees(q), (position + 1e-5 * rng.normal(size=position.shape)) * 1e3])
    header = [*(f"q{i + 1}_deg" for i in range(6)), "x_mm", "y_mm", "z_mm"]
    lines = [",".join(header), *(",".join(f"{v:.6f}" for v in row) for row in rows)]
    data = folder / "data.csv"
    data.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return cell, data
