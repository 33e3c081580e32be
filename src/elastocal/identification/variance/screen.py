"""A first guess at the faulty readings, from a robust fit: where the search for them starts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from elastocal.identification.variance.readings import Readings

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

OWN_SCALE = 6  # readings that a group needs for a median and a scale of its own
MOVED = 1 / 3  # share of a configuration's readings
LIMIT = 5.0  # robust standard deviations; the verdict that follows takes back what it can explain


def screen(readings: Readings, residual: Array, good: Mask | None = None) -> Mask:
    """Readings (N,) whose residual (N, size) from a robust fit lies with the others.

    Each component is compared with the median and the median absolute deviation of its
    configuration (under its load), where that holds enough readings; else with zero and the
    deviation of the `good` readings (N,) of the whole table (default all).  Where noise is stated,
    residuals count in units of it.

    What moves a configuration or a marker in it as a whole moves its median too: readings that are
    not `good` stay out where they make up a third of their configuration.
    """
    if readings.stated is not None:
        residual = residual / np.sqrt(np.diagonal(readings.stated, axis1=1, axis2=2))
    table = _scale(np.abs(residual if good is None else residual[good]))
    deviation, scale = np.abs(residual), np.broadcast_to(table, residual.shape).copy()
    key = np.column_stack([readings.configuration, readings.load])
    _, group, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(group.ravel(), kind="stable")
    starts = np.concatenate([[0], np.cumsum(count)[:-1]])
    for n in np.unique(count[count >= OWN_SCALE]):
        members = order[starts[count == n, None] + np.arange(n)]  # (groups, n)
        r = residual[members]
        deviation[members] = np.abs(r - np.median(r, axis=1, keepdims=True))
        scale[members] = _scale(deviation[members], axis=1)[:, None]
    # A group that happens to agree is no reason to suspect the one reading that differs a little.
    scale = np.maximum(scale, 0.2 * table)
    near = (deviation <= LIMIT * scale).all(axis=1)
    if good is None:
        return np.asarray(near)
    share = np.bincount(group.ravel(), ~good)[group.ravel()] / count[group.ravel()]
    return np.asarray(near & (good | (share < MOVED)))


def _scale(deviation: Array, axis: int = 0) -> Array:
    return np.median(deviation, axis=axis) / stats.norm.ppf(0.75)
