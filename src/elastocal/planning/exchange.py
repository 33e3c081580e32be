"""Exact plans by exchange, plans of chance beside them, and how many poses are enough.

All searches work on a `balanced` problem, whose ridge keeps every plan regular: a plan that leaves
a parameter open has an immense Φ and is left by the first exchange that closes it.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from elastocal.errors import InsufficientDataError
from elastocal.planning.criteria import DeterminantCriterion, inverse
from elastocal.planning.relaxation import (
    DesignProblem,
    Relaxed,
    balanced,
    best_of,
    check_enough,
    relax,
)
from elastocal.units import Array, IntArray, Progress

# Relative gain in Φ below which an exchange is not made: rounding must not decide.
LEAST = 1e-9
# Candidates evaluated at first for a place, each further batch being larger by GROWTH; and at most
# by a search that looks at the most promising alone.
FIRST, GROWTH, LOOKS = 8, 4, 64
SOFT = 30.0  # order of the power mean that stands for a maximum: smooth, and near it
DRAWN = 20  # plans of chance
STREAM = 10_000  # of the seed's children, beyond those that draw candidates


def exchange(
    problem: DesignProblem, plan: IntArray, looks: int | None = None
) -> tuple[IntArray, float]:
    """Until no candidate betters the plan (n,) in the place of any of its poses.

    1/Φ is concave: with pose i in an open place 1/Φ ≤ (1 + d_i/Φ₋)/Φ₋, Φ₋ and d those without it:
    candidates are evaluated in the order of d until the best found exceeds all that are left.
    Of a criterion without a bound all are; with `looks`, no more than so many.
    """
    plan, criterion = plan.copy(), problem.criterion
    V = inverse(problem.information(plan))
    value, (phi, C) = float(criterion.value(V)), criterion.slope(V)
    places = list(np.argsort(problem.prices(V @ C @ V)[plan], kind="stable"))
    vain = 0
    while vain < len(plan):
        k = int(places[0])
        places = [*places[1:], k]
        V = inverse(problem.information(np.delete(plan, k)))
        free = np.setdiff1d(np.flatnonzero(problem.group == problem.group[plan[k]]), plan)
        phi, C = criterion.slope(V)
        d = problem.prices(V @ C @ V)[free]
        upper = (1 + d / phi) / phi if criterion.certifiable else np.full(len(d), np.inf)
        order = np.argsort(-d, kind="stable")[:looks]
        rank, upper, size = free[order], upper[order], FIRST
        best, into = value * (1 - LEAST), None
        while len(rank) and upper[0] * best > 1:
            phis = criterion.value(with_poses(V, problem.blocks[rank[:size]]))
            j = int(phis.argmin())
            if phis[j] < best:
                best, into = float(phis[j]), int(rank[j])
            rank, upper, size = rank[size:], upper[size:], GROWTH * size
        vain += 1
        if into is None:
            continue
        new = plan.copy()
        new[k] = into
        # Formed anew: where M is nearly singular, the update may promise what rounding takes.
        found = float(criterion.value(inverse(problem.information(new))))
        if found < value * (1 - LEAST):
            plan, value, vain = new, found, 0
    return np.sort(plan), value


def with_poses(V: Array, B: Array) -> Array:
    """(M + B_iᵀB_i)⁻¹ (k, p, p) of V = M⁻¹ (p, p) and B (k, r, p) (Woodbury)."""
    BV = (B.reshape(-1, len(V)) @ V).reshape(B.shape)
    K = np.eye(B.shape[1]) + BV @ B.swapaxes(-1, -2)
    return np.asarray(V - BV.swapaxes(-1, -2) @ np.linalg.solve(K, BV))


def rounded(
    problem: DesignProblem, weights: Array, rng: np.random.Generator | None = None
) -> IntArray:
    """A plan (n,) of the largest relaxed weights (N,) of each group; with `rng` drawn in proportion
    to them (the largest log w + Gumbel noise)."""
    score = np.log(np.maximum(weights, 1e-9))
    score = score if rng is None else score + rng.gumbel(size=len(weights))
    return np.sort(best_of(score, problem.group, problem.shares))


def random_plan(problem: DesignProblem, rng: np.random.Generator) -> IntArray:
    """A plan (n,), sorted, drawn uniformly from those of the problem's shares."""
    of_group = (np.flatnonzero(problem.group == label) for label in range(len(problem.shares)))
    lots = zip(of_group, problem.shares.tolist(), strict=True)
    return np.sort(np.concatenate([rng.choice(own, share, replace=False) for own, share in lots]))


