"""The choice of poses as a problem: candidates with their information, shares, a criterion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import require
from elastocal.planning.criterion import Criterion

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class DesignProblem:
    """Choose shares[l] of the candidates of each group l so that Φ(M) is smallest.

    `blocks` (S, N, r, p): whitened, scaled B of candidate i under scenario s of the arm;
    M_s(w) = prior_s + Σ_i w_i B_siᵀ B_si with `prior` (S, p, p) from prior knowledge and from
    measurements already done.  `group` (N,) in 0 … L−1 and `shares` (L,) the numbers of poses.
    `most`: how often one candidate may be measured in a plan.
    """

    blocks: Array
    prior: Array
    group: IntArray
    shares: IntArray
    criterion: Criterion
    most: int = 1

    def __post_init__(self) -> None:
        S, N, _, p = self.blocks.shape
        require(self.prior.shape == (S, p, p), f"prior is {self.prior.shape}, not {(S, p, p)}")
        require(self.group.shape == (N,), f"group is {self.group.shape}, not {(N,)}")
        available = np.bincount(self.group, minlength=len(self.shares)) * self.most
        short = np.flatnonzero(available < self.shares)
        require(
            len(short) == 0,
            f"group {short[0] if len(short) else 0} has fewer candidates than its share",
        )

    @property
    def n_candidates(self) -> int:
        return int(self.blocks.shape[1])

    @property
    def n_poses(self) -> int:
        return int(self.shares.sum())

    def information(self, weights: Array) -> Array:
        """M (S, p, p) at weights w (N,); candidates of weight 0 cost nothing."""
        used = np.flatnonzero(weights)
        return self.prior + self.sum_of(used, np.asarray(weights)[used])

    def sum_of(self, chosen: IntArray, weights: Array | None = None) -> Array:
        """Σ w_i B_siᵀ B_si (S, p, p) over the candidates `chosen` (k,)."""
        S, _, r, p = self.blocks.shape
        B = self.blocks[:, chosen]
        if weights is not None:
            B = B * np.sqrt(weights)[None, :, None, None]
        B = B.reshape(S, len(chosen) * r, p)
        return np.asarray(B.transpose(0, 2, 1) @ B)

    def sensitivity(self, G: Array) -> Array:
        """d (N,): d_i = Σ_s tr(B_si G_s B_siᵀ) = −∂Φ/∂w_i for G (S, p, p) of the criterion."""
        S, N, r, p = self.blocks.shape
        d = np.zeros(N)
        for s in range(S):
            flat = self.blocks[s].reshape(N * r, p)
            d += np.einsum("ij,ij->i", flat @ G[s], flat).reshape(N, r).sum(axis=1)
        return d
