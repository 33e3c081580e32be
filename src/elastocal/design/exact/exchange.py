"""Fedorov exchange: a plan that no single pose of the pool betters in another's place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.design.exact.pool import without
from elastocal.design.problem import Array, DesignProblem, IntArray
from elastocal.errors import InsufficientDataError

Mask = NDArray[np.bool_]

# Relative gain in Φ below which an exchange is not made: rounding must not decide.
IMPROVEMENT = 1e-9
# Values that differ less are equal, and the candidate that comes first in the pool is taken.
TIE = 1e-11
# Candidates evaluated at first; each further batch is larger by GROWTH.
FIRST, GROWTH = 32, 4


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
    free: Mask

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
    state = _State.of(problem, chosen)
    passes, improved = 0, True
    while improved:
        passes, improved = passes + 1, False
        poses = np.unique(state.chosen)
        for out in poses[np.argsort(state.d[poses], kind="stable")]:
            better = _exchanged(problem, state, int(out))
            if better is not None:
                state, improved = better, True
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
    while len(values) < len(candidates) and upper[len(values)] * best > 1 - TIE:
        part = candidates[len(values) : len(values) + size]
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
    B = problem.blocks[:, candidates]
    S, k, r, p = B.shape
    weighted = B.reshape(S, k * r, p) @ gradient.G
    d = np.einsum("skj,skj->k", weighted.reshape(S, k, r * p), B.reshape(S, k, r * p))
    return np.asarray((1 + d / gradient.value) / gradient.value)
