"""The extra visits as one would make them: a short way through the poses, all loads at each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import count, islice

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.separate.pool import Pool, time_step
from elastocal.measurements import Measurements

Array = NDArray[np.float64]


def measuring_order(pool: Pool, chosen: Sequence[int], table: Measurements) -> Measurements:
    """One row per visit of the chosen candidates, after the campaign of `table`.

    What is to be measured later comes later; otherwise the nearest pose in joint space is next.
    A pose is measured in all load states before the arm moves on, so that what drifts does not
    pass for an effect of the load.
    """
    order = _tour(pool, list(chosen), table.q[-1])
    L, markers = len(pool.forces), len(table.marker_names)
    first_rows = [(k * L + load) * markers for k in order for load in range(L)]
    taken = set(table.configuration_labels)
    fresh = (name for k in count(1) if (name := f"extra{k}") not in taken)
    rows = pool.table.take(np.array(first_rows))
    time = rows.time
    if time is not None:
        # Each group of visits begins when it should and takes as long as visits usually do.
        begun = np.searchsorted(time, time, side="left")
        time = time + (np.arange(len(rows)) - begun) * time_step(table)
    return replace(
        rows, source="extra poses", row=np.arange(len(rows)) + 2,
        configuration=np.repeat(np.arange(len(order)), L),
        configuration_labels=tuple(islice(fresh, len(order))),
        position=None, rotation=None, distance=None, torque=None, sigma=None, temperature=None,
        time=time,
    )  # fmt: skip


def _tour(pool: Pool, chosen: list[int], start: Array) -> list[int]:
    """Nearest next, among those that are due first."""
    out: list[int] = []
    at, left = start, list(chosen)
    while left:
        due = left if pool.time is None else [k for k in left if pool.time[k] == _first(pool, left)]
        nearest = min(due, key=lambda k: float(np.abs(pool.q[k] - at).max()))
        out.append(nearest)
        left.remove(nearest)
        at = pool.q[nearest]
    return out


def _first(pool: Pool, left: list[int]) -> float:
    assert pool.time is not None
    return float(pool.time[left].min())
