"""What a constrained fit minimises: squares or Huber losses of the data, and a prior."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import require
from elastocal.identification.robust.tuning import huber

Array = NDArray[np.float64]
LossName = Literal["squares", "huber"]


@dataclass(frozen=True)
class Loss:
    """Σ ρ(|r_i|) over observations r_i of `size` whitened rows (Huber 1964, by length).

    ρ(d) = d² for d ≤ threshold and 2·threshold·d − threshold² beyond; squares where the
    threshold is infinite.
    """

    threshold: float = np.inf
    size: int = 1

    @property
    def quadratic(self) -> bool:
        return np.isinf(self.threshold)

    def value(self, r: Array) -> float:
        """Σ ρ of the residual r (rows,)."""
        if self.quadratic:
            return float(r @ r)
        d, k = self.lengths(r), self.threshold
        return float(np.where(d <= k, d**2, 2 * k * d - k**2).sum())

    def weights(self, r: Array) -> Array:
        """ρ'(d)/(2d) = min(1, threshold/d) per observation, repeated for its rows (rows,)."""
        if self.quadratic:
            return np.ones(len(r))
        d = np.maximum(self.lengths(r), self.threshold)
        return np.repeat(self.threshold / d, self.size)

    def root(self, J: Array, r: Array) -> Array:
        """K (rows, p) with KᵀK = half the Hessian of Σ ρ(r − J s) at s = 0.

        Beyond the threshold the loss is linear along r_i and bends across it only:
        (threshold/d) (I − u uᵀ), u = r_i/d.
        """
        if self.quadratic:
            return J
        d = self.lengths(r)
        far = d > self.threshold
        u = r.reshape(-1, self.size)[far] / d[far, None]
        K = J.reshape(len(d), self.size, -1).copy()
        across = K[far] - u[:, :, None] * np.einsum("ns,nsp->np", u, K[far])[:, None, :]
        K[far] = np.sqrt(self.threshold / d[far])[:, None, None] * across
        return K.reshape(J.shape)

    def lengths(self, r: Array) -> Array:
        """|r_i| (observations,)."""
        return np.linalg.norm(r.reshape(-1, self.size), axis=1)


def loss_of(name: LossName, size: int = 1, sigma: float = 1.0) -> Loss:
    """The loss by name; Huber's threshold gives 95 % efficiency at normal rows of std `sigma`."""
    require(name in ("squares", "huber"), f"loss is 'squares' or 'huber', found {name!r}")
    require(size >= 1, f"an observation has at least one row, found size = {size}")
    return Loss(size=size) if name == "squares" else Loss(huber(size).c * sigma, size)


@dataclass(frozen=True)
class Objective:
    """f(x) = Σ ρ(y − B x) + |target − P x|²: B (rows, p), y (rows,), P (k, p), target (k,)."""

    B: Array
    y: Array
    P: Array
    target: Array
    loss: Loss

    def moved(self, centre: Array, unit: Array) -> Objective:
        """f as a function of z, where x = centre + unit · z."""
        return replace(
            self,
            B=self.B * unit,
            y=self.y - self.B @ centre,
            P=self.P * unit,
            target=self.target - self.P @ centre,
        )

    def value(self, x: Array) -> float:
        lack = self.target - self.P @ x
        return self.loss.value(self.y - self.B @ x) + float(lack @ lack)

    def half_gradient(self, x: Array) -> Array:
        """∇f/2 (p,)."""
        r = self.y - self.B @ x
        return -(self.B.T @ (self.loss.weights(r) * r)) - self.P.T @ (self.target - self.P @ x)

    def root(self, x: Array) -> Array:
        """K (rows + k, p) with KᵀK = half the Hessian of f at x."""
        return np.vstack([self.loss.root(self.B, self.y - self.B @ x), self.P])

    @property
    def norms(self) -> Array:
        """Lengths (p,) of the columns of B and P together; 1 for an empty column."""
        norms = np.sqrt((self.B**2).sum(axis=0) + (self.P**2).sum(axis=0))
        return np.where(norms > 0, norms, 1.0)
