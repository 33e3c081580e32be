"""Readings gathered by configuration: what shares noise stands in one block."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Labels = NDArray[np.int64]


@dataclass(frozen=True)
class Blocks:
    """N observations of `size` components in C blocks of M places, padded where a block is short.

    `member` (C, M) is the observation at each place, N where there is none; `visit` (N,) numbers
    the times that the arm was sent to a pose (configuration, repeat and load state).
    """

    member: Labels
    visit: Labels
    size: int

    @classmethod
    def of(cls, configuration: Labels, visit: Labels, size: int) -> Blocks:
        """Blocks by `configuration` (N,), in the order of its codes."""
        _, code, count = np.unique(configuration, return_inverse=True, return_counts=True)
        order = np.argsort(code, kind="stable")
        start = np.concatenate([[0], np.cumsum(count)])[code[order]]
        member = np.full((len(count), int(count.max())), len(configuration), dtype=np.int64)
        member[code[order], np.arange(len(order)) - start] = order
        return cls(member, visit, size)

    @property
    def n(self) -> int:
        return len(self.visit)

    @cached_property
    def places(self) -> VisitPlaces:
        """Where visits stand in the blocks."""
        return VisitPlaces.of(self)

    def pack(self, rows: Array) -> Array:
        """(N, size, k) → (C, M·size, k), zeros where there is no observation."""
        k = rows.shape[2]
        padded = np.concatenate([rows, np.zeros((1, self.size, k))])
        return padded[self.member].reshape(len(self.member), -1, k)

    def unpack(self, packed: Array) -> Array:
        """(C, M·size, k) → (N, size, k)."""
        C, M = self.member.shape
        rows = np.empty((self.n + 1, self.size, packed.shape[2]))
        rows[self.member.ravel()] = packed.reshape(C * M, self.size, -1)
        return rows[:-1]

    def pack_square(self, blocks: Array) -> Array:
        """Covariances (N, size, size) of single observations → (C, M·size, M·size)."""
        C, M = self.member.shape
        padded = np.concatenate([blocks, np.zeros((1, self.size, self.size))])[self.member]
        out = np.zeros((C, M, self.size, M, self.size))
        place = np.arange(M)
        out[:, place, :, place, :] = padded.transpose(1, 0, 2, 3)
        return out.reshape(C, M * self.size, M * self.size)

    def unpack_square(self, packed: Array) -> Array:
        """Diagonal blocks (N, size, size) of (C, M·size, M·size)."""
        C, M = self.member.shape
        place = np.arange(M)
        own = packed.reshape(C, M, self.size, M, self.size)[:, place, :, place, :]
        rows = np.empty((self.n + 1, self.size, self.size))
        rows[self.member.T.ravel()] = own.reshape(M * C, self.size, self.size)
        return rows[:-1]

    @property
    def absent(self) -> NDArray[np.bool_]:
        """Rows (C, M·size) that hold no observation."""
        return np.repeat(self.member == self.n, self.size, axis=1)

    @property
    def same_visit(self) -> Array:
        """1 where two rows of a block belong to the same visit (C, M·size, M·size)."""
        visit = np.concatenate([self.visit, [-1]])[self.member]
        same = (visit[:, :, None] == visit[:, None, :]) & (visit >= 0)[:, :, None]
        return np.repeat(np.repeat(same, self.size, axis=1), self.size, axis=2).astype(float)


@dataclass(frozen=True)
class VisitPlaces:
    """Where visits stand in the blocks: `one_hot` (C, m, v), and an observation of each visit,
    `example` (C, v), −1 where a block has fewer visits."""

    one_hot: Array
    example: Labels

    @classmethod
    def of(cls, blocks: Blocks) -> VisitPlaces:
        member = blocks.member
        visit = np.concatenate([blocks.visit, [-1]])[member]
        local = np.full(visit.shape, -1)
        most = 1
        for c, row in enumerate(visit):
            known, first, inverse = np.unique(row, return_index=True, return_inverse=True)
            order = np.argsort(np.argsort(np.where(known < 0, len(row), first)))
            local[c] = np.where(row < 0, -1, order[inverse])
            most = max(most, int(local[c].max()) + 1)
        one_hot = (local[:, :, None] == np.arange(most)).astype(float)
        example = np.full((len(member), most), -1, dtype=np.int64)
        for v in range(most):
            there = one_hot[:, :, v].any(axis=1)
            example[there, v] = member[there, one_hot[there, :, v].argmax(axis=1)]
        return cls(np.repeat(one_hot, blocks.size, axis=1), example)

    def gather(self, values: Array) -> Array:
        """Per observation (N, …) → per visit (C, v, …), zero where there is none."""
        out = values[np.maximum(self.example, 0)]
        out[self.example < 0] = 0.0
        return out
