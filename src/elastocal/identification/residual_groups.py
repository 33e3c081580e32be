"""The rows of a table by component, marker, configuration and load state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.manipulator.observation import COMPONENTS, Observations

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Labels:
    """`code` (rows,) indexes `names`, in the table's order."""

    by: str
    code: IntArray
    names: tuple[str, ...]


def groupings(seen: Observations, chosen: NDArray[np.bool_]) -> list[Labels]:
    """Groupings of the `chosen` rows (rows,) that have more than one group."""
    table, size = seen.table, seen.size
    load, loads = _loads(np.round(table.force[seen.lead], 3))
    coded: list[tuple[str, IntArray, tuple[str, ...]]] = [
        ("component", np.tile(np.arange(size), len(seen.lead)), COMPONENTS[seen.kind]),
        ("marker", np.repeat(table.marker[seen.lead], size), table.marker_names),
        ("configuration", np.repeat(seen.configuration, size), table.configuration_labels),
        ("load state", np.repeat(load, size), loads),
    ]
    found = []
    for by, code, names in coded:
        used, first, index = np.unique(code[chosen], return_index=True, return_inverse=True)
        if len(used) < 2:
            continue
        order = np.argsort(first)
        place = np.argsort(order)
        found.append(Labels(by, place[index], tuple(names[k] for k in used[order].tolist())))
    return found


def _loads(force: NDArray[np.float64]) -> tuple[IntArray, tuple[str, ...]]:
    """Load state (N,) of each observation, and its force in words."""
    code = np.zeros(len(force), dtype=np.int64)
    for axis in force.T:  # column by column: sorting whole rows takes far longer
        values, index = np.unique(axis, return_inverse=True)
        code = np.unique(code * len(values) + index, return_inverse=True)[1]
    first = np.unique(code, return_index=True)[1]
    return code, tuple(_named(f) for f in force[first])


def _named(force: NDArray[np.float64]) -> str:
    if not force.any():
        return "unloaded"
    return "(" + ", ".join(f"{f + 0.0:.6g}" for f in force) + ") N"
