"""The choice of poses as a problem, and a lower bound on what any plan can reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.errors import require
from elastocal.planning.criterion import Criterion, Gradient
from elastocal.units import Array, IntArray

# The choice of poses as a problem: candidates with their information, shares, a criterion.


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


# How good the best plan can be at most: a lower bound on Φ from the concavity of 1/Φ.
#
# Let ψ = 1/Φ: concave, homogeneous of degree 1, and by Φ's gradient G = −∂Φ/∂M its slope is
# G/Φ².  Euler's identity gives ψ(M) = ⟨G/Φ², M⟩, so the tangent at M lies above ψ everywhere:
#
#     ψ(M') ≤ ψ(M) + ⟨G/Φ², M' − M⟩ = ⟨G, M'⟩/Φ²   for every information M',
#
# ⟨G, M⟩ = Σ_s tr(G_s M_s).  With M' = prior + Σ w'_i A_i and d_i = ⟨G, A_i⟩ the right side is
# linear in w', and therefore
#
#     Φ(w') ≥ Φ² / (⟨G, prior⟩ + max_w' Σ w'_i d_i) = Φ / (1 + gap/Φ)
#     gap   = max_w' Σ (w'_i − w_i) d_i
#
# for all weights 0 ≤ w'_i ≤ most with Σ_{i∈l} w'_i = n_l, exact plans among them.  The maximum is
# taken greedily: in each group the largest d_i, `most` times each, until n_l poses are placed.
# Without prior information and without the box it is Σ_l n_l max_{i∈l} d_i, the bound
# Φ²/Σ_l n_l max d_i of level shares; with one group and shares summing to 1, Φ²/max d_i.
#
# Sources: Pukelsheim, Optimal Design of Experiments (2006), ch. 5 (information functions) and 7
# (general equivalence theorem); Harman, Filová & Richtárik, J. Am. Stat. Assoc. 115 (2020) 348.


def lower_bound(problem: DesignProblem, weights: Array) -> float:
    """A value that Φ of no plan with these candidates and shares falls below.

    Valid for any `weights` (N,) ≥ 0, tight at the optimum of a smooth criterion.  Where Φ has a
    kink (E, G, worst case) the subgradient that the criterion returns is one of many and the
    bound may be loose; `relax` finds the one that makes it tight.  0 where M(w) is singular.
    """
    require(
        problem.criterion.certifiable,
        f"criterion {problem.criterion.name} {problem.criterion.without_bound}, so it has no "
        "certified bound",
    )
    M = problem.information(weights)
    if not np.isfinite(problem.criterion.value(M)):
        return 0.0
    return tangent_bound(problem, problem.criterion.gradient(M))


def tangent_bound(problem: DesignProblem, tangent: Gradient, d: Array | None = None) -> float:
    """Φ²/max_w' ⟨G, M(w')⟩ of a tangent (Φ, G) taken at any information matrix.

    `d` (N,): the sensitivities of G where the caller has them.  The tangent may also belong to
    any information function that lies below Φ, such as a weighted mean of the pieces whose
    maximum Φ is.
    """
    d = problem.sensitivity(tangent.G) if d is None else d
    reach = largest_sum(d, problem.group, problem.shares, problem.most)
    return tangent.value**2 / (float(np.sum(tangent.G * problem.prior)) + reach)


def largest_sum(d: Array, group: IntArray, shares: IntArray, most: int) -> float:
    """max Σ w_i d_i over 0 ≤ w_i ≤ most with Σ_{i∈l} w_i = shares[l]; d (N,), group (N,)."""
    total = 0.0
    for level, share in enumerate(shares):
        full, rest = divmod(int(share), most)
        taken = full + (rest > 0)
        if taken == 0:
            continue
        of_level = d[group == level]
        best = np.sort(np.partition(of_level, len(of_level) - taken)[len(of_level) - taken :])
        total += most * float(best[taken - full :].sum()) + rest * float(best[0])
    return total


def efficiency(value: float, bound: float) -> float:
    """bound/Φ in (0, 1]: a plan of efficiency 0.99 is at most 1 % above the best possible Φ."""
    return min(bound / value, 1.0)
