"""Between a fit and its noise: readings linearised at the fit, weights from an estimated noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from elastocal.errors import InputError
from elastocal.identification.noise import Weights, block_diagonal, stated_covariance, whitener
from elastocal.identification.variance.choose import NoiseFit
from elastocal.identification.variance.judge import own_noise
from elastocal.identification.variance.readings import Readings
from elastocal.manipulator.model import Model
from elastocal.manipulator.observation import Observations
from elastocal.tracker_noise import available_noise, polar_axes

Array = NDArray[np.float64]


def linearised(model: Model, seen: Observations, x: Array, columns: NDArray[np.int64]) -> Readings:
    """Residuals and B of the `columns` at x (parameters,), with the labels of each observation."""
    at = model.regressor(seen.table, x, columns, seen)
    n, size = len(seen.lead), seen.size
    table = seen.table
    force = np.round(table.force[seen.lead], 6)
    load = np.unique(force, axis=0, return_inverse=True)[1].ravel()
    sight, reach = _sight(model, seen)
    return Readings(
        at.B.reshape(n, size, -1), at.residual.reshape(n, size), table.configuration[seen.lead],
        load, table.marker[seen.lead], sight, reach, _stated(model, seen),
        table, seen.lead,
    )  # fmt: skip


def weights_of(noise: NoiseFit, readings: Readings) -> Weights:
    """Weights of the readings (N,) under an estimated noise; whitened residuals have size 1."""
    size = readings.size
    covariance = block_diagonal(own_noise(noise.fit, readings)[0])
    for effect, variance in zip(noise.fit.shared, noise.fit.common, strict=True):
        if variance <= 0:
            continue
        key = np.column_stack([getattr(readings, label) for label in effect.by])
        unit = np.unique(key, axis=0, return_inverse=True)[1].ravel()
        place = (np.ones(len(unit)), (np.arange(len(unit)), unit))
        Z = sparse.csr_array(place, shape=(len(unit), unit.max() + 1))
        axes = sparse.dia_array((effect.axes[None], [0]), shape=(size, size))
        covariance = covariance + variance * sparse.kron(Z @ Z.T, axes, format="csr")
    return Weights(noise.kind, whitener(sparse.csr_array(covariance)), True, noise.description)


def _sight(model: Model, seen: Observations) -> tuple[Array | None, Array | None]:
    """Axes along and across the line of sight (N, 3, 3) and its length (N,), where it is known."""
    position = seen.table.position
    if position is None or seen.size != 3:
        return None, None
    offset = position[seen.lead] - model.cell.tracker.position
    reach = np.linalg.norm(offset, axis=1)
    if not (reach > 0).all():
        return None, None
    return polar_axes(offset), reach


def _stated(model: Model, seen: Observations) -> Array | None:
    """Stated covariance (N, size, size) of each observation, None where none is stated.

    Observations that share a reading are correlated; here each stands for itself.
    """
    kind = available_noise(seen.table, model.cell.tracker)
    if kind == "none" and seen.kind != "distance":
        return None
    try:
        rows = stated_covariance(seen, model.cell.tracker, kind)[0]
    except InputError:
        return None
    n = len(seen.lead)
    squared = sparse.csr_array(seen.combine.power(2))
    return (squared @ rows.reshape(len(rows), -1)).reshape(n, seen.size, seen.size)
