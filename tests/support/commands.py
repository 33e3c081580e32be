"""Calibrated arms to command, and where the model itself says that their tool goes."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from elastocal.cell.work_cell import Cell
from elastocal.compensation.compensate import Compensation
from elastocal.measurements import Measurements
from elastocal.model.calibrated import CalibratedArm
from elastocal.model.chain import Chain
from elastocal.model.manipulator import Model
from elastocal.units import Array


def calibrated(chain: Chain, cell: Cell, x: Array | None = None, std: float = 0.0) -> CalibratedArm:
    """The arm at values x (default nominal), every parameter determined with `std` times its
    typical size."""
    model = Model.assembled(chain, cell)
    sizes = np.array([p.typical or abs(p.nominal) or 1.0 for p in model.parameters])
    values = model.nominal if x is None else x
    return CalibratedArm(model, values, model.names, np.diag((std * sizes) ** 2), "result.json")


def erring(model: Model, rng: np.random.Generator, scale: float = 1.0) -> Array:
    """Every parameter off its nominal value by `scale` of its typical size."""
    sizes = np.array([p.typical or 0.2 * abs(p.nominal) for p in model.parameters])
    return model.nominal + scale * sizes * rng.choice([-1.0, 1.0], len(sizes))


def circumstances(n: int, joints: int, rng: np.random.Generator) -> dict[str, Any]:
    """Columns of a table of targets that some effects ask for."""
    return {
        "time": np.sort(rng.uniform(0.0, 7200.0, n)),
        "approach": rng.choice([-1.0, 1.0], (n, joints)),
        "temperature": rng.uniform(18.0, 26.0, n),
    }


def tool_errors(arm: CalibratedArm, found: Compensation, marker: str = "M1") -> tuple[Array, Array]:
    """Distance in m and angle in rad (n,) of the marker from the targets, as `Model` has it.

    By the model that identification predicts with, not by the expressions that commands are
    sought with.
    """
    n = len(found.q)
    names = tuple(arm.model.cell.tool.markers)
    table = found.targets.table
    rows = Measurements(
        source="commands",
        row=np.arange(n),
        q=found.q,
        configuration=np.arange(n),
        configuration_labels=tuple(map(str, range(n))),
        repeat=np.zeros(n, dtype=np.int64),
        marker=np.full(n, names.index(marker)),
        marker_names=names,
        force=found.force,
        rotation=np.zeros((n, 3)),
        time=table.time,
        approach=table.approach,
        temperature=table.temperature,
    )
    rotation, position = arm.model.target_poses(rows, arm.x)
    miss = np.linalg.norm(position - found.goals.position, axis=1)
    if found.goals.rotation is None:
        return miss, np.zeros(n)
    turned = Rotation.from_matrix(found.goals.rotation.transpose(0, 2, 1) @ rotation)
    return miss, turned.magnitude()
