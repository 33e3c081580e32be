"""Clusters of correlated cells, stacked by size so that linear algebra runs on whole stacks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from elastocal.identification.variance.readings import Labels
from elastocal.identification.variance.shared import SharedEffect
from elastocal.identification.variance.structure import Structure

Array = NDArray[np.float64]

MOST_NUMBERS = 4_000_000  # in a temporary array of a stack


@dataclass(frozen=True)
class Stack:
    """G clusters of n rows each: B (G, n, p), e (G, n) and V = Σ_l θ[index[g, l]] part[g, l].

    `index` (G, L) into the K variances, `part` (G, L, n, n); unused places of a cluster hold
    index 0 and a zero part.
    """

    cells: Labels  # (G, cells per cluster)
    B: Array
    e: Array
    index: Labels
    part: Array
    K: int

    @cached_property
    def uniform(self) -> bool:
        """Whether all clusters have the same variances at the same places."""
        return bool((self.index == self.index[0]).all())

    @cached_property
    def pairs(self) -> Labels:
        """Place (G·L·L,) of each pair of a cluster's variances in a flat (K, K) matrix."""
        return (self.index[:, :, None] * self.K + self.index[:, None, :]).ravel()

    @cached_property
    def gather(self) -> sparse.csr_array:
        """(K, G·L): sums per variance what is given per cluster and place."""
        flat = self.index.ravel()
        ones = np.ones(len(flat))
        return sparse.csr_array((ones, (flat, np.arange(len(flat)))), shape=(self.K, len(flat)))


def stacks(structure: Structure, shared: tuple[SharedEffect, ...]) -> list[Stack]:
    """The clusters of a structure: a configuration where effects are shared, else a cell."""
    cells = structure.cells
    label = cells.configuration if shared else np.arange(len(cells))
    _, cluster, count = np.unique(label, return_inverse=True, return_counts=True)
    order = np.argsort(cluster, kind="stable")
    starts = np.concatenate([[0], np.cumsum(count)[:-1]])
    found = []
    size, p = cells.e.shape[1], cells.B.shape[2]
    for m in np.unique(count):
        groups = np.flatnonzero(count == m)
        n, parts = int(m) * size, structure.index.shape[1] * int(m) + len(shared)
        step = max(1, MOST_NUMBERS // (parts * n * (n + p) + parts * p * p))
        for first in range(0, len(groups), step):
            members = order[starts[groups[first : first + step], None] + np.arange(m)]
            found.append(_stack(structure, shared, members))
    return found


def _stack(structure: Structure, shared: tuple[SharedEffect, ...], members: Labels) -> Stack:
    cells = structure.cells
    G, m = members.shape
    size, p = cells.e.shape[1], cells.B.shape[2]
    index, part = _own(structure, members)
    n_own = len(structure.names)
    for k, effect in enumerate(shared):
        unit = effect.unit[members]
        same = (unit[:, :, None] == unit[:, None, :]).astype(float)
        block = same[:, :, None, :, None] * np.diag(effect.axes)[None, None, :, None, :]
        part = np.concatenate([part, block.reshape(G, 1, m * size, m * size)], axis=1)
        index = np.concatenate([index, np.full((G, 1), n_own + k)], axis=1)
    B = cells.B[members].reshape(G, m * size, p)
    e = cells.e[members].reshape(G, m * size)
    return Stack(members, B, e, index, part, n_own + len(shared))


def _own(structure: Structure, members: Labels) -> tuple[Labels, Array]:
    """Own variances of each cluster, each once: index (G, L) and part (G, L, n, n)."""
    G, m = members.shape
    size = structure.cells.e.shape[1]
    index = structure.index[members].reshape(G, -1)  # (G, m * L)
    if (index.reshape(G, m, -1) == index.reshape(G, m, -1)[:, :1]).all():
        place = np.tile(np.arange(index.shape[1] // m), m)[None].repeat(G, axis=0)
        distinct = index[:, : index.shape[1] // m]
    else:
        distinct, place = _distinct(index)
    L = distinct.shape[1]
    blocks = structure.mean_matrix[members]  # (G, m, L0, size, size)
    part = np.zeros((G, L, m, size, m, size))
    place = place.reshape(G, m, -1)
    g = np.arange(G)
    for cell in range(m):
        for j in range(place.shape[2]):
            part[g, place[:, cell, j], cell, :, cell, :] += blocks[:, cell, j]
    return distinct, part.reshape(G, L, m * size, m * size)


def _distinct(index: Labels) -> tuple[Labels, Labels]:
    """Different entries of each row (G, L), padded with 0, and where each entry stands in it."""
    rows = [np.unique(row, return_inverse=True) for row in index]
    L = max(len(values) for values, _ in rows)
    distinct = np.array([np.pad(values, (0, L - len(values))) for values, _ in rows])
    return distinct, np.array([place.ravel() for _, place in rows])
