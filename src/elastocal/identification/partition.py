"""A table in parts: small enough to work on, cut where nothing is correlated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from elastocal.identification.noise import Weights
from elastocal.manipulator.observation import Observations, alone, subset

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Span = tuple[int, int]

# Numbers in B (rows × parameters): from LARGE on a fit works in parts of at most PART.  16 MB a
# part keeps the evaluation of B at full speed, and the copies that QR makes small.
LARGE = 2**21
PART = 2**21
OF_A_MARKER = 30  # observations of each marker at least, where there are as many, in a sample


def is_large(seen: Observations, n_parameters: int) -> bool:
    """Whether B of all parameters is too large to be formed at once."""
    return len(seen.value) * n_parameters > LARGE


@dataclass(frozen=True)
class Part:
    """The observations `index` (n,) of a table, whitened by `weights` on their own.

    `rows` (n·size,) are their rows among those of all observations.
    """

    index: IntArray
    rows: IntArray
    observations: Observations
    weights: Weights


@dataclass(frozen=True)
class Partition:
    """All observations in `groups` of spans of `order` (None: as they stand in the table).

    Correlated observations share a span, and observations of one configuration share a group.
    A group is one span, unless a configuration is larger than a part.
    """

    seen: Observations
    weights: Weights
    order: IntArray | None
    groups: tuple[tuple[Span, ...], ...]

    @cached_property
    def blocks(self) -> IntArray | None:
        """Number of the block (observations,) that each observation is correlated within.

        None where every observation is on its own.
        """
        return _correlated(self.seen, self.weights)

    @property
    def spans(self) -> list[Span]:
        return [span for group in self.groups for span in group]

    def part(self, span: Span) -> Part:
        """The observations of a span, in the table's order."""
        if len(self.groups) == 1 and len(self.groups[0]) == 1:
            n, rows = len(self.seen.lead), len(self.seen.value)
            return Part(np.arange(n), np.arange(rows), self.seen, self.weights)
        index = np.arange(*span) if self.order is None else np.sort(self.order[slice(*span)])
        return part_of(self.seen, self.weights, index)


def part_of(seen: Observations, weights: Weights, index: IntArray) -> Part:
    """Observations `index` (n,), ascending, with the weights of these alone.

    Exact where what is correlated is in `index` together.
    """
    rows = (index[:, None] * seen.size + np.arange(seen.size)).ravel()
    if seen.kind == "deflection":
        chosen = np.zeros(len(seen.lead), dtype=bool)
        chosen[index] = True
        own = subset(seen, chosen)
    else:
        value = seen.value[_run(rows)]
        table = seen.table.take(_run(seen.lead[index]))
        own = Observations(seen.kind, value, alone(len(index)), np.arange(len(index)), table)
    if weights.whiten is None:
        return Part(index, rows, own, weights)
    inside = weights.whiten[_run(rows)][:, _run(rows)]
    return Part(index, rows, own, replace(weights, whiten=inside))


def _run(index: IntArray) -> IntArray | slice:
    """`index` (n,) as a slice where it counts up by one: arrays are then seen and not copied."""
    if len(index) and index[-1] - index[0] == len(index) - 1 and (np.diff(index) == 1).all():
        return slice(int(index[0]), int(index[-1]) + 1)
    return index


def sample(parts: Partition, n: int, seed: int = 0) -> Part:
    """About n observations at random, some of every marker, correlated ones together."""
    seen, blocks = parts.seen, parts.blocks
    order = np.random.default_rng(seed).permutation(len(seen.lead))
    if blocks is not None:  # each brings the others of its block with it
        n = -(-n * (int(blocks.max()) + 1) // len(blocks))
    marker = seen.table.marker[seen.lead[order]]
    some = [order[marker == code][:OF_A_MARKER] for code in np.unique(marker)]
    chosen = np.unique(np.concatenate([order[:n], *some]))
    if blocks is not None:
        chosen = np.flatnonzero(np.isin(blocks, blocks[chosen]))
    return part_of(seen, parts.weights, chosen)


def partition(seen: Observations, weights: Weights, n_parameters: int) -> Partition:
    """Cut the observations so that B of `n_parameters` has at most PART numbers in each part.

    A table that is not large stays in one part; so do observations that are all correlated.
    """
    n = len(seen.lead)
    if not is_large(seen, n_parameters):
        return Partition(seen, weights, None, (((0, n),),))
    blocks = _correlated(seen, weights)
    limit = max(PART // (seen.size * n_parameters), 1)
    unit = _units(seen.configuration, blocks)
    order = np.lexsort((unit,) if blocks is None else (blocks, unit))
    inner = np.arange(1, n + 1) if blocks is None else _ends(blocks[order])
    groups: list[tuple[Span, ...]] = []
    for start, stop in _packed(_ends(unit[order]), 0, limit):
        if stop - start <= limit:
            groups.append(((start, stop),))
        else:
            inside = inner[(inner > start) & (inner <= stop)]
            groups.append(tuple(_packed(inside, start, limit)))
    in_order = bool((np.diff(order) == 1).all())
    return Partition(seen, weights, None if in_order else order, tuple(groups))


def _correlated(seen: Observations, weights: Weights) -> IntArray | None:
    whiten = weights.whiten
    if whiten is None:
        return None
    row = np.repeat(np.arange(whiten.shape[0], dtype=np.int32), np.diff(whiten.indptr))
    row //= seen.size
    column = whiten.indices // seen.size
    if np.array_equal(row, column):
        return None
    n = len(seen.lead)
    graph = sparse.csr_array((np.ones(len(row), dtype=bool), (row, column)), shape=(n, n))
    return sparse.csgraph.connected_components(graph, directed=False)[1].astype(np.int64)


def _units(configuration: IntArray, blocks: IntArray | None) -> IntArray:
    """Number of the unit (observations,): configurations, joined where a block spans several."""
    if blocks is None:
        return configuration
    of_block = np.zeros(blocks.max() + 1, dtype=np.int64)
    of_block[blocks] = configuration
    if np.array_equal(of_block[blocks], configuration):
        return configuration
    shape = (int(configuration.max()) + 1, len(of_block))
    links = sparse.coo_array((np.ones(len(blocks)), (configuration, blocks)), shape=shape)
    graph = sparse.block_array([[None, links], [links.T, None]], format="csr")
    return sparse.csgraph.connected_components(graph, directed=False)[1][configuration]


def _ends(sorted_codes: IntArray) -> IntArray:
    """Where each run of equal codes ends (exclusive)."""
    return np.append(np.flatnonzero(np.diff(sorted_codes)) + 1, len(sorted_codes))


def _packed(ends: IntArray, start: int, limit: int) -> list[Span]:
    """Consecutive runs that end at `ends`, as many to a span as keep it within `limit`.

    A run that is longer than that is a span of its own.
    """
    spans, k = [], 0
    while k < len(ends):
        k = max(int(np.searchsorted(ends, start + limit, side="right")), k + 1)
        spans.append((start, int(ends[k - 1])))
        start = spans[-1][1]
    return spans
