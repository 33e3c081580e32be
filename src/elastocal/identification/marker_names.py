"""Markers whose names are exchanged: readings that lie where another marker is.

The names of the majority place base and markers.  A reading that is not where its own marker is,
but where another one is, has that one's name.  How near a reading lies to the nearest marker says
what the arm's own errors are, σ by the median; a reading farther off than χ₃ σ at FALSE_ALARM / n
is not its marker's.  Where each of two markers lies where the cell states the other, the majority
has them exchanged: the sums of squares of both, three numbers a marker, are compared by F.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy import special

from elastocal.cell.arm_description import Tool
from elastocal.identification.outliers import FALSE_ALARM, named_runs
from elastocal.identification.start import nominal_problem, register
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.text import listed
from elastocal.units import Array, IntArray

FEWEST_POSES = 8  # base (6) and a marker (3) from fewer fit anything
MOST_ROWS, PASSES = 200_000, 10
# Poses err unlike each other: the other marker is near within this many limits, and this many times
# nearer.  A reading that is wrong by r is as near to it by chance once in (r/least)³.
NEAR, NEARER = 3.0, 5.0
SHOWN = 6  # runs of lines, and configurations, that are named


@dataclass(frozen=True)
class Exchanged:
    """Rows (k,) of a table with the name of another marker, the `markers` that are mixed up, and in
    `words` which and what to do."""

    rows: IntArray
    markers: tuple[str, ...]
    words: str


def exchanged(model: Model, table: Measurements) -> Exchanged | None:
    """Readings that have another marker's name; None where there are none."""
    names, n = table.marker_names, len(table)
    poses = len(np.unique(table.q, axis=0))
    if table.position is None or len(names) < 2 or not FEWEST_POSES <= poses <= n <= MOST_ROWS:
        return None
    problem, row = nominal_problem(model, table), np.arange(n)
    marker, far = table.marker, np.sqrt(special.chdtri(3, FALSE_ALARM / n))
    for _ in range(PASSES):  # base and markers by the names as they should be
        found = register(replace(problem, marker=marker))
        places = np.stack([
            found.places(problem.flange_rotation, problem.flange_position, np.full(n, m))
            for m in range(len(names))
        ], axis=1)  # fmt: skip
        distance = np.linalg.norm(problem.points[:, None] - places, axis=2)
        nearest = distance.argmin(axis=1)
        least = distance[row, nearest]
        limit = far * np.median(least) / np.sqrt(special.chdtri(3, 0.5))
        own = distance[row, table.marker]
        other = (own > limit) & (own > NEARER * least) & (least <= NEAR * limit)
        before, marker = marker, np.where(other, nearest, table.marker)
        if np.array_equal(marker, before):
            break
    meant = _as_stated(model.cell.tool, names, found.markers)[marker]
    rows = np.flatnonzero(meant != table.marker)
    if not len(rows):
        return None
    mixed = np.unique([*table.marker[rows], *meant[rows]])
    whole = len(rows) == np.isin(table.marker, mixed).sum()
    markers = tuple(names[m] for m in mixed)
    return Exchanged(rows, markers, _in_all(markers) if whole else _in_some(table, rows, markers))


def _as_stated(tool: Tool, names: tuple[str, ...], places: Array) -> IntArray:
    """Which marker (M,) each is by the places (M, 3) that the cell states, where two of them are
    exchanged; else itself."""
    stated = [m for m, name in enumerate(names) if name in tool.markers]
    best, pairs = np.arange(len(names)), list(combinations(stated, 2))
    level = special.fdtri(6, 6, 1 - FALSE_ALARM / max(len(pairs), 1))
    for a, b in pairs:
        off = places[[a, b]] - np.array([tool.markers[names[m]] for m in (a, b)])
        crossed = places[[a, b]] - np.array([tool.markers[names[m]] for m in (b, a)])
        if (off**2).sum() > level * (crossed**2).sum():
            best[[a, b]] = best[[b, a]]
    return best


def _in_all(markers: tuple[str, ...]) -> str:
    return (
        f"Markers {listed(markers)} lie where [tool.markers_m] states each other: their names are "
        "exchanged in all rows of the table, or in the cell. Exchange them in one of the two."
    )


def _in_some(table: Measurements, rows: IntArray, markers: tuple[str, ...]) -> str:
    lines = named_runs(table.row[rows].tolist())
    labels = dict.fromkeys(table.configuration_labels[c] for c in table.configuration[rows])
    several = "s" * (len(labels) > 1)
    return (
        f"The names of markers {listed(markers)} are exchanged in {len(rows)} rows (lines "
        f"{listed(lines, SHOWN)}; configuration{several} {listed(labels, SHOWN)}): each reading "
        "there lies where the other marker is. Exchange the names in these rows."
    )
