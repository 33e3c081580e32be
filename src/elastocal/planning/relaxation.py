"""The relaxation: weights instead of whole poses, solved to a certified gap.

A small support of candidates is solved exactly by one of two masters, and all other candidates are
priced against it by their first derivatives until none of them gains (column generation).  The
masters, Newton's method of `interior_point` and a conic program for clarabel, are written
independently of each other, so that each checks the other.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Literal, get_args

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from elastocal.errors import InsufficientDataError, require
from elastocal.planning.criterion import (
    Cone,
    Criterion,
    Gradient,
    ScenarioCriterion,
    Term,
    Worst,
)
from elastocal.planning.selection import DesignProblem, largest_sum, tangent_bound, triangle
from elastocal.units import Array, IntArray, Progress

# Newton's method for a few hundred candidates: a primal–dual interior point with exact Hessian.
#
#     minimise max_j f_j(w),  f_j = log Φ_j(M(w)),   subject to  E w = n,  0 ≤ w ≤ u.
#
# f_j is convex since 1/Φ_j is concave; E (L, k) sums the weights of each level.  For σ → 0 the
# barrier function
#
#     F_σ(w) = min_τ [τ − σ Σ_j log(τ − f_j)] − σ Σ_i log w_i − σ Σ_i log(u − w_i)
#
# is minimised by Newton steps in which the barrier's own curvatures σ/s_j², σ/w_i², σ/(u − w_i)²
# are replaced by μ_j/s_j, z_i/w_i, y_i/(u − w_i) with multipliers that follow their own Newton
# steps; s_j = τ − f_j.  F_σ decreases in every step, so that no start can fail, and the multipliers
# give the fast last steps and the bound.  Boyd & Vandenberghe, Convex Optimization (2004), ch. 11;
# Wächter & Biegler, Math. Program. 106 (2006) 25, for keeping the multipliers near σ/w.

MOST_STEPS = 100
TO_BOUNDARY = 0.99
# Reduction of σ, once the decrement λ² of Newton's step is below CENTRED · σ · (constraints).
REDUCTION = 0.1
CENTRED = 0.3
# and no multiplier further than this |log| from σ/slack.
SPREAD = 2.0
ARMIJO = 1e-4
# A gap that should be below the accuracy is, for σ below this part of it, hidden by rounding.
FINEST = 1e-2
# Multipliers stay within this factor of σ/slack.
NEAR = 1e4
# Relative to the mean diagonal of the Hessian: keeps it definite to rounding.
RIDGE = 1e-14


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


@dataclass(frozen=True)
class SmoothPieces:
    """Φ(M) = max_j Φ_j, Φ_j = Σ_t mix_jt φ_t(M_s(t)⁻¹).

    `terms`: one Term per scenario s; the columns of `mix` (J, T) ≥ 0 are their functions in order.
    One row is a smooth criterion (a mean over scenarios), the identity the worst case.
    """

    terms: tuple[Term, ...]
    mix: Array

    def at(self, M: Array) -> LocalPieces | None:
        """Φ_j and derivatives at M (S, p, p); None where M is not positive definite."""
        try:
            root = np.linalg.inv(np.linalg.cholesky(M))
        except np.linalg.LinAlgError:
            return None
        V = root.transpose(0, 2, 1) @ root
        slopes = [term.slope(V_s) for term, V_s in zip(self.terms, V, strict=True)]
        values = self.mix @ np.concatenate([value for value, _ in slopes])
        if not np.all(np.isfinite(values)):
            return None
        return LocalPieces(self, V, values, [C for _, C in slopes])


@dataclass(frozen=True)
class LocalPieces:
    """The pieces at one M: V (S, p, p), `values` Φ_j (J,), C = ∂φ/∂V of each scenario's terms."""

    pieces: SmoothPieces
    V: Array
    values: Array
    C: list[Array]

    def shares(self, mu: Array) -> list[Array]:
        """Σ_j μ_j mix_jt/Φ_j (T_s,) per scenario: how much each term counts in Σ μ_j log Φ_j."""
        counts = np.cumsum([term.count for term in self.pieces.terms])[:-1]
        return list(np.split((mu / self.values) @ self.pieces.mix, counts))

    def slopes(self, A: Array) -> Array:
        """−∂ log Φ_j/∂w_i (J, k) for A (S, k, p, p)."""
        of_terms = []
        for V, C, A_s in zip(self.V, self.C, A, strict=True):
            G = V @ C @ V
            of_terms.append(G.reshape(len(G), -1) @ A_s.reshape(len(A_s), -1).T)
        return np.asarray(self.pieces.mix @ np.concatenate(of_terms)) / self.values[:, None]

    def tangent(self, mu: Array) -> Gradient:
        """Φ_μ = Σ c_j Φ_j ≤ Φ with c_j ∝ μ_j/Φ_j, Σ c_j = 1, and its G.

        1/Φ_μ is concave as 1/Φ is, so the tangent bounds Φ too; at the optimum, where μ are the
        multipliers, it is tight, while a single piece would not be.
        """
        scale = 1.0 / np.sum(mu / self.values)
        shares = self.shares(mu)
        C = np.stack([np.tensordot(c, C, 1) for c, C in zip(shares, self.C, strict=True)])
        return Gradient(float(scale * mu.sum()), scale * (self.V @ C @ self.V))

    def hessian(self, A: Array, mu: Array, slopes: Array) -> Array:
        """Σ_j μ_j ∂² log Φ_j/∂w_i∂w_j (k, k); `slopes` (J, k) as from `slopes`."""
        k = A.shape[1]
        H = -(slopes.T * mu) @ slopes
        for term, share, V, C, A_s in zip(
            self.pieces.terms, self.shares(mu), self.V, self.C, A, strict=True
        ):
            AV = A_s @ V
            G = V @ np.tensordot(share, C, 1) @ V
            # tr(A_i V A_j G): A_i V beside the transpose of A_j G.
            H += 2.0 * AV.reshape(k, -1) @ (A_s @ G).transpose(0, 2, 1).reshape(k, -1).T
            curvature = term.curvature(V, V @ AV)
            if curvature is not None:
                H += share[0] * curvature
        return 0.5 * (H + H.T)


