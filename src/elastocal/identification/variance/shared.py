"""Random effects: what readings of a configuration have in common besides the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.variance.readings import Cells, Labels

Array = NDArray[np.float64]


PARTITIONS = (
    ("configuration",),
    ("configuration", "load"),
    ("configuration", "marker"),
    ("configuration", "load", "marker"),
)


@dataclass(frozen=True)
class SharedEffect:
    """A deviation common to all cells of one `unit` (C,): covariance τ² diag(`axes`).

    Cells are of one unit where they agree in the labels `by`.
    """

    name: str
    by: tuple[str, ...]
    unit: Labels
    axes: Array


def shared_effects(cells: Cells, size: int, wanted: bool = True) -> tuple[SharedEffect, ...]:
    """The shared effects that these readings can tell apart.

    An arm does not come back to quite the same place: a deviation per configuration; per
    configuration and load; per configuration and marker; and per cell, common to its repeats.
    One is left out where it would coincide with another or with the noise of single readings.
    Rotations, in rad, have variances of their own.
    """
    if not wanted:
        return ()
    kept: dict[tuple[str, ...], Labels] = {}
    for by in PARTITIONS:
        unit = np.unique(
            np.column_stack([getattr(cells, label) for label in by]), axis=0, return_inverse=True
        )[1].ravel()
        # Alone in its unit and not repeated, a reading's own noise covers it.
        seen = np.bincount(unit, cells.repeats)
        if (seen < 2).all() or any(np.array_equal(unit, other) for other in kept.values()):
            continue
        kept[by] = unit
    position = np.where(np.arange(size) < 3, 1.0, 0.0)
    names = {by: " and ".join([", ".join(by[:-1]), by[-1]] if by[1:] else by) for by in kept}
    found = [SharedEffect(names[by], by, unit, position) for by, unit in kept.items()]
    if size == 6:
        found += [
            SharedEffect(f"{names[by]} (rotation)", by, unit, 1.0 - position)
            for by, unit in kept.items()
        ]
    return tuple(found)
