"""Poses that had no part in a fit: those that another campaign of the same kind might visit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.baseline import visits
from elastocal.manipulator.model import Model
from elastocal.measurements import Measurements

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

CANDIDATES = 10  # times as many poses as are wanted
ROUNDS, HEAVIEST = 20, 20.0  # of raking, and how many times the mean weight a pose may count


def fresh_table(
    model: Model, table: Measurements, n: int, rng: np.random.Generator
) -> Measurements:
    """n fresh configurations like those of the table.

    Each repeats the load states, repeats and markers of one that was measured.  Every joint's
    angle (with the side it came from, and the torque at it) is that of another one drawn at
    random, independently of the other joints, and all markers stay inside the box that the
    measured ones show: floor and fixtures keep fresh poses out of the same regions (unless
    hardly any is inside).  Of those, angles that lead out of the box more often are chosen more
    often, until every joint is as far from its middle as it was in the campaign.  Times are
    uniform over the campaign's.  Readings are left as they are and mean nothing.
    """
    drawn, donors = _recombined(table, CANDIDATES * n, rng)
    low, high = _box(model.target_poses(table)[1], table.configuration)
    at = model.target_poses(drawn)[1]
    outside = ((at < low) | (at > high)).any(axis=1)
    inside = np.setdiff1d(drawn.configuration, drawn.configuration[outside])
    if len(inside) < n:
        inside = np.unique(drawn.configuration)
    chosen = rng.choice(inside, n, replace=False, p=_raked(donors[inside]))
    return drawn.take(np.isin(drawn.configuration, chosen))


def _raked(donors: Labels) -> Array:
    """Probabilities (n,) of poses so that each donor of a joint's angle, `donors` (n, joints), is
    as probable as the others: raking (Deming and Stephan 1940, Ann. Math. Stat. 11)."""
    weight = np.full(len(donors), 1 / len(donors))
    for _ in range(ROUNDS):
        for of_joint in donors.T:
            share = np.bincount(of_joint, weight)
            wanted = 1 / np.count_nonzero(share)
            weight *= (wanted / np.where(share > 0, share, 1.0))[of_joint]
        weight = np.minimum(weight, HEAVIEST / len(weight))
        weight /= weight.sum()
    return weight


def _box(at: Array, configuration: Labels) -> tuple[Array, Array]:
    """Ends (3,) of the box that positions `at` (n_rows, 3) were drawn from.

    n draws leave a part of 1/(n + 1) beyond each end on average, as long as the step from the last
    configuration to the one before it; without it the poses that err most would be missing.
    """
    codes = np.unique(configuration)
    low = np.sort([at[configuration == c].min(axis=0) for c in codes], axis=0)
    high = np.sort([at[configuration == c].max(axis=0) for c in codes], axis=0)
    return 2 * low[0] - low[min(1, len(low) - 1)], 2 * high[-1] - high[max(-2, -len(high))]


def _recombined(
    table: Measurements, n: int, rng: np.random.Generator
) -> tuple[Measurements, Labels]:
    """n poses, and which measured configuration (n, joints) each joint's angle is from."""
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
    donors = rng.integers(len(codes), size=(n, table.q.shape[1]))
    for j, of_joint in enumerate(donors.T):
        of = [rows_of[k] for k in of_joint]
        source = np.array(
            [of[c][i % len(of[c])] for c, i in zip(configuration, place, strict=True)]
        )
        for name, values in own.items():
            values[:, j] = getattr(table, name)[source, j]
    if table.time is None:
        return fresh, donors
    at = visits(fresh)
    time = rng.uniform(table.time.min(), table.time.max(), at.max() + 1)[at]
    warmth = None
    if table.temperature is not None:
        order = np.argsort(table.time)
        warmth = np.interp(time, table.time[order], table.temperature[order])
    return replace(fresh, time=time, temperature=warmth), donors