def pieces_of(criterion: Criterion, scenarios: int) -> SmoothPieces | None:
    """The criterion as a maximum of smooth pieces, from its terms; None where it is none.

    These are E and its O3, whose pieces would be all directions, and the mean over several
    scenarios of a maximum.
    """
    worst = isinstance(criterion, Worst) or scenarios == 1
    if isinstance(criterion, Worst) and criterion.order != np.inf:
        return None
    base = criterion.base if isinstance(criterion, Worst) else criterion
    assert isinstance(base, ScenarioCriterion)
    terms = []
    for s in range(scenarios):
        term = base.term(s)
        if term is None or not (worst or term.count == 1):
            return None
        terms.append(term)
    count = sum(term.count for term in terms)
    return SmoothPieces(tuple(terms), np.eye(count) if worst else np.full((1, count), 1.0 / count))


@dataclass(frozen=True)
class BarrierPoint:
    """w (k,) inside its bounds, the pieces there, their slacks s (J,) and F_σ as `merit`."""

    w: Array
    local: LocalPieces
    s: Array
    merit: float


def _central(task: Restricted, point: BarrierPoint, sigma: float) -> Array:
    """Multipliers (J + 2k,) on the central path: of the pieces, of w ≥ 0 and of w ≤ u."""
    return sigma / np.concatenate([point.s, point.w, task.most - point.w])


