"""Markers that are no readings of their own: copies of another one, points of a solved body."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from elastocal.measurements import Measurements, visits
from elastocal.text import listed
from elastocal.units import Array

FEWEST_VISITS = 3  # in which two markers have to agree: two may by chance of a fixed arm
# Scatter of the distance of two markers (m) that no instrument is below which reads each for
# itself; software of motion capture moves a rigid body to all its markers and writes that.
SOLVED = 2e-6
CLEARLY_LESS = 10.0  # times the scatter, from which the readings' error is not that of the points


def without_copies(table: Measurements) -> tuple[Measurements, tuple[str, ...]]:
    """The table without markers that repeat another one's readings to the last digit, and a
    sentence for each."""
    if table.position is None or len(table.marker_names) < 2:
        return table, ()
    points, told = _by_visit(table), []
    copies: set[int] = set()
    for a, b in combinations(range(len(table.marker_names)), 2):
        both = np.isfinite(points[:, [a, b], 0]).all(axis=1)
        if a in copies or both.sum() < FEWEST_VISITS:
            continue
        if (points[both, a] == points[both, b]).all():
            copies.add(b)
            one, other = table.marker_names[a], table.marker_names[b]
            told.append(
                f"marker {other} has the readings of {one} in all {both.sum()} visits: it was left "
                f"out. Look for the column that was copied, and bring the readings of {other}"
            )
    if not copies:
        return table, ()
    return table.take(~np.isin(table.marker, list(copies))), tuple(told)


def solved_body(table: Measurements, error: float) -> str | None:
    """That three or more markers are points of one solved body, where they are; `error` (m) is the
    rms of a reading's residual per axis."""
    if table.position is None or len(table.marker_names) < 3:
        return None
    points = _by_visit(table)
    points = points[np.isfinite(points[:, :, 0]).sum(axis=1) >= 3]
    if len(points) < FEWEST_VISITS:
        return None
    pairs = np.array(list(combinations(range(points.shape[1]), 2)))
    apart = np.linalg.norm(points[:, pairs[:, 0]] - points[:, pairs[:, 1]], axis=2)
    used = np.isfinite(apart).sum(axis=0) >= FEWEST_VISITS
    if not used.any():
        return None
    scatter = float(np.sqrt(np.nanvar(apart[:, used], axis=0).max()))
    if scatter > SOLVED or error < CLEARLY_LESS * scatter:
        return None
    names = [table.marker_names[m] for m in np.unique(pairs[used])]
    within = max(scatter * 1e6, 0.01)
    return (
        f"markers {listed(names)} keep their distances to within {within:.2g} µm: they are "
        "points of one solved rigid body. A visit carries its pose, six independent "
        f"numbers and not {3 * len(names)}: import the body's pose and set [model] observe = "
        '"pose", or keep one marker'
    )


def _by_visit(table: Measurements) -> Array:
    """Positions (visits, markers, 3) of the first reading of each; NaN where there is none."""
    assert table.position is not None
    visit = visits(table)
    out = np.full((int(visit.max(initial=-1)) + 1, len(table.marker_names), 3), np.nan)
    out[visit[::-1], table.marker[::-1]] = table.position[::-1]
    return out
