"""Losses ρ(d) of the length d = |e_i|/σ of an observation's scaled residual.

An observation of `size` whitened rows (x, y, z of a tracker reading) is right or wrong as a
whole: the loss sees its Mahalanobis length, and its rows share one weight.  For size 1 the
length is |r| and these are the usual losses per row.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import require

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Loss(ABC):
    """ρ, ψ = ρ′, weight ψ(d)/d and slope ψ′, elementwise; even or odd in d."""

    name: ClassVar[str]
    size: int

    def __post_init__(self) -> None:
        require(self.size >= 1, f"an observation has at least one row; size is {self.size}")

    @property
    def kink(self) -> float | None:
        """Where ψ′ or a derivative of it jumps, if anywhere beyond zero."""
        return None

    @abstractmethod
    def rho(self, d: Array) -> Array:
        """ρ(d), with ρ(0) = 0."""

    @abstractmethod
    def weight(self, d: Array) -> Array:
        """ψ(d)/d, the weight in ψ's estimating equation; not an inverse variance."""

    @abstractmethod
    def slope(self, d: Array) -> Array:
        """ψ′(d)."""

    def psi(self, d: Array) -> Array:
        """ψ(d) = ρ′(d)."""
        return d * self.weight(d)


@dataclass(frozen=True)
class Cut(Loss):
    """A loss that changes its form at d = c."""

    c: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _positive("c", self.c)

    @property
    def kink(self) -> float:
        return self.c


@dataclass(frozen=True)
class Huber(Cut):
    """ρ = d²/2 up to c, c|d| − c²/2 beyond (Huber 1964)."""

    name: ClassVar[str] = "huber"

    def rho(self, d: Array) -> Array:
        a = np.abs(d)
        return np.where(a <= self.c, a**2 / 2, self.c * (a - self.c / 2))

    def weight(self, d: Array) -> Array:
        return self.c / np.maximum(np.abs(d), self.c)

    def slope(self, d: Array) -> Array:
        return (np.abs(d) <= self.c).astype(float)


@dataclass(frozen=True)
class Bisquare(Cut):
    """Tukey's ρ = c²/6 (1 − (1 − (d/c)²)³) up to c, c²/6 beyond (Beaton and Tukey 1974)."""

    name: ClassVar[str] = "tukey"

    @property
    def largest(self) -> float:
        """sup ρ = c²/6."""
        return self.c**2 / 6

    def rho(self, d: Array) -> Array:
        return self.largest * (1 - self._inside(d) ** 3)

    def weight(self, d: Array) -> Array:
        return self._inside(d) ** 2

    def slope(self, d: Array) -> Array:
        inside = self._inside(d)
        return inside * (5 * inside - 4)  # (1 − u²)(1 − 5u²), u = d/c

    def _inside(self, d: Array) -> Array:
        return np.maximum(1 - (d / self.c) ** 2, 0.0)


@dataclass(frozen=True)
class Absolute(Loss):
    """ρ = |d|: least absolute values, or the sum of Euclidean lengths for size > 1."""

    name: ClassVar[str] = "l1"

    def rho(self, d: Array) -> Array:
        return np.abs(d)

    def weight(self, d: Array) -> Array:
        return 1 / np.maximum(np.abs(d), np.finfo(float).tiny)

    def psi(self, d: Array) -> Array:
        return np.sign(d)

    def slope(self, d: Array) -> Array:
        return np.zeros_like(d)


@dataclass(frozen=True)
class StudentT(Loss):
    """−log density of the multivariate t: ρ = (ν + size)/2 · log(1 + d²/ν)."""

    name: ClassVar[str] = "student-t"
    nu: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _positive("nu", self.nu)

    def rho(self, d: Array) -> Array:
        return (self.nu + self.size) / 2 * np.log1p(d**2 / self.nu)

    def weight(self, d: Array) -> Array:
        return (self.nu + self.size) / (self.nu + d**2)

    def slope(self, d: Array) -> Array:
        return (self.nu + self.size) * (self.nu - d**2) / (self.nu + d**2) ** 2


def _positive(name: str, value: float) -> None:
    require(0 < value < np.inf, f"{name} must be positive and finite; found {value}")