def _solve(
    pieces: SmoothPieces, task: Restricted, start: Array, accuracy: float
) -> tuple[Array, Array]:
    """Weights w (k,) whose log Φ is within `accuracy` of the least, and multipliers μ (J,).

    `start` (k,) strictly inside its bounds with the right sums per level.
    """
    local = pieces.at(task.information(start))
    assert local is not None  # every support sees what the pool sees
    J, count = len(local.values), 2 * len(start) + len(local.values)
    mu = np.full(J, 1.0 / J)
    gap = _gap(task, start, local, mu, local.slopes(task.A))
    if gap <= accuracy:
        return start, mu
    sigma = gap / count
    point = _barrier(local, task, start, sigma)
    at = _central(task, point, sigma)
    best = (gap, start, mu)
    for _ in range(MOST_STEPS):
        slopes = point.local.slopes(task.A)
        gap = _gap(task, point.w, point.local, at[:J], slopes)
        if gap < best[0]:
            best = (gap, point.w, at[:J])
        if gap <= accuracy or sigma * count < FINEST * accuracy:
            break
        change, direction, decrement = _newton(task, point, at, slopes, sigma)
        # Where rounding hides any decrease of F the multipliers still have to settle.
        point = _search(pieces, task, point, direction, decrement, sigma) or point
        # All stay positive, and within NEAR of the central values.
        central = _central(task, point, sigma)
        at = np.clip(at + _step_to_boundary(at, change) * change, central / NEAR, central * NEAR)
        spread = float(np.abs(np.log(at / central)).max())
        if decrement <= CENTRED * count * sigma and spread <= SPREAD:
            sigma *= REDUCTION
            point = _barrier(point.local, task, point.w, sigma)
    return best[1], best[2] / best[2].sum()


def _newton(
    task: Restricted, point: BarrierPoint, at: Array, slopes: Array, sigma: float
) -> tuple[Array, Array, float]:
    """Steps of the multipliers `at` (J + 2k,) and of w (k,), and the decrement −∇F·Δw."""
    w, room, s = point.w, task.most - point.w, point.s
    mu, z, y = np.split(at, np.cumsum([len(s), len(w)]))
    K = point.local.hessian(task.A, mu, slopes)
    stiff = mu / s
    centred = slopes - stiff @ slopes / stiff.sum()
    K += (centred.T * stiff) @ centred
    K[np.diag_indices_from(K)] += z / w + y / room + RIDGE * np.trace(K) / len(K)
    gradient = -(sigma / s) @ slopes - sigma / w + sigma / room

    factor = cho_factor(K, lower=True, overwrite_a=True, check_finite=False)
    E = (task.level == np.arange(len(task.shares))[:, None]).astype(float)
    solved = cho_solve(factor, np.column_stack([gradient, E.T]), check_finite=False)
    lam = np.linalg.solve(E @ solved[:, 1:], E @ solved[:, 0])
    dw = solved[:, 1:] @ lam - solved[:, 0]
    change = [
        sigma / s - mu - stiff * (centred @ dw),
        sigma / w - z * (1.0 + dw / w),
        sigma / room - y * (1.0 - dw / room),
    ]
    return np.concatenate(change), dw, float(-gradient @ dw)


def _search(
    pieces: SmoothPieces,
    task: Restricted,
    point: BarrierPoint,
    dw: Array,
    decrement: float,
    sigma: float,
) -> BarrierPoint | None:
    """The longest of halved steps that decreases F_σ enough; None where rounding allows none."""
    length = min(_step_to_boundary(point.w, dw), _step_to_boundary(task.most - point.w, -dw))
    while length > 1e-10:
        w = point.w + length * dw
        local = pieces.at(task.information(w))
        if local is not None:
            moved = _barrier(local, task, w, sigma)
            if moved.merit <= point.merit - ARMIJO * length * decrement:
                return moved
        length *= 0.5
    return None


