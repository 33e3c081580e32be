"""What every criterion is: a convex, degree −1 homogeneous function Φ of the information matrix."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Matrices (..., S, p, p) that a batched evaluation holds at once, as numbers.
BATCH_NUMBERS = 2_000_000


@dataclass(frozen=True)
class Gradient:
    """Φ and −∂Φ/∂M = G (S, p, p), symmetric, so that ∂Φ/∂w_i = −Σ_s tr(B_si G_s B_siᵀ)."""

    value: float
    G: Array


def candidate_sums(M: Array, blocks: Array) -> Iterator[tuple[slice, Array]]:
    """M_s + B_siᵀ B_si (n, S, p, p) for slices of candidates that fit into memory.

    M (S, p, p), blocks (S, N, r, p).
    """
    scenarios, n, _, p = blocks.shape
    size = max(BATCH_NUMBERS // (scenarios * p * p), 1)
    for start in range(0, n, size):
        part = slice(start, start + size)
        B = blocks[:, part]
        yield part, M + (B.swapaxes(-1, -2) @ B).swapaxes(0, 1)


class Criterion(ABC):
    """Φ(M), to be minimised, M (S, p, p): information under each of S scenarios of the arm.

    Φ is decreasing in M and homogeneous of degree −1, Φ(cM) = Φ(M)/c, and where `certifiable`
    1/Φ is concave (Pukelsheim 2006, ch. 5).  Then for weights w and any plan w' with the same
    shares, gap = max_w' Σ (w'_i − w_i) d_i gives Φ(w') ≥ Φ(w) / (1 + gap/Φ(w)).  Without prior
    information this is Φ²/Σ_l n_l max_{i∈l} d_i.
    """

    name: str
    certifiable: bool = True

    @abstractmethod
    def value(self, M: Array) -> Array:
        """Φ (...,) of M (..., S, p, p); inf where M is singular."""

    @abstractmethod
    def gradient(self, M: Array) -> Gradient:
        """Φ and G at M (S, p, p); a subgradient where Φ has a kink."""

    def after_adding(self, M: Array, blocks: Array) -> Array:
        """Φ (N,) at M_s + B_siᵀ B_si for each i; M (S, p, p), blocks (S, N, r, p)."""
        values = np.empty(blocks.shape[1])
        for part, sums in candidate_sums(M, blocks):
            values[part] = self.value(sums)
        return values

    def softened(self, order: float) -> Criterion:
        """A smooth criterion nowhere above this one, towards which it grows with `order`.

        Kinks (a largest eigenvalue, pose or scenario) become power means; a criterion without
        any is its own.  A lower bound on the softened criterion is one on this.
        """
        return self

    @abstractmethod
    def reported(self, value: float) -> tuple[float, str]:
        """The figure a user knows and its unit, from Φ: ρ₀ in µm, log det, an index."""
