"""What every criterion is: a convex, degree −1 homogeneous function Φ of the information matrix."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Matrices (..., S, p, p) that a batched evaluation holds at once, as numbers.
BATCH_NUMBERS = 2_000_000


@dataclass(frozen=True)
class Gradient:
    """Φ and −∂Φ/∂M = G (S, p, p), symmetric, so that ∂Φ/∂w_i = −Σ_s tr(B_si G_s B_siᵀ)."""

    value: float
    G: Array


class Criterion(ABC):
    """Φ(M), to be minimised, M (S, p, p): information under each of S scenarios of the arm.

    Φ is decreasing in M and homogeneous of degree −1, Φ(cM) = Φ(M)/c, and where `certifiable`
    1/Φ is concave (Pukelsheim 2006, ch. 5).  Then for weights w and any plan w' with the same
    shares, gap = max_w' Σ (w'_i − w_i) d_i gives Φ(w') ≥ Φ(w) / (1 + gap/Φ(w)).  Without prior
    information this is Φ²/Σ_l n_l max_{i∈l} d_i.
    """

    name: ClassVar[str]
    certifiable: ClassVar[bool] = True

    @abstractmethod
    def value(self, M: Array) -> Array:
        """Φ (...,) of M (..., S, p, p); inf where M is singular."""

    @abstractmethod
    def gradient(self, M: Array) -> Gradient:
        """Φ and G at M (S, p, p); a subgradient where Φ has a kink."""

    def after_adding(self, M: Array, blocks: Array) -> Array:
        """Φ (N,) at M_s + B_siᵀ B_si for each i; M (S, p, p), blocks (S, N, r, p)."""
        scenarios, n, _, p = blocks.shape
        size = max(BATCH_NUMBERS // (scenarios * p * p), 1)
        values = np.empty(n)
        for start in range(0, n, size):
            B = blocks[:, start : start + size]
            added = np.einsum("snri,snrj->nsij", B, B, optimize=True)
            values[start : start + size] = self.value(M + added)
        return values

    @abstractmethod
    def reported(self, value: float) -> tuple[float, str]:
        """The figure a user knows and its unit, from Φ: ρ₀ in µm, log det, an index."""