def _barrier(local: LocalPieces, task: Restricted, w: Array, sigma: float) -> BarrierPoint:
    """F_σ at w; τ solves Σ_j σ/(τ − f_j) = 1 by Newton's method from the left."""
    f = np.log(local.values)
    below = f.max() - f
    excess = sigma
    for _ in range(50):
        s = below + excess
        missing = np.sum(sigma / s) - 1.0
        if missing <= 1e-14:
            break
        excess += missing / np.sum(sigma / s**2)
    logs = np.log(s).sum() + np.log(w).sum() + np.log(task.most - w).sum()
    return BarrierPoint(w, local, s, float(f.max() + excess - sigma * logs))


def _gap(task: Restricted, w: Array, local: LocalPieces, mu: Array, slopes: Array) -> float:
    """log Φ(w) minus the bound (see `tangent_bound`) of the restricted problem."""
    d = mu @ slopes / mu.sum()
    gain = largest_sum(d, task.level, task.shares, task.most) - d @ w
    below = mu.sum() / np.sum(mu / local.values)
    return float(np.log(local.values.max() / below) + np.log1p(gain))


def _step_to_boundary(value: Array, step: Array) -> float:
    """The longest step in (0, 1] that leaves 1 % of every positive value."""
    shrink = np.min(step / value)
    return 1.0 if shrink >= -TO_BOUNDARY else float(-TO_BOUNDARY / shrink)


def newton(
    pieces: SmoothPieces, task: Restricted, start: Array, accuracy: float
) -> tuple[Array, Gradient]:
    """The master problem by this interior point."""
    w, mu = _solve(pieces, task, start, accuracy)
    local = pieces.at(task.information(w))
    assert local is not None  # `_solve` returns only points where it is
    return w, local.tangent(mu)


# The candidates of the pool, and the rounds in which they are priced against a master.

Method = Literal["auto", "first-order", "conic"]

# Pools up to this size go to the conic solver whole.
DIRECT = 2000
# Candidates of the first master per parameter, shared among the levels.
PER_PARAMETER = 4
# Multiplicative steps before that.
PASSES = 10
# Part of even weights in the first ones, so that none is singular.
EVEN = 0.05
# Parts of the largest weight below which weights are tried to be left out.
LEFT_OUT = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
MOST_ROUNDS = 200
# The master's gap as a part of the pool's: more would be lost on candidates that will change.
MASTER_PART = 0.1
# Of each level up to 1/ENTERING of its first candidates join per round.
ENTERING = 4
# How far each master starts from its bounds, as a part of the way to even weights.
LEAST_DEPTH, MOST_DEPTH = 1e-3, 0.1
# Weights below this part of the largest leave the support, unless their d is near the margin.
NEGLIGIBLE = 1e-4
# Information in a direction, as a part of that of the whole pool, which counts as none.
UNSEEN = 1e-6
# Smallest eigenvalue of the pool's information, scaled to unit diagonal, that counts as regular.
LEAST_EIGENVALUE = 1e-13
# Of clarabel on the scaled program, whose optimum is near 1; the second where the first fails.
TOLERANCES = (1e-10, 1e-8)


@dataclass(frozen=True)
class Relaxed:
    """Optimal weights (N,) of the relaxation, Φ = `value` there, and what is proved.

    `bound`: no plan with these candidates, shares and repetitions has a smaller Φ.  `gap` is
    1 − bound/Φ.  `tangent`: the (Φ, G) behind the bound, for sensitivities off the pool; its
    value is below Φ where the criterion has a kink.  `method`: what solved the masters.
    """

    weights: Array
    value: float
    bound: float
    gap: float
    iterations: int
    method: Literal["first-order", "conic"]
    history: tuple[RelaxationStep, ...]
    tangent: Gradient


