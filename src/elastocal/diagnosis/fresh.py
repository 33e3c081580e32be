"""Poses that had no part in a fit: those that another campaign of the same kind might visit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.baseline import visits
from elastocal.manipulator.model import Model
from elastocal.measurements import Measurements

Array = NDArray[np.float64]

CANDIDATES = 6  # times as many poses as are wanted


def fresh_table(
    model: Model, table: Measurements, n: int, rng: np.random.Generator
) -> Measurements:
    """n fresh configurations like those of the table.

    Each repeats the load states, repeats and markers of one that was measured.  Every joint's
    angle (with the side it came from, and the torque at it) is that of another one drawn at
    random, independently of the other joints, and all markers stay inside the box that the
    measured ones span: floor and fixtures keep fresh poses out of the same regions (unless
    hardly any is inside).  Times are uniform over the campaign's.  Readings are left as they are
    and mean nothing.
    """
    drawn = _recombined(table, CANDIDATES * n, rng)
    low, high = (end(model.target_poses(table)[1], axis=0) for end in (np.min, np.max))
    at = model.target_poses(drawn)[1]
    outside = ((at < low) | (at > high)).any(axis=1)
    inside = np.setdiff1d(drawn.configuration, drawn.configuration[outside])
    if len(inside) < n:
        inside = np.unique(drawn.configuration)
    return drawn.take(np.isin(drawn.configuration, inside[:n]))


def _recombined(table: Measurements, n: int, rng: np.random.Generator) -> Measurements:
    codes = np.unique(table.configuration)
    rows_of = [np.flatnonzero(table.configuration == c) for c in codes]
    chosen = [rows_of[k] for k in rng.integers(len(codes), size=n)]
    rows = np.concatenate(chosen)
    configuration = np.repeat(np.arange(n), [len(r) for r in chosen])
    labels = tuple(str(c + 1) for c in range(n))
    fresh = replace(table.take(rows), configuration=configuration, configuration_labels=labels)
    place = np.concatenate([np.arange(len(r)) for r in chosen])
    own = {
        name: getattr(fresh, name)
        for name in ("q", "approach", "torque")
        if getattr(fresh, name) is not None
    }
    for j in range(table.q.shape[1]):
        donors = [rows_of[k] for k in rng.integers(len(codes), size=n)]
        source = np.array(
            [donors[c][i % len(donors[c])] for c, i in zip(configuration, place, strict=True)]
        )
        for name, values in own.items():
            values[:, j] = getattr(table, name)[source, j]
    if table.time is None:
        return fresh
    at = visits(fresh)
    time = rng.uniform(table.time.min(), table.time.max(), at.max() + 1)[at]
    warmth = None
    if table.temperature is not None:
        order = np.argsort(table.time)
        warmth = np.interp(time, table.time[order], table.temperature[order])
    return replace(fresh, time=time, temperature=warmth)