def random_information(problem: DesignProblem, seed: int, n: int = DRAWN) -> Array:
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAM,)))
    return np.stack([problem.information(random_plan(problem, rng)) for _ in range(n)])


def fitted(problem: DesignProblem, plan: IntArray) -> IntArray:
    """A plan (n,), sorted, of the problem's shares from one of others: of each group those of the
    plan first, and by price."""
    V = inverse(problem.information(plan))
    price = problem.prices(V @ problem.criterion.slope(V)[1] @ V)
    price[plan] += price.max()
    return np.sort(best_of(price, problem.group, problem.shares))


def values_without(problem: DesignProblem, chosen: IntArray) -> Array:
    """Φ (n,) of the plan `chosen` (n,) without its k-th pose; inf where nothing replaces it."""
    rest = [problem.information(np.delete(chosen, k)) for k in range(len(chosen))]
    return problem.criterion.of_information(np.stack(rest))


# The best plan of several starts.


def prospects(problem: DesignProblem, gap: float = 1e-4, start: Array | None = None) -> Relaxed:
    """The relaxation, whose weights begin plans and whose tangent prices candidates; of a criterion
    that has none that of D over all parameters, which bounds nothing."""
    if problem.criterion.certifiable:
        return relax(problem, gap, start)
    volume = DeterminantCriterion(np.eye(len(problem.prior)))
    return replace(relax(problem.judged_by(volume), max(gap, 1e-3), start), bound=0.0)


def exact_plan(
    problem: DesignProblem, relaxed: Relaxed, *, starts: int = 2, seed: int = 0,
    warm: IntArray | None = None,
) -> tuple[IntArray, float]:  # fmt: skip
    """The plan (n,) of least Φ found from `starts` starts, and Φ: `warm`, a plan that may have
    other shares, or the rounded relaxation, and roundings drawn at random.  Each is improved by
    exchange with the most promising candidates, the best at last with all."""
    rng, weights = np.random.default_rng(seed), relaxed.weights
    begins = [rounded(problem, weights) if warm is None else fitted(problem, warm)]
    begins += [rounded(problem, weights, rng) for _ in range(starts - 1)]
    plan, _ = min((_descended(problem, plan) for plan in begins), key=lambda found: found[1])
    return exchange(problem, plan)


def _descended(problem: DesignProblem, plan: IntArray) -> tuple[IntArray, float]:
    """Exchanges on the softened criterion first, where Φ has kinks: what lowers a maximum is shut
    out wherever two of its arguments are equal and each exchange raises one of them."""
    if problem.criterion.kinked:
        plan, _ = exchange(problem.judged_by(problem.criterion.softened(SOFT)), plan, LOOKS)
    return exchange(problem, plan, LOOKS)


# How many poses: a curve of sizes, and the fewest that the bound allows.


def sized_plans(
    problem_of: Callable[[int], DesignProblem], numbers: Iterable[int], seed: int,
    progress: Progress,
) -> dict[int, tuple[float, float]]:  # fmt: skip
    """Φ of the best plan found by number of poses, and the bound on all such, NaN without one; each
    begun from the next smaller one, so that Φ does not rise where no group's share falls with n."""
    found: dict[int, tuple[float, float]] = {}
    chosen, weights = None, None
    for n in sorted(numbers):
        whole = problem_of(n)
        check_enough(whole)
        problem, _ = balanced(whole)
        relaxed = prospects(problem, start=weights)
        chosen, _ = exact_plan(problem, relaxed, warm=chosen, seed=seed)
        value, weights = whole.value(chosen), relaxed.weights
        check_determined(whole, value)
        found[n] = value, relaxed.bound if problem.criterion.certifiable else np.nan
        progress(f"{n} poses: {value:.6g}")
    return found


def first_allowed(
    problem_of: Callable[[int], DesignProblem], target: float, low: int, high: int
) -> int:
    """The least n in [low, high] for which the bound, which falls with n, allows Φ ≤ `target`;
    high + 1 where there is none."""
    return low + bisect_left(
        range(low, high + 1), True,
        key=lambda n: prospects(balanced(problem_of(n))[0], 1e-3).bound <= target,
    )  # fmt: skip


def check_determined(problem: DesignProblem, value: float) -> None:
    if not np.isfinite(value):
        raise InsufficientDataError(
            f"no plan of {problem.n_poses} poses that determines all "
            f"{len(problem.prior)} parameters was found; plan more poses, other shares, or "
            "state a prior"
        )