def relax(
    problem: DesignProblem,
    *,
    method: Method = "auto",
    tolerance: float = 1e-6,
    start: Array | None = None,
    progress: Progress = lambda message: None,
) -> Relaxed:
    """Minimise Φ(prior + Σ w_i A_i) over 0 ≤ w_i ≤ most with Σ_{i∈l} w_i = shares[l].

    "first-order": a few candidates by Newton's method, all others priced by the first derivatives
    d_i, those that gain most added, until the gap is below `tolerance` (relative).  "conic": the
    same program by clarabel, at once for small pools.  "auto" is the first, with conic masters
    where the criterion has no smooth pieces: E, O3 and the mean over scenarios of a maximum.
    `start` (N,) ≥ 0: weights near the optimum, as those of a smaller pool.  The result's gap may
    exceed `tolerance` where rounding forbids more; its bound holds all the same.
    Raises InputError for a criterion without a bound (as O2 and O4, whose 1/Φ is not concave) and
    InsufficientDataError where all candidates together leave M singular.
    """
    criterion = problem.criterion
    require(
        criterion.certifiable,
        f"criterion {criterion.name} has no relaxation, since it {criterion.without_bound}; design "
        "with it by exchange alone, or take D, E or test_pose",
    )
    require(
        method in get_args(Method),
        f"method of the relaxation is {method!r}; there are {', '.join(get_args(Method))}",
    )
    require(0.0 < tolerance < 1.0, f"tolerance is {tolerance}; it must lie between 0 and 1")
    pool = CandidatePool(problem)
    _ = pool.root  # a pool that cannot see all parameters is refused here
    if len(pool.levels) == 0:
        return _only_plan(pool)
    first = _first_weights(pool, start)
    pieces = None if method == "conic" else pieces_of(criterion, len(problem.prior))
    master: Master = ConicMaster(criterion) if pieces is None else partial(newton, pieces)
    at_once = method == "conic" and problem.n_candidates <= DIRECT

    def report(step: RelaxationStep) -> None:
        progress(f"relaxation: within {step.gap:.1e} of the bound, {step.support} candidates")

    sizes = _sizes(pool, at_once)
    weights, tangent, history = optimise(pool, master, first, sizes, tolerance, report)
    last = history[-1]
    weights, value = _thinned(pool, weights, last, tolerance)
    return Relaxed(
        weights=weights,
        value=value,
        bound=last.bound,
        gap=RelaxationStep(value, last.bound, last.support).gap,
        iterations=len(history),
        method="conic" if pieces is None else "first-order",
        history=history,
        tangent=tangent,
    )


def _first_weights(pool: CandidatePool, start: Array | None) -> Array:
    """Multiplicative steps w_i ∝ w_i √d_i from even weights or `start`: where the support lies.

    Silvey, Titterington & Torsney, Commun. Stat. Theory Methods 7 (1978) 1379.
    """
    problem, even = pool.problem, pool.even()
    weights = even
    if start is not None:
        require(
            start.shape == even.shape and bool(np.all(start >= 0.0)),
            f"start of the relaxation has shape {start.shape} or negative weights; give "
            f"{even.shape} weights of 0 or more",
        )
        weights = EVEN * even + (1.0 - EVEN) * pool.scaled(start)
    # Of a maximum its mean: on a kink these steps would swing from one side to the other.
    criterion = problem.criterion.softened(1.0)
    for _ in range(PASSES):
        d = pool.sensitivity(criterion.gradient(pool.information(weights)).G)
        step = np.minimum(pool.scaled(weights * np.sqrt(d)), problem.most)
        weights = EVEN * even + (1.0 - EVEN) * step
    return weights


