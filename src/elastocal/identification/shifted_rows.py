"""Readings that have slipped against the joint values beside them, from some rows on.

A reading that is missing lets all later ones close up.  Row r then holds the reading of row r + s_r
with s_r constant in blocks.  A block that is long enough places base and markers by itself; then

    minimise  Σ_r min(|p_r − x(q_{r+s_r})| / τ, 1) + λ · (number of changes of s)

over all s is a shortest path through rows and shifts (Viterbi 1967), and base and markers follow
from all rows again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from elastocal.identification.joint_maps import linear_fits
from elastocal.identification.start import Registration
from elastocal.measurements import Measurements
from elastocal.model.chain import Chain
from elastocal.model.rigid import nominal_flanges
from elastocal.units import Array, IntArray

NEAR, NEAREST = 0.06, 0.005  # m: τ is six times the error of a block, within these
CHANGE = 1.5  # λ: a block is there from two rows on, and one stray row makes none
FARTHEST = 6  # visits that readings are looked for away from their row
BLOCK, WINDOWS = 8, 16  # visits that place base and markers, and how many such blocks are tried
PLACED = 6  # of these, tried in earnest
FITS = 0.8  # share of the rows that must fit, so that it is an explanation
FEWEST = 4  # visits to a block, on average
MOST_ROWS = 20_000
Place = Callable[[Measurements], Registration]


@dataclass(frozen=True)
class Slipped:
    """Blocks of rows, each by its first row and the shift of its readings in rows and in visits
    (None where it differs), and the median distance `error` in m of readings from the nominal arm
    then."""

    starts: tuple[int, ...]
    rows: tuple[int, ...]
    visits: tuple[int | None, ...]
    error: float


def slipped(chain: Chain, table: Measurements, place: Place) -> Slipped | None:
    """Where readings slipped, in the order of the rows; None where no few shifts explain them.

    `place` finds base and markers by a table.
    """
    visit = np.cumsum(np.r_[0, np.any(np.diff(table.q, axis=0) != 0, axis=1)])
    visits = int(visit[-1]) + 1
    if visits < BLOCK or len(table) > MOST_ROWS:
        return None
    most = FARTHEST * max(round(len(table) / visits), 1)
    shifts = np.arange(-most, most + 1)
    flange, rows = nominal_flanges(chain, table.q), np.arange(len(table))
    for block, s in _blocks(table, flange, visit, shifts):
        found = place(_moved(table, block, s))
        if found.error <= NEAR / 2:
            break
    else:
        return None
    path = np.zeros(0, dtype=np.int64)
    for _ in range(3):
        distance = _distances(found, table, flange, shifts)
        path = _path(distance / np.clip(6 * found.error, NEAREST, NEAR))
        moved = shifts[path]
        inside = (rows + moved >= 0) & (rows + moved < len(rows))
        found = place(_moved(table, rows[inside], moved[inside]))
    own, moved = distance[rows, path], shifts[path]
    starts = np.flatnonzero(np.r_[True, np.diff(moved) != 0])
    good = own <= NEAR
    if good.mean() < FITS or len(starts) * FEWEST > visits or not moved.any():
        return None
    later = visit[np.clip(rows + moved, 0, len(rows) - 1)] - visit
    blocks = np.split(rows, starts[1:])
    by_visits = [np.unique(later[b[good[b]]]) for b in blocks]
    return Slipped(
        tuple(starts.tolist()), tuple(moved[starts].tolist()),
        tuple(int(v[0]) if len(v) == 1 else None for v in by_visits), float(np.median(own)),
    )  # fmt: skip


def _moved(table: Measurements, rows: IntArray, shift: IntArray | int) -> Measurements:
    """These rows with the joint values and markers of the rows `shift` further on."""
    return replace(
        table.take(rows), q=table.q[rows + shift], marker=table.marker[rows + shift]
    )  # fmt: skip


def _blocks(
    table: Measurements, flange: Array, visit: IntArray, shifts: IntArray
) -> list[tuple[IntArray, int]]:
    """Blocks of rows and shifts with which they fit best, those of small shifts first."""
    found = []
    last = int(visit[-1]) + 1 - BLOCK
    for first in np.unique(np.linspace(0, last, min(WINDOWS, last + 1)).astype(int)):
        rows = np.flatnonzero((visit >= first) & (visit < first + BLOCK))
        own = shifts[(rows[0] + shifts >= 0) & (rows[-1] + shifts < len(table))]
        at = rows + own[:, None]
        fits = linear_fits(flange[at], np.asarray(table.position)[rows], table.marker[at])
        found += [(left > NEAR / 2, abs(s), left, first, rows, int(s))
                  for s, left in zip(own.tolist(), fits.left.tolist(), strict=True)]  # fmt: skip
    found.sort(key=lambda one: one[:4])
    return [(rows, s) for *_, rows, s in found[:PLACED]]


def _distances(found: Registration, table: Measurements, flange: Array, shifts: IntArray) -> Array:
    """Distance (n, shifts) in m of every reading from the nominal place of the row that many
    further on; infinite beyond the table."""
    place = found.places(flange[:, :3, :3], flange[:, :3, 3], table.marker)
    n, points = len(table), np.asarray(table.position)
    distance = np.full((n, len(shifts)), np.inf)
    for k, s in enumerate(shifts):
        low, high = max(0, -s), min(n, n - s)
        if low < high:
            off = points[low:high] - place[low + s : high + s]
            distance[low:high, k] = np.linalg.norm(off, axis=1)
    return distance


def _path(cost: Array) -> IntArray:
    """Number (n,) of the shift of each row on the cheapest path, each cost (n, shifts) up to 1."""
    cost = np.minimum(cost, 1.0)
    total, came = cost[0], np.zeros(cost.shape, dtype=np.int64)
    own = np.arange(cost.shape[1])
    for r in range(1, len(cost)):
        best = int(total.argmin())
        changes = total[best] + CHANGE < total
        came[r] = np.where(changes, best, own)
        total = np.where(changes, total[best] + CHANGE, total) + cost[r]
    path = np.empty(len(cost), dtype=np.int64)
    path[-1] = int(total.argmin())
    for r in range(len(cost) - 1, 0, -1):
        path[r - 1] = came[r, path[r]]
    return path
