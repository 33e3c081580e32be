"""Residuals and B per reading, with the labels that say what readings have in common."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import require
from elastocal.measurements import Measurements

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Readings:
    """N readings of `size` components, linearised: e = B Δx + noise, shared and per reading.

    `B` (N, size, p); `e` (N, size) in m, and rad from the fourth component on.  Readings of one
    `configuration`, `load` and `marker` (N,) are repeats.  `sight` (N, 3, 3), where the tracker's
    position is known, holds the unit vectors along and across the line of sight as rows and
    `reach` (N,) its length in m; `stated` (N, size, size), where noise is stated, its covariance.
    `lead` (N,) are the readings' rows in the `table`.
    """

    B: Array
    e: Array
    configuration: Labels
    load: Labels
    marker: Labels
    sight: Array | None = None
    reach: Array | None = None
    stated: Array | None = None
    table: Measurements | None = None
    lead: Labels | None = None

    def __post_init__(self) -> None:
        n, size = self.e.shape
        require(
            self.B.shape[:2] == (n, size),
            f"B is {self.B.shape} where {n} readings of {size} components need ({n}, {size}, p)",
        )
        for name in ("configuration", "load", "marker"):
            found = getattr(self, name).shape
            require(found == (n,), f"{name} is {found}; one label per reading, ({n},), is needed")

    def __len__(self) -> int:
        return len(self.e)

    @property
    def size(self) -> int:
        return int(self.e.shape[1])

    @property
    def n_parameters(self) -> int:
        return int(self.B.shape[2])

    @cached_property
    def rows(self) -> Measurements:
        """The rows (N,) of the table that the readings are from: joints, force, time and so on."""
        require(self.table is not None, "these readings are not from a table")
        assert self.table is not None and self.lead is not None
        return self.table.take(self.lead)

    @cached_property
    def cell(self) -> Labels:
        """Number (N,) of the set of repeats that a reading belongs to."""
        key = np.column_stack([self.configuration, self.load, self.marker])
        return np.unique(key, axis=0, return_inverse=True)[1].ravel()

    @cached_property
    def cells(self) -> Cells:
        """Sets of repeats with plain means; every noise model but the stated one uses them."""
        return reduce_repeats(self)

    def take(self, chosen: Mask) -> Readings:
        """Only the readings where `chosen` (N,) holds."""
        names = ("B", "e", "configuration", "load", "marker", "sight", "reach", "stated", "lead")
        parts = {name: getattr(self, name) for name in names}
        return replace(self, **{k: v[chosen] for k, v in parts.items() if v is not None})

    def of_columns(self, chosen: Mask) -> Readings:
        """Only the columns of B where `chosen` (p,) holds."""
        return replace(self, B=self.B[:, :, chosen])

    def moved(self, e: Array) -> Readings:
        """The same readings with other residuals (N, size)."""
        return replace(self, e=e)


@dataclass(frozen=True)
class Cells:
    """Sets of repeats, reduced without loss: a mean and what scatters about it.

    With the covariance θ S_i of reading i in a cell, the weighted mean ȳ = U Σ S_i⁻¹ y_i with
    U = (Σ S_i⁻¹)⁻¹ and the scatter about it are sufficient: ȳ varies by θ U plus whatever all
    repeats share, the scatter by θ alone with (repeats − 1) · size degrees of freedom.  Repeats
    are taken to have one B; where theirs differ a little, the mean stands for all.
    `B` (C, size, p), `e` (C, size), `unit` U (C, size, size), `dof` (C,) repeats − 1, `scatter`
    (C, size, size), `log_offset`: Σ log|S_i| − log|U| over all cells, which the likelihood needs.
    """

    B: Array
    e: Array
    unit: Array
    repeats: Labels
    dof: Array
    scatter: Array
    log_offset: float
    configuration: Labels
    load: Labels
    marker: Labels
    sight: Array | None
    reach: Array | None

    def __len__(self) -> int:
        return len(self.e)


def reduce_repeats(readings: Readings, stated: bool = False) -> Cells:
    """Cells of the readings; weighted by the stated covariances if `stated`, else plainly."""
    cell = readings.cell
    n_cells = int(cell.max()) + 1
    first = np.unique(cell, return_index=True)[1]
    repeats = np.bincount(cell, minlength=n_cells)
    size = readings.size
    if stated:
        require(readings.stated is not None, "no noise is stated that could be used")
        S = np.asarray(readings.stated)
        P = np.linalg.inv(S)
        unit = np.linalg.inv(_sum(P, cell, n_cells)).astype(np.float64)
        offset = np.linalg.slogdet(S)[1].sum() - np.linalg.slogdet(unit)[1].sum()
        share = unit[cell] @ P
        e = _sum((share @ readings.e[:, :, None])[..., 0], cell, n_cells)
        B = _sum(share @ readings.B, cell, n_cells)
        deviation = readings.e - e[cell]
        squares = np.einsum("ni,nij,nj->n", deviation, P, deviation)
        scatter = np.bincount(cell, squares, n_cells)[:, None, None] * np.eye(size) / size
    else:
        unit = np.eye(size) / repeats[:, None, None]
        offset = size * np.log(repeats).sum()
        e = _sum(readings.e, cell, n_cells) / repeats[:, None]
        B = _sum(readings.B, cell, n_cells) / repeats[:, None, None]
        deviation = readings.e - e[cell]
        scatter = _sum(deviation[:, :, None] * deviation[:, None, :], cell, n_cells)
    return Cells(
        B, e, unit, repeats, (repeats - 1).astype(float), scatter, float(offset),
        readings.configuration[first], readings.load[first], readings.marker[first],
        None if readings.sight is None else readings.sight[first],
        None if readings.reach is None else readings.reach[first],
    )  # fmt: skip


def _sum(values: Array, cell: Labels, n_cells: int) -> Array:
    total = np.zeros((n_cells, *values.shape[1:]))
    np.add.at(total, cell, values)
    return total
