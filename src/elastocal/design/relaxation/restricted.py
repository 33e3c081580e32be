"""The problem on a few candidates: what a master solves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.design.criteria.base import Array
from elastocal.design.problem import IntArray


@dataclass(frozen=True)
class Restricted:
    """Candidates A (S, k, p, p) in levels (k,) 0 … L−1 with shares (L,), each at most `most`.

    `base` (S, p, p): information that does not depend on their weights.
    """

    A: Array
    base: Array
    level: IntArray
    shares: IntArray
    most: int

    def information(self, w: Array) -> Array:
        return self.base + np.tensordot(self.A, w, (1, 0))

    def relative(self, w: Array) -> Array:
        """w_i as a part of the largest weight of its level."""
        largest = np.zeros(len(self.shares))
        np.maximum.at(largest, self.level, w)
        return np.asarray(w / largest[self.level])

    def inside(self, w: Array, depth: float) -> Array:
        """w ≥ 0 scaled to the shares and moved off its bounds, `depth` of the way to even ones."""
        size = np.bincount(self.level)
        total = np.bincount(self.level, w)
        scale = self.shares / np.where(total > 0.0, total, np.inf)
        clipped = np.minimum(w * scale[self.level], self.most)
        filled = np.bincount(self.level, clipped)
        missing = np.maximum(self.shares - filled, 0.0)
        part = missing / np.maximum(self.most * size - filled, np.finfo(float).tiny)
        full = clipped + part[self.level] * (self.most - clipped)
        return np.asarray((1.0 - depth) * full + depth * (self.shares / size)[self.level])
