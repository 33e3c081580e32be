"""How the noise of a single reading may be built: one variance, or several."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import require
from elastocal.identification.variance.readings import Cells, Labels, Readings, reduce_repeats

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Structure:
    """Covariance of one reading in cell c: Σ_l θ[index[c, l]] · matrix[c, l].

    `index` (C, L) into the `names` of the variances θ, in m² (rad²); `matrix` (C, L, size, size)
    for a single reading.  The cell's mean has that covariance with `mean_matrix` in its place.
    `shrunk` says that the variances are many and share a prior (see shrinkage).
    """

    name: str
    description: str
    names: tuple[str, ...]
    cells: Cells
    index: Labels
    matrix: Array
    mean_matrix: Array
    shrunk: bool = False


def independent(readings: Readings) -> Structure:
    """One variance for all readings (positions, and one for rotations)."""
    size = readings.size
    kinds = [range(3), range(3, 6)] if size == 6 else [range(size)]
    names = ("position", "rotation")[: len(kinds)] if size > 1 else ("distance",)
    return _diagonal(
        readings, "independent", "one variance for all readings", names,
        [np.isin(np.arange(size), kind) for kind in kinds],
    )  # fmt: skip


def by_axis(readings: Readings) -> Structure:
    """One variance for each component of a reading."""
    size = readings.size
    names = ("x", "y", "z", "rx", "ry", "rz")[:size] if size > 1 else ("distance",)
    return _diagonal(
        readings, "axis", "one variance per axis", names, [row == 1 for row in np.eye(size)]
    )


def by_marker(readings: Readings) -> Structure:
    """One variance for each marker."""
    require(readings.size == 3, "variances per marker are for positions and deflections")
    cells = readings.cells
    labels, index = np.unique(cells.marker, return_inverse=True)
    matrix = np.tile(np.eye(3), (len(cells), 1, 1, 1))
    return Structure(
        "marker", "one variance per marker", tuple(f"marker {m}" for m in labels), cells,
        index.reshape(-1, 1), matrix, matrix / cells.repeats[:, None, None, None],
    )  # fmt: skip


def by_group(readings: Readings) -> Structure:
    """One variance for each configuration (under each load) in each direction.

    The group of Klimchik et al. 2013, section 4: its markers and repeats share one σ.
    """
    cells = readings.cells
    size = readings.size
    key = np.column_stack([cells.configuration, cells.load])
    groups, number = np.unique(key, axis=0, return_inverse=True)
    index = number.ravel()[:, None] * size + np.arange(size)
    parts = np.eye(size)[:, :, None] * np.eye(size)[:, None, :]
    matrix = np.tile(parts, (len(cells), 1, 1, 1))
    names = tuple(
        f"configuration {c}, load {load}, component {a}" for c, load in groups for a in range(size)
    )
    return Structure(
        "groups", "a variance per configuration and direction, shrunk towards the others", names,
        cells, index, matrix, matrix / cells.repeats[:, None, None, None], shrunk=True,
    )  # fmt: skip


def polar(readings: Readings, angular: bool | None = None) -> Structure:
    """Variances along the line of sight, across it, and across it growing with the distance.

    Σ = θ_r u uᵀ + (θ_t + θ_a d²)(I − u uᵀ) with u the line of sight and d its length in m: range
    noise, transverse noise of the target, angular noise of the tracker.  `angular` says whether
    θ_a is there; by default where the distances differ enough to tell it from θ_t.
    """
    require(
        readings.sight is not None and readings.size == 3,
        "polar noise needs positions and the tracker's position",
    )
    cells = readings.cells
    u, d = np.asarray(cells.sight)[:, 0, :], np.asarray(cells.reach)
    along = u[:, :, None] * u[:, None, :]
    across = np.eye(3) - along
    matrix = np.stack([along, across], axis=1)
    names: tuple[str, ...] = ("range", "transverse")
    if angular is None:
        angular = bool(np.ptp(d) > 0.2 * d.mean())
    if angular:
        matrix = np.concatenate([matrix, (across * d[:, None, None] ** 2)[:, None]], axis=1)
        names = (*names, "angular")
    index = np.tile(np.arange(len(names)), (len(cells), 1))
    return Structure(
        "polar", "range and transverse variances of the tracker", names, cells, index, matrix,
        matrix / cells.repeats[:, None, None, None],
    )  # fmt: skip


def as_stated(readings: Readings) -> Structure:
    """The stated noise times one factor, which the residuals tell."""
    cells = reduce_repeats(readings, stated=True)
    matrix = np.tile(np.eye(readings.size), (len(cells), 1, 1, 1))
    return Structure(
        "stated", "the stated noise times one factor", ("factor",), cells,
        np.zeros((len(cells), 1), dtype=np.int64), matrix, cells.unit[:, None],
    )  # fmt: skip


def _diagonal(
    readings: Readings, name: str, text: str, names: tuple[str, ...], parts: list[NDArray[np.bool_]]
) -> Structure:
    cells = readings.cells
    each = np.array([np.diag(part.astype(float)) for part in parts])
    matrix = np.tile(each, (len(cells), 1, 1, 1))
    index = np.tile(np.arange(len(parts)), (len(cells), 1))
    return Structure(
        name, text, names, cells, index, matrix, matrix / cells.repeats[:, None, None, None]
    )


STRUCTURES = {
    "independent": independent,
    "axis": by_axis,
    "marker": by_marker,
    "groups": by_group,
    "polar": polar,
    "stated": as_stated,
}
