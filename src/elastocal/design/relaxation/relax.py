"""The relaxation: weights instead of whole poses, solved to a certified gap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from elastocal.design.certificate import tangent_bound
from elastocal.design.criteria.base import Array, Gradient
from elastocal.design.problem import DesignProblem, IntArray
from elastocal.design.relaxation.columns import Master, Step, optimise
from elastocal.design.relaxation.conic import ConicMaster
from elastocal.design.relaxation.pool import Pool
from elastocal.design.relaxation.smooth import NewtonMaster, pieces_of
from elastocal.errors import require

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
NEGLIGIBLE = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)


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
    history: tuple[Step, ...]
    tangent: Gradient


def relax(
    problem: DesignProblem,
    *,
    method: Method = "auto",
    tolerance: float = 1e-6,
    start: Array | None = None,
    progress: Callable[[str], None] | None = None,
) -> Relaxed:
    """Minimise Φ(prior + Σ w_i A_i) over 0 ≤ w_i ≤ most with Σ_{i∈l} w_i = shares[l].

    "first-order": a few candidates by Newton's method, all others priced by the first derivatives
    d_i, those that gain most added, until the gap is below `tolerance` (relative).  "conic": the
    same program by clarabel, at once for small pools.  "auto" is the first, with conic masters
    for E, O3 and the mean over scenarios of a maximum, which have no smooth pieces.
    `start` (N,) ≥ 0: weights near the optimum, as those of a smaller pool.  The result's gap may
    exceed `tolerance` where rounding forbids more; its bound holds all the same.
    Raises InputError for a criterion without a bound (O2, O4: 1/Φ is not concave) and
    InsufficientDataError where all candidates together leave M singular.
    """
    criterion = problem.criterion
    require(
        criterion.certifiable,
        f"criterion {criterion.name} has no relaxation, since 1/Φ is not concave; design with it "
        "by exchange alone, or take D, E or test_pose",
    )
    require(
        method in get_args(Method),
        f"method of the relaxation is {method!r}; there are {', '.join(get_args(Method))}",
    )
    require(0.0 < tolerance < 1.0, f"tolerance is {tolerance}; it must lie between 0 and 1")
    pool = Pool(problem)
    _ = pool.root  # a pool that cannot see all parameters is refused here
    if len(pool.levels) == 0:
        return _only_plan(pool)
    first = _first_weights(pool, start)
    pieces = None if method == "conic" else pieces_of(criterion, len(problem.prior))
    master: Master = ConicMaster(criterion) if pieces is None else NewtonMaster(pieces)
    whole = method == "conic" and problem.n_candidates <= DIRECT

    def report(step: Step) -> None:
        if progress is not None:
            progress(f"relaxation: within {step.gap:.1e} of the bound, {step.support} candidates")

    weights, tangent, history = optimise(
        pool, master, first, _sizes(pool, whole), tolerance, report
    )
    last = history[-1]
    weights, value = _cleaned(pool, weights, last, tolerance)
    return Relaxed(
        weights=weights,
        value=value,
        bound=last.bound,
        gap=Step(value, last.bound, last.support).gap,
        iterations=len(history),
        method="conic" if pieces is None else "first-order",
        history=history,
        tangent=tangent,
    )


def _first_weights(pool: Pool, start: Array | None) -> Array:
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


def _sizes(pool: Pool, whole: bool) -> IntArray:
    """Candidates of each level in the first master; more than its share takes at once."""
    if whole:
        return np.full(len(pool.levels), pool.problem.n_candidates)
    p = pool.problem.prior.shape[-1]
    for_share = 2 * pool.problem.shares[pool.levels] // pool.problem.most
    return np.asarray(-(-PER_PARAMETER * p // len(pool.levels)) + for_share)


def _only_plan(pool: Pool) -> Relaxed:
    """Where the shares take every candidate, that plan is the optimum and the bound."""
    problem = pool.problem
    tangent = problem.criterion.gradient(pool.information(pool.fixed))
    bound = tangent_bound(problem, tangent)
    step = Step(tangent.value, bound, 0)
    return Relaxed(pool.fixed, tangent.value, bound, step.gap, 0, "first-order", (), tangent)


def _cleaned(pool: Pool, weights: Array, last: Step, tolerance: float) -> tuple[Array, float]:
    """Without the smallest weights of each level, as many as the gap allows."""
    support = np.flatnonzero(weights * ~(pool.fixed > 0.0))
    task = pool.restricted(support)
    for part in NEGLIGIBLE:
        found = weights[support]
        found = np.where(task.relative(found) > part, found, 0.0)
        fewer = pool.fixed.copy()
        fewer[support] = task.inside(found, 0.0)
        value = float(pool.problem.criterion.value(pool.information(fewer)))
        if 1.0 - last.bound / value <= max(tolerance, last.gap):
            return fewer, value
    return weights, last.value
