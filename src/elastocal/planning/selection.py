"""The choice of poses as a problem, a lower bound on what any plan can reach, and exchanges."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from elastocal.errors import InsufficientDataError, require
from elastocal.planning.criterion import (
    BATCH_NUMBERS,
    SINGULAR,
    Criterion,
    Gradient,
    factorise,
    trustworthy,
)
from elastocal.units import Array, BoolArray, IntArray

# The choice of poses as a problem: candidates with their information, shares, a criterion.

# Packed information larger than this (bytes) is not stored; pricing then goes through the blocks.
PACKED_BYTES = 1_500_000_000
MANY = 0.25  # of the candidates: pricing so many, one product with all costs less than a choice


@dataclass(frozen=True)
class DesignProblem:
    """Choose shares[l] of the candidates of each group l so that Φ(M) is smallest.

    `blocks` (S, N, r, p): whitened, scaled B of candidate i under scenario s of the arm;
    M_s(w) = prior_s + Σ_i w_i B_siᵀ B_si with `prior` (S, p, p) from prior knowledge and from
    measurements already done.  `group` (N,) in 0 … L−1 and `shares` (L,) the numbers of poses.
    `most`: how often one candidate may be measured in a plan.  `looks`: how many candidates an
    exchange evaluates at most, the most promising; None: as many as may be the best.
    """

    blocks: Array
    prior: Array
    group: IntArray
    shares: IntArray
    criterion: Criterion
    most: int = 1
    looks: int | None = None

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

    def sensitivity(self, G: Array, some: IntArray | None = None) -> Array:
        """d (N,): d_i = Σ_s tr(B_si G_s B_siᵀ) = −∂Φ/∂w_i for G (S, p, p) of the criterion; of
        the candidates `some` (k,) alone where given."""
        if self.packed is not None:
            rows, columns, factor = triangle(G.shape[-1])
            flat = G[:, rows, columns] * factor
            few = some is not None and len(some) < MANY * self.n_candidates
            of = self.packed[:, some] if few else self.packed
            d = np.asarray((of @ flat[:, :, None])[..., 0].sum(axis=0))
            return d if few or some is None else d[some]
        blocks = self.blocks if some is None else self.blocks[:, some]
        S, N, r, p = blocks.shape
        d = np.zeros(N)
        for s in range(S):
            flat = blocks[s].reshape(N * r, p)
            d += np.einsum("ij,ij->i", flat @ G[s], flat).reshape(N, r).sum(axis=1)
        return d

    def matrices(self, chosen: IntArray) -> Array:
        """A (S, k, p, p), B_siᵀB_si of the candidates `chosen` (k,)."""
        B = self.blocks[:, chosen]
        return np.asarray(B.swapaxes(-1, -2) @ B)

    @cached_property
    def packed(self) -> Array | None:
        """A_si = B_siᵀB_si as its upper triangle with √2 off the diagonal (S, N, p(p+1)/2), so
        that ⟨G, A_si⟩ is a dot product, where the blocks would need r·p² operations; None where
        that takes too much memory."""
        S, N, _, p = self.blocks.shape
        rows, columns, factor = triangle(p)
        if 8 * S * N * len(rows) > PACKED_BYTES:
            return None
        found = np.empty((S, N, len(rows)))
        step = max(BATCH_NUMBERS // (S * p * p), 1)
        for start in range(0, N, step):
            A = self.matrices(np.arange(start, min(start + step, N)))
            found[:, start : start + step] = A[..., rows, columns] * factor
        return found

    def __getstate__(self) -> dict[str, Any]:
        """Without what can be formed anew: tasks for other processes stay small."""
        return {name: value for name, value in self.__dict__.items() if name != "packed"}


@lru_cache
def triangle(p: int) -> tuple[IntArray, IntArray, Array]:
    """Rows, columns (k,) of the upper triangle of (p, p), and √2 off its diagonal, else 1."""
    rows, columns = np.triu_indices(p)
    return rows, columns, np.where(rows == columns, 1.0, np.sqrt(2.0))


def in_terms(problem: DesignProblem, T: Array) -> DesignProblem | None:
    """The problem of the parameters z, y = T_s z, T (S, p, k); None where the criterion belongs to
    its own.  Where k < p, what T leaves out is taken for known: no plan has a larger Φ than before.
    """
    criterion, prior = problem.criterion.turned(T), T.swapaxes(-1, -2) @ problem.prior @ T
    if criterion is None:
        return None
    return replace(
        problem,
        blocks=problem.blocks @ T[:, None],
        prior=(prior + prior.swapaxes(-1, -2)) / 2,
        criterion=criterion,
    )


def balanced(
    problem: DesignProblem, tangent: Gradient | None
) -> tuple[DesignProblem, Gradient | None]:
    """The problem, and a tangent of it, for other parameters: those whose information at even
    weights is 1.  The same plans have the same Φ.

    Where base, markers and geometry are identified together, information is conditioned so badly
    that no update of Φ by one pose keeps its digits, and each candidate would need a new inverse.
    Left as it is where that is not so, or where the criterion belongs to its parameters.
    """
    size = np.bincount(problem.group, minlength=len(problem.shares))
    even = (problem.shares / np.maximum(size, 1))[problem.group]
    factor = factorise(problem.information(even))
    if trustworthy(factor) or not factor.regular.all():
        return problem, tangent
    T, L = factor.inverse.swapaxes(-1, -2), factor.L
    turned = in_terms(problem, T)
    if turned is None:
        return problem, tangent
    if tangent is not None:
        tangent = Gradient(tangent.value, L.swapaxes(-1, -2) @ tangent.G @ L)
    return turned, tangent


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


# Exact plans by exchange: from weights to whole poses, and no single pose betters the plan.

# Relative gain in Φ below which an exchange is not made: rounding must not decide.
IMPROVEMENT = 1e-9
# Values that differ less are equal, and the candidate that comes first in the pool is taken.
TIE = 1e-11
# Candidates evaluated at first; each further batch is larger by GROWTH.
FIRST, GROWTH = 8, 4
# Ridges, as shares of a candidate's mean information, under which a regular plan is looked for.
RIDGES = (1e-3, 1e-6, 1e-9)
ATTEMPTS = 20
# Singular values of a block, relative to its largest, below which a direction is not shown.
SHOWN = 1e-10
# Changes in vain after which a start is done, and how many poses each of them moves at most.
PATIENCE = 12
MOVED = 8
# Order of the power means that stand for a maximum: smooth, and within a few per cent of it.
SOFT = 30.0


@dataclass(frozen=True)
class Exchanged:
    """Sorted plan (n_poses,), its Φ, and the number of passes over its poses."""

    chosen: IntArray
    value: float
    passes: int


@dataclass(frozen=True)
class _State:
    """A plan with Φ, the sensitivities d (N,) of all candidates at its information, and which of
    them (N,) may be measured once more."""

    chosen: IntArray
    value: float
    d: Array
    free: BoolArray

    @classmethod
    def of(cls, problem: DesignProblem, chosen: IntArray) -> _State:
        gradient = problem.criterion.gradient(problem.prior + problem.sum_of(chosen))
        free = np.bincount(chosen, minlength=problem.n_candidates) < problem.most
        return cls(chosen, gradient.value, problem.sensitivity(gradient.G), free)


def exchange(problem: DesignProblem, chosen: IntArray) -> Exchanged:
    """Exchanges within the groups until none of them lowers Φ by more than 1e-9 of its value.

    In each pass every pose, the least contributing first, is exchanged for the candidate of its
    group, among all, that is best in its place (Cook & Nachtsheim 1980, Technometrics 22,
    315–324).  `chosen` (n_poses,) must be sorted and its information regular, else
    InsufficientDataError.

    1/Φ is concave: j → i can only lower Φ where d_i > d_j, and leaves
    1/Φ ≤ 1/Φ₋ + d_i⁻/Φ₋², Φ₋ and d⁻ being those of the plan without j.  Candidates are therefore
    evaluated in the order of that bound until the best found exceeds all that are left: the result
    is that of evaluating the whole pool, for a few per cent of its candidates.
    """
    state, passes = _State.of(problem, chosen), 0
    in_vain: set[int] = set()  # poses of the plan as it stands for which none is better
    while len(in_vain) < len(poses := np.unique(state.chosen)):
        passes += 1
        for out in poses[np.argsort(state.d[poses], kind="stable")].tolist():
            better = None if out in in_vain else _exchanged(problem, state, out)
            state, in_vain = (state, in_vain | {out}) if better is None else (better, set())
    return Exchanged(state.chosen, state.value, passes)


def _exchanged(problem: DesignProblem, state: _State, out: int) -> _State | None:
    """The plan with the best candidate in the place of `out`; None where none betters it."""
    into = state.free & (problem.group == problem.group[out])
    into[out] = False
    if problem.criterion.certifiable:
        into &= state.d > state.d[out] + IMPROVEMENT * state.value
    candidates = np.flatnonzero(into)
    if not len(candidates):
        return None
    rest = without(state.chosen, out)
    best = best_addition(problem, problem.prior + problem.sum_of(rest), candidates, state.value)
    if best is None:
        return None
    better = _State.of(problem, np.sort(np.append(rest, best)))
    # Formed anew: where M is nearly singular, the prediction may promise what rounding takes.
    return better if better.value < state.value * (1 - IMPROVEMENT) else None


def best_addition(
    problem: DesignProblem, M: Array, candidates: IntArray, below: float = np.inf
) -> int | None:
    """The candidate with the smallest Φ(M_s + B_siᵀB_si), if that is less than `below`.

    M (S, p, p) may be singular; then no bound is known and all candidates are evaluated.
    """
    upper = _upper(problem, M, candidates)
    order = np.argsort(-upper, kind="stable")
    candidates, upper = candidates[order], upper[order]
    values = np.empty(0)
    best, size = below * (1 - IMPROVEMENT), FIRST
    if problem.looks is not None and len(upper) and np.isfinite(upper[0]):
        candidates, upper = candidates[: problem.looks], upper[: problem.looks]
    while (left := int(np.count_nonzero(upper * best > 1 - TIE))) > len(values):
        part = candidates[len(values) : min(len(values) + size, left)]
        added = problem.criterion.after_adding(M, problem.blocks[:, part])
        values = np.concatenate([values, added])
        best, size = min(best, float(added.min())), size * GROWTH
    found = candidates[: len(values)][values <= best * (1 + TIE)]
    return int(found.min()) if len(found) and np.isfinite(best) else None


def _upper(problem: DesignProblem, M: Array, candidates: IntArray) -> Array:
    """Bounds (k,) on 1/Φ(M_s + B_siᵀB_si); inf where none is known or none is worth its cost."""
    unknown = np.full(len(candidates), np.inf)
    if not problem.criterion.certifiable or len(candidates) <= FIRST:
        return unknown
    try:
        gradient = problem.criterion.gradient(M)
    except InsufficientDataError:
        return unknown
    d = problem.sensitivity(gradient.G, candidates)
    return np.asarray((1 + d / gradient.value) / gradient.value)


def iterated_search(
    problem: DesignProblem, chosen: IntArray, rng: np.random.Generator
) -> Exchanged:
    """Iterated local search (Lourenço, Martin & Stützle 2003) from a regular plan `chosen`.

    The best plan so far is changed in two to MOVED poses and exchanged anew, until PATIENCE
    changes in a row led to nothing better.  An exchange optimum is left where the better plan
    differs by two poses or more, which no single exchange can see.
    """
    best = _descended(problem, chosen)
    passes, failed = best.passes, 0
    while failed < PATIENCE:
        changed = _changed(problem, best.chosen, rng)
        failed += 1
        if not is_regular(problem.prior + problem.sum_of(changed)):
            continue
        found = _descended(problem, changed)
        passes += found.passes
        if found.value < best.value * (1 - IMPROVEMENT):
            best, failed = found, 0
    return Exchanged(best.chosen, best.value, passes)


def _descended(problem: DesignProblem, chosen: IntArray) -> Exchanged:
    """Exchanges on the softened criterion first, where Φ has kinks.

    What lowers a maximum is shut out wherever two of its arguments are equal and each exchange
    raises one of them; the softened criterion weighs them against each other.
    """
    passes, smooth = 0, problem.criterion.softened(SOFT)
    if smooth is not problem.criterion:
        first = exchange(replace(problem, criterion=smooth), chosen)
        chosen, passes = first.chosen, first.passes
    found = exchange(problem, chosen)
    return replace(found, passes=found.passes + passes)


def _changed(problem: DesignProblem, chosen: IntArray, rng: np.random.Generator) -> IntArray:
    """The plan with some of its poses replaced by random ones of their groups."""
    n = len(chosen)
    moved = rng.choice(chosen, min(int(rng.integers(2, MOVED + 1)), n), replace=False)
    for out in moved:
        rest = without(chosen, out)
        into = rng.choice(admissible(problem, rest, int(problem.group[out])))
        chosen = np.sort(np.append(rest, into))
    return chosen


def greedy_plan(problem: DesignProblem, begun: IntArray | None = None) -> IntArray:
    """A plan (n_poses,), sorted: `begun` extended, each time by the pose that lowers Φ most.

    While the information is singular and Φ infinite, the pose that raises the determinant most
    above a vanishing ridge.  The plan may still be singular: see `regular_plan`.
    """
    chosen = np.empty(0, dtype=np.int64) if begun is None else begun
    extra = RIDGES[-1] * ridge(problem)
    while len(chosen) < problem.n_poses:
        taken = np.bincount(problem.group[chosen], minlength=len(problem.shares))
        open_groups = np.flatnonzero(problem.shares > taken)
        into = np.sort(np.concatenate([admissible(problem, chosen, int(g)) for g in open_groups]))
        M = problem.prior + problem.sum_of(chosen)
        best = best_addition(problem, M, into) if is_regular(M) else None
        if best is None:
            best = into[np.argmax(log_det_gain(M + extra, problem.blocks[:, into]))]
        chosen = np.sort(np.append(chosen, best))
    return chosen


def fitted(problem: DesignProblem, chosen: IntArray) -> IntArray:
    """A plan (n_poses,), sorted, of these shares from one of others.

    Where a group holds more than its share, the poses that Φ misses least go; then `greedy_plan`
    fills up.  Where no share is smaller than before the result is therefore never worse.
    """
    chosen = np.sort(chosen)
    while True:
        taken = np.bincount(problem.group[chosen], minlength=len(problem.shares))
        surplus = np.flatnonzero((taken > problem.shares)[problem.group[chosen]])
        if not len(surplus):
            return greedy_plan(problem, chosen)
        least = surplus[np.argmin(values_without(problem, chosen)[surplus])]
        chosen = np.delete(chosen, least)


def is_regular(M: Array) -> bool:
    """Are all of M (S, p, p) regular, by a margin that no order of summation or columns uses up?"""
    return bool((factorise(M).condition < SINGULAR / 10).all())


def check_enough(problem: DesignProblem) -> None:
    """Raise InsufficientDataError where no plan of these shares can determine all parameters."""
    _, _, r, p = problem.blocks.shape
    n = problem.n_poses
    # How many combinations of parameters the prior determines.
    known = min(int(np.linalg.matrix_rank(prior, hermitian=True)) for prior in problem.prior)
    needed = -(-(p - known) // r)
    if n < needed:
        prior = f" and the prior {known}" if known else ""
        raise InsufficientDataError(
            f"fewer equations than parameters: {n} poses of {r} readings give {n * r}{prior}, for "
            f"{p} parameters; plan at least {needed} poses, switch effects off or state a prior"
        )
    usable = np.flatnonzero(problem.shares[problem.group] > 0)
    if not is_regular(problem.prior + problem.sum_of(usable)):
        raise InsufficientDataError(
            f"all {len(usable)} candidates of the groups with a share together do not determine "
            f"the {p} parameters; allow other joint levels or more load, or switch effects off"
        )


def log_det_gain(M: Array, blocks: Array) -> Array:
    """Σ_s log det(1 + B_si M_s⁻¹ B_siᵀ) (k,) for blocks (S, k, r, p): what adding i brings."""
    inverse = np.linalg.inv(M)[:, None]
    inner = blocks @ inverse @ blocks.swapaxes(-1, -2)
    return np.asarray(np.linalg.slogdet(np.eye(blocks.shape[2]) + inner)[1].sum(axis=0))


def ridge(problem: DesignProblem) -> Array:
    """Diagonal matrices (S, p, p): the mean information of the candidates, parameter by parameter.

    Parameters that differ in scale by orders of magnitude are so treated alike; 1 where no
    candidate shows a parameter.
    """
    mean = np.einsum("snrp,snrp->sp", problem.blocks, problem.blocks) / problem.n_candidates
    mean = np.where(mean > 0, mean, 1.0)
    return np.asarray(mean[:, :, None] * np.eye(mean.shape[1]))


def regular_plan(problem: DesignProblem, chosen: IntArray, rng: np.random.Generator) -> IntArray:
    """A plan of regular M near `chosen`: exchanges that raise Σ_s log det(M_s + δ), δ → 0.

    For small δ a determinant counts the rank first.  Each candidate stands with an orthonormal
    basis of what it shows, which leaves ranks as they are and lets no large candidate outweigh
    one that shows what the others do not.  Random plans are tried where `chosen` leads to none;
    raises InsufficientDataError where they do not either.
    """
    if is_regular(problem.prior + problem.sum_of(chosen)):
        return chosen
    even = _evened(problem)
    unit = np.eye(problem.blocks.shape[-1])
    for _ in range(ATTEMPTS):
        for delta in RIDGES:
            chosen = _raise_determinant(even, chosen, delta * unit)
            if is_regular(problem.prior + problem.sum_of(chosen)):
                return chosen
        chosen = random_plan(problem, rng)
    raise InsufficientDataError(
        f"no plan of {problem.n_poses} poses that determines all {len(unit)} parameters was found; "
        "plan more poses, other shares, or state a prior"
    )


def _evened(problem: DesignProblem) -> DesignProblem:
    """The problem with an orthonormal basis of its rows in place of each block, parameters in
    units of their mean information beforehand."""
    scale = 1 / np.sqrt(np.einsum("spp->sp", ridge(problem) + problem.prior))
    _, size, basis = np.linalg.svd(problem.blocks * scale[:, None, None, :], full_matrices=False)
    shown = size > SHOWN * size[..., :1]
    prior = problem.prior * scale[:, :, None] * scale[:, None, :]
    return replace(problem, blocks=basis * shown[..., None], prior=prior)


def _raise_determinant(problem: DesignProblem, chosen: IntArray, extra: Array) -> IntArray:
    """Exchanges, each the best for its pose, until none raises the determinant."""
    improved = True
    while improved:
        improved = False
        for out in np.unique(chosen):
            rest = without(chosen, out)
            into = admissible(problem, rest, int(problem.group[out]))
            M = problem.prior + extra + problem.sum_of(rest)
            gain = log_det_gain(M, problem.blocks[:, into])
            best = int(np.argmax(gain))
            if gain[best] > gain[np.searchsorted(into, out)] + 1e-6:
                chosen, improved = np.sort(np.append(rest, into[best])), True
    return chosen


def information_without(problem: DesignProblem, chosen: IntArray) -> Array:
    """M (n, S, p, p) of the plan `chosen` (n,) without its k-th pose, for every k.

    Sums of what comes before and after k: no subtraction, so that a pose that alone determines a
    parameter leaves an exactly singular M.
    """
    B = problem.blocks[:, chosen]
    each = np.einsum("snri,snrj->nsij", B, B, optimize=True)
    before, after = np.zeros_like(each), np.zeros_like(each)
    before[1:] = np.cumsum(each[:-1], axis=0)
    after[:-1] = np.cumsum(each[:0:-1], axis=0)[::-1]
    return np.asarray(problem.prior + before + after)


def values_without(problem: DesignProblem, chosen: IntArray) -> Array:
    """Φ (n,) of the plan `chosen` (n,) without its k-th pose; inf where nothing replaces it."""
    return problem.criterion.value(information_without(problem, chosen))


def admissible(problem: DesignProblem, rest: IntArray, label: int) -> IntArray:
    """Candidates (k,) of the group that the plan `rest` does not yet use `most` times."""
    free = problem.group == label
    used, times = np.unique(rest, return_counts=True)
    free[used[times >= problem.most]] = False
    return np.flatnonzero(free)


def without(chosen: IntArray, candidate: int) -> IntArray:
    """The sorted plan `chosen` with one pose at `candidate` less."""
    return np.delete(chosen, np.searchsorted(chosen, candidate))


def random_plan(problem: DesignProblem, rng: np.random.Generator) -> IntArray:
    """A plan (n_poses,), sorted, drawn uniformly from the places that shares and cap leave."""
    plan = [np.empty(0, dtype=np.int64)]
    for label, share in enumerate(problem.shares):
        places = np.repeat(np.flatnonzero(problem.group == label), problem.most)
        plan.append(rng.choice(places, int(share), replace=False))
    return np.sort(np.concatenate(plan))
