"""The noise floor as the report states it."""

from __future__ import annotations

import numpy as np

from elastocal.diagnosis.noise import NoiseValues, NoisyData
from elastocal.diagnosis.result import NoiseFloor
from elastocal.diagnosis.scene import Scene
from elastocal.diagnosis.screen import describe_faulty


def noise_floor(scene: Scene, data: NoisyData, noise: NoiseValues) -> NoiseFloor:
    """Tracker noise, repeatability, shared scatter, pure error and faulty readings."""
    used = ~data.left_out
    variance = np.diagonal(data.covariance, axis1=1, axis2=2)[used]
    return NoiseFloor(
        data.stated, noise.factor, float(noise.factor * np.sqrt(variance.mean())),
        tuple(float(s) for s in noise.joint), noise.shared, pure_error(scene),
        describe_faulty(scene, data, noise),
    )  # fmt: skip


def pure_error(scene: Scene) -> float | None:
    """Scatter in m per axis among repeats of the same pose, load and marker; None without any."""
    seen, table = scene.base.seen, scene.base.seen.table
    out = scene.data.faulty
    rows = seen.lead[~out]
    force = np.round(table.force[rows], 6)
    key = np.column_stack([table.configuration[rows], table.marker[rows], force])
    _, group, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    group = group.ravel()
    repeated = count[group] > 1
    if not repeated.any():
        return None
    values = seen.value.reshape(-1, seen.size)[~out][:, : min(seen.size, 3)]
    mean = np.zeros((len(count), values.shape[1]))
    np.add.at(mean, group, values)
    mean /= count[:, None]
    squares = ((values - mean[group])[repeated] ** 2).sum()
    dof = (count[count > 1] - 1).sum() * values.shape[1]
    return float(np.sqrt(squares / dof))
