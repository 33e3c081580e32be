"""Does identification reach the Cramér–Rao bound, started from nothing?

    elastocal study experiment_design/cramer_rao

UR10 and KR 270-2 with 1 mm / 1 mrad random geometry errors (six per link and joint offsets), a
tracker anywhere at any attitude, an unknown marker, 0.05 mm noise, 30 to 1000 random poses.
Reported: position error on 200 noise-free held-out poses, root mean square over poses and seeds,
beside the Cramér–Rao prediction √(mean tr(B_t (BᵀB)⁻¹ B_tᵀ) σ²) of the minimal complete set at
the true parameters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib import metadata
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from elastocal.cell.arm_description import EffectChoice, ModelSpec, Robot, Tool
from elastocal.cell.work_cell import Cell
from elastocal.identification.identify import identify
from elastocal.identification.solve import reduce
from elastocal.measurements import Measurements
from elastocal.model.chain import Chain
from elastocal.model.manipulator import Model
from elastocal.model.urdf import read_urdf

ARMS = ("UR10", "KR 270-2")
EFFECTS = ("base_frame", "joint_offset", "link_geometry", "marker_position")
SIGMA = 5e-5
SIZES = (30, 100, 300, 1000)
TEST_POSES = 200


def tasks(options: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for arm in ARMS:
        for poses in SIZES:
            for draw in range(options["draws"]):
                yield {"arm": arm, "poses": poses, "draw": draw}


def chain_of(name: str) -> Chain:
    if name == "KR 270-2":
        return read_urdf(Path(str(files("elastocal.demo") / "kr270_2.urdf")))
    # From PyPI: pip install example-robot-data
    package = metadata.distribution("example-robot-data")
    ending = "ur_description/urdf/ur10_robot.urdf"
    path = next(f for f in package.files or () if str(f).endswith(ending))
    return read_urdf(Path(str(package.locate_file(path))), base="base_link", flange="tool0")


def random_table(chain: Chain, n: int, rng: np.random.Generator) -> Measurements:
    low = np.array([max(j.lower, -np.pi) for j in chain.joints])
    high = np.array([min(j.upper, np.pi) for j in chain.joints])
    return Measurements(
        source="simulated", row=np.arange(n) + 2, q=rng.uniform(low, high, (n, len(low))),
        configuration=np.arange(n), configuration_labels=tuple(map(str, range(n))),
        repeat=np.zeros(n, np.int64), marker=np.zeros(n, np.int64), marker_names=("M1",),
        force=np.zeros((n, 3)), position=np.zeros((n, 3)),
    )  # fmt: skip


def true_values(model: Model, rng: np.random.Generator) -> np.ndarray:
    x = model.nominal.copy()
    turn = Rotation.random(rng=rng).as_rotvec()
    for i, p in enumerate(model.parameters):
        if p.effect in ("joint_offset", "link_geometry"):
            x[i] += 1e-3 * rng.normal()
        elif p.name in ("base.x", "base.y", "base.z"):
            x[i] = 2.0 * rng.normal()
        elif p.effect == "base_frame":
            x[i] = turn["xyz".index(p.name[-1])]
    return x


def run(task: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Mean square error and its prediction, and the number of fitted parameters.  The draws follow
    from the task's own numbers, as they did before this study had others: `rng` is not used."""
    n = task["poses"]
    rng = np.random.default_rng([task["draw"], n])
    chain = chain_of(task["arm"])
    effects = tuple(EffectChoice(e) for e in EFFECTS)
    tool = Tool(markers={"M1": np.array([0.05, 0.08, 0.12])})
    cell = Cell(task["arm"], None, Robot(), tool, model=ModelSpec(effects=effects))
    arm = Model.assembled(chain, cell)
    x = true_values(arm, rng)
    table, test = random_table(chain, n, rng), random_table(chain, TEST_POSES, rng)
    exact = arm.predict(table, x).reshape(-1, 3)
    table = replace(table, position=exact + SIGMA * rng.normal(size=exact.shape))
    blank = replace(cell, tool=Tool(markers={"M1": np.zeros(3)}))
    found = identify(Model.assembled(chain, blank), table)
    error = (arm.predict(test, found.x) - arm.predict(test, x)).reshape(-1, 3)
    B = arm.regressor(table, x).B
    sizes = arm.sizes(B)
    # The minimal complete set is a property of the nominal arm, not of one draw of errors.
    many = arm.regressor(random_table(chain, 400, rng)).B
    kept = reduce(many, sizes, arm.parameters, 1.0, 0.0).kept
    information = (B[:, kept] * sizes[kept]).T @ (B[:, kept] * sizes[kept])
    B_test = arm.regressor(test, x, kept).B * sizes[kept]
    spread = np.einsum("ij,ji->", B_test, np.linalg.solve(information, B_test.T))
    return {
        "squared_error": float((error**2).sum() / TEST_POSES) * 1e6,
        "bound": float(spread * SIGMA**2 / TEST_POSES) * 1e6,
        "fitted": len(found.determined),
    }


def summary(frame: pd.DataFrame) -> str:
    lines = [
        "| arm | poses | fitted | error on held-out poses (mm) | Cramér–Rao (mm) | ratio |",
        "|---|---|---|---|---|---|",
    ]
    for (arm, poses), rows in frame.groupby(["arm", "poses"], sort=False):
        error, bound = (np.sqrt(rows[key].mean()) for key in ("squared_error", "bound"))
        fitted = "–".join(str(v) for v in sorted(set(rows["fitted"])))
        lines.append(
            f"| {arm} | {poses} | {fitted} | {error:.4f} | {bound:.4f} | {error / bound:.3f} |"
        )
    return "\n".join(lines)