def _sizes(pool: CandidatePool, at_once: bool) -> IntArray:
    """Candidates of each level in the first master; more than its share takes at once."""
    if at_once:
        return np.full(len(pool.levels), pool.problem.n_candidates)
    p = pool.problem.prior.shape[-1]
    for_share = 2 * pool.problem.shares[pool.levels] // pool.problem.most
    return np.asarray(-(-PER_PARAMETER * p // len(pool.levels)) + for_share)


def _only_plan(pool: CandidatePool) -> Relaxed:
    """Where the shares take every candidate, that plan is the optimum and the bound."""
    problem = pool.problem
    tangent = problem.criterion.gradient(pool.information(pool.fixed))
    bound = tangent_bound(problem, tangent)
    step = RelaxationStep(tangent.value, bound, 0)
    return Relaxed(pool.fixed, tangent.value, bound, step.gap, 0, "first-order", (), tangent)


def _thinned(
    pool: CandidatePool, weights: Array, last: RelaxationStep, tolerance: float
) -> tuple[Array, float]:
    """Without the smallest weights of each level, as many as the gap allows."""
    support = np.flatnonzero(weights * ~(pool.fixed > 0.0))
    task = pool.restricted(support)
    for part in LEFT_OUT:
        found = weights[support]
        found = np.where(task.relative(found) > part, found, 0.0)
        fewer = pool.fixed.copy()
        fewer[support] = task.inside(found, 0.0)
        value = float(pool.problem.criterion.value(pool.information(fewer)))
        if 1.0 - last.bound / value <= max(tolerance, last.gap):
            return fewer, value
    return weights, last.value


class CandidatePool:
    """The candidates of a problem.

    `fixed` (N,): the weights of groups whose share takes every candidate, 0 for others; `levels`:
    the groups that leave a choice.
    """

    def __init__(self, problem: DesignProblem) -> None:
        self.problem = problem
        self.sensitivity, self.matrices = problem.sensitivity, problem.matrices
        size = np.bincount(problem.group, minlength=len(problem.shares))
        full = size * problem.most == problem.shares
        self.fixed = np.where(full[problem.group], float(problem.most), 0.0)
        self.levels = np.flatnonzero(~full & (problem.shares > 0))

    def even(self) -> Array:
        """w (N,): each group's share spread evenly."""
        size = np.bincount(self.problem.group, minlength=len(self.problem.shares))
        return np.asarray((self.problem.shares / np.maximum(size, 1))[self.problem.group])

    @cached_property
    def root(self) -> Array:
        """R (S, p, p) with R M Rᵀ = 1 for the information M of even weights.

        Raises InsufficientDataError where that is singular, as then it is for any weights.
        """
        M = self.information(self.even())
        for s, M_s in enumerate(M):
            diagonal = np.diag(M_s)
            scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
            smallest = float(np.linalg.eigvalsh(M_s / np.outer(scale, scale))[0])
            if not smallest > LEAST_EIGENVALUE * len(M_s):
                raise InsufficientDataError(
                    f"all {self.problem.n_candidates} candidate poses together leave some "
                    f"parameters undetermined (scenario {s + 1} of {len(M)}: smallest eigenvalue "
                    f"of the scaled information {smallest:.1e}): add prior knowledge, other poses "
                    "or loads, or fix parameters"
                )
        return np.asarray(np.linalg.inv(np.linalg.cholesky(M)))

    def scaled(self, weights: Array) -> Array:
        """w ≥ 0 (N,) with each group's sum brought to its share, 0 where a group has none."""
        problem = self.problem
        total = np.bincount(problem.group, weights, minlength=len(problem.shares))
        return weights * (problem.shares / np.where(total > 0.0, total, np.inf))[problem.group]

    def information(self, weights: Array) -> Array:
        """M (S, p, p) at weights (N,)."""
        packed = self.problem.packed
        if packed is None or np.count_nonzero(weights) * 4 < len(weights):
            return self.problem.information(weights)
        p = self.problem.blocks.shape[-1]
        rows, columns, factor = triangle(p)
        M = np.empty((len(packed), p, p))
        M[:, rows, columns] = M[:, columns, rows] = weights @ packed / factor
        return self.problem.prior + M

    def restricted(self, chosen: IntArray) -> Restricted:
        """The problem with no other candidates than `chosen`, all of them free."""
        problem = self.problem
        level = np.searchsorted(self.levels, problem.group[chosen])
        base = problem.information(self.fixed)
        shares = problem.shares[self.levels]
        return Restricted(self.matrices(chosen), base, level, shares, problem.most)

    def margins(self, chosen: IntArray, d: Array) -> tuple[Array, Array]:
        """(N,) each: the least d that a level's share takes of `chosen`, largest first, and the
        next d, which must stay for a choice to be left; inf where weights are fixed."""
        problem = self.problem
        taken, following = np.full((2, len(problem.shares)), np.inf)
        for level in self.levels:
            of_level = np.sort(d[chosen[problem.group[chosen] == level]])[::-1]
            count = -(-int(problem.shares[level]) // problem.most)
            taken[level] = of_level[count - 1]
            following[level] = of_level[min(count, len(of_level) - 1)]
        return taken[problem.group], following[problem.group]

    def best(self, score: Array, counts: IntArray) -> IntArray:
        """Of each free level as many candidates as `counts` says, those of largest score (N,);
        none of score −inf."""
        found = []
        for level, count in zip(self.levels, counts, strict=True):
            of_level = np.flatnonzero(self.problem.group == level)
            rest = max(len(of_level) - count, 0)
            found.append(of_level[np.argpartition(score[of_level], rest)[rest:]])
        best = np.concatenate(found)
        return best[score[best] > -np.inf]


@dataclass(frozen=True)
class RelaxationStep:
    """One round: Φ of the weights at hand, the best bound so far, candidates in the master."""

    value: float
    bound: float
    support: int

    @property
    def gap(self) -> float:
        """1 − bound/Φ."""
        return max(1.0 - self.bound / self.value, 0.0)


# Solves the problem on a few candidates: from a start (k,) strictly inside the bounds to w (k,)
# with a relative gap of the accuracy asked for, and a tangent that shows it.
Master = Callable[[Restricted, Array, float], tuple[Array, Gradient]]


def optimise(
    pool: CandidatePool,
    master: Master,
    start: Array,
    sizes: IntArray,
    tolerance: float,
    progress: Callable[[RelaxationStep], None],
) -> tuple[Array, Gradient, tuple[RelaxationStep, ...]]:
    """Weights (N,) with 1 − bound/Φ ≤ tolerance, the tangent of the bound, and all rounds.

    `start` (N,) names the first candidates, by weight, `sizes` of each free level.  Ends with a
    wider gap where rounding hides which candidate could still improve the plan.
    """
    problem = pool.problem
    support = pool.best(start, sizes)
    weights = best = start
    value, bound, gap, accuracy = np.inf, 0.0, 1.0, MASTER_PART
    history: list[RelaxationStep] = []
    for _ in range(MOST_ROUNDS):
        support, task = _regular(pool, support)
        inside = task.inside(weights[support], min(max(gap, LEAST_DEPTH), MOST_DEPTH))
        found, tangent = master(task, inside, accuracy)
        weights = pool.fixed.copy()
        weights[support] = found
        reached = float(problem.criterion.value(pool.information(weights)))
        if reached < value:
            best, value = weights, reached
        d = pool.sensitivity(tangent.G)
        certified = tangent_bound(problem, tangent, d)
        if not history or certified > bound:
            bound, steepest = certified, tangent
        history.append(RelaxationStep(value, bound, len(support)))
        progress(history[-1])
        gap = history[-1].gap
        margin, least = pool.margins(support, d)
        outside = np.where(d > (1.0 + 0.1 * tolerance) * margin, d, -np.inf)
        outside[support] = -np.inf
        entering = pool.best(outside, np.maximum(sizes // ENTERING, 1))
        finest = accuracy <= 0.1 * tolerance
        if gap <= tolerance or (len(entering) == 0 and finest):
            break
        accuracy = MASTER_PART * (gap if len(entering) else min(gap, accuracy))
        accuracy = max(accuracy, (0.5 if len(entering) else 0.1) * tolerance)
        kept = (task.relative(found) > NEGLIGIBLE) | (d[support] >= (1.0 - gap) * least[support])
        support = np.concatenate([support[kept], entering])
    return best, steepest, tuple(history)


def _regular(pool: CandidatePool, support: IntArray) -> tuple[IntArray, Restricted]:
    """The support with candidates added until it sees every direction that the pool sees.

    Directions that Φ does not count, such as nuisance parameters beside c, draw no weight.
    """
    while True:
        task = pool.restricted(support)
        even = task.inside(np.zeros(len(support)), 1.0)
        M = pool.root @ task.information(even) @ pool.root.transpose(0, 2, 1)
        eigenvalues, U = np.linalg.eigh(M)
        unseen = eigenvalues < UNSEEN
        if not unseen.any():
            return support, task
        rows = (U * unseen[:, None, :]).transpose(0, 2, 1) @ pool.root
        d = pool.sensitivity(rows.transpose(0, 2, 1) @ rows)
        d[support] = -np.inf
        support = np.concatenate([support, pool.best(d, np.ones_like(pool.levels))])


class ConicMaster:
    """Σ_s Φ_s/S or max_s Φ_s over the weights, solved by clarabel to its own accuracy."""

    def __init__(self, criterion: Criterion) -> None:
        self._worst = isinstance(criterion, Worst)
        base = criterion.base if isinstance(criterion, Worst) else criterion
        assert isinstance(base, ScenarioCriterion)
        self._base = base
        import cvxpy as cp

        self._cp = cp

    def __call__(self, task: Restricted, start: Array, accuracy: float) -> tuple[Array, Gradient]:
        """w (k,) and a tangent; `start` sets the units of the program and nothing else.

        Raises InsufficientDataError where clarabel finds no solution.
        """
        cp = self._cp
        M = task.information(start)
        values = self._base.each(M)
        w = cp.Variable(len(start), nonneg=True)
        members = (task.level == np.arange(len(task.shares))[:, None]).astype(float)
        constraints = [members @ w == task.shares, w <= task.most]
        cones: list[Cone] = []
        for s, root in enumerate(np.linalg.inv(np.linalg.cholesky(M))):
            A = root @ task.A[s] @ root.T
            information = cp.reshape(A.reshape(len(A), -1).T @ w, root.shape, order="C")
            information = information + root @ task.base[s] @ root.T
            cones.append(self._base.cone(cp, s, information, root, float(values[s])))
            constraints += cones[-1].constraints
        relative = [
            float(v / values.max()) * cone.value for v, cone in zip(values, cones, strict=True)
        ]
        total = cp.Variable()
        mean = sum(relative) / len(relative)
        limit = [value <= total for value in (relative if self._worst else [mean])]
        self._solve(cp.Problem(cp.Minimize(total), [*constraints, *limit]))
        if self._worst:
            share = np.maximum([float(c.dual_value) for c in limit], 0.0)
        else:
            share = np.ones(len(cones))
        found = task.inside(np.maximum(w.value, 0.0), 0.0)
        return found, self._tangent(task.information(found), cones, share / share.sum())

    def _tangent(self, M: Array, cones: list[Cone], share: Array) -> Gradient:
        """v = Σ c_s v_s and G = (c_s G_s), c = `share` (S,): Φ ≥ Σ c_s v_s²/⟨G_s, M'_s⟩ is at least
        v²/⟨G, M'⟩ by Cauchy and Schwarz."""
        values, G = self._base.each_gradient(M)
        for s, cone in enumerate(cones):
            if cone.tangent is not None:
                values[s], G[s] = cone.tangent(M[s])
        return Gradient(float(share @ values), share[:, None, None] * G)

    def _solve(self, program: Any) -> None:
        """Solved in place; an inexact answer is used, since its bound shows what it is worth."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for tolerance in TOLERANCES:
                options = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), tolerance)
                try:
                    program.solve(solver=self._cp.CLARABEL, **options)
                except self._cp.SolverError:
                    continue
                if program.status in ("optimal", "optimal_inaccurate"):
                    return
        raise InsufficientDataError(
            f"the conic solver stopped with status {program.status!r} on the relaxation; the "
            "information may be nearly singular: add prior knowledge or poses"
        )
