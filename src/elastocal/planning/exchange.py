"""Exact plans by exchange, plans of chance beside them, and how many poses are enough.

All searches work on a `balanced` problem, whose ridge keeps every plan regular: a plan that leaves
a parameter open has an immense Φ and is left by the first exchange that closes it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from elastocal.errors import InsufficientDataError, require
from elastocal.planning.criteria import DeterminantCriterion
from elastocal.planning.criterion import Objective, TangentBound, inverse
from elastocal.planning.relaxation import (
    DesignProblem,
    Relaxed,
    balanced,
    best_of,
    check_enough,
    relax,
)
from elastocal.units import Array, BoolArray, IntArray, Progress

# Relative gain in Φ below which an exchange is not made: rounding must not decide.
LEAST = 1e-9
# Candidates evaluated at first for a place, each further batch being larger by GROWTH; and at most
# by a search that looks at the most promising alone.
FIRST, GROWTH, LOOKS = 8, 4, 64
# Poses that a change of an exchange optimum moves at most, and changes in vain that end a search.
MOVED, PATIENCE = 8, 6
# Candidates of a group near in price, to which the search keeps before it looks at all of them: so
# many per pose of its share, of many poses fewer.
NEAR_PER_POSE, NEAR_PER_MANY, NEAR_AT_LEAST = 50, 12, 240
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
    count = np.bincount(plan, minlength=problem.n_candidates)
    V = inverse(problem.information(plan))
    value, (phi, C) = float(criterion.of(V)), criterion.slope(V)
    places = list(np.argsort(problem.prices(V @ C @ V)[plan], kind="stable"))
    vain = 0
    while vain < len(plan):
        k = int(places[0])
        places = [*places[1:], k]
        V = inverse(problem.information(np.delete(plan, k)))
        free = np.flatnonzero((problem.group == problem.group[plan[k]]) & (count < problem.most))
        phi, C = criterion.slope(V)
        d = problem.prices(V @ C @ V)[free]
        upper = (1 + d / phi) / phi if criterion.certifiable else np.full(len(d), np.inf)
        order = np.argsort(-d, kind="stable")[:looks]
        rank, upper, size = free[order], upper[order], FIRST
        best, into = value * (1 - LEAST), None
        while len(rank) and upper[0] * best > 1:
            phis = criterion.of(with_poses(V, problem.blocks[:, rank[:size]]))
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
        found = float(criterion.of(inverse(problem.information(new))))
        if found < value * (1 - LEAST):
            count[plan[k]] -= 1
            count[into] += 1
            plan, value, vain = new, found, 0
    return np.sort(plan), value


def with_poses(V: Array, B: Array) -> Array:
    """(M_s + B_siᵀB_si)⁻¹ (k, S, p, p) of V = M⁻¹ (S, p, p) and B (S, k, r, p) (Woodbury)."""
    S, k, r, p = B.shape
    BV = (B.reshape(S, k * r, p) @ V).reshape(B.shape)
    K = np.eye(r) + BV @ B.swapaxes(-1, -2)
    return np.asarray((V[:, None] - BV.swapaxes(-1, -2) @ np.linalg.solve(K, BV)).swapaxes(0, 1))


def rounded(
    problem: DesignProblem, weights: Array, rng: np.random.Generator | None = None
) -> IntArray:
    """A plan (n,) of the largest relaxed weights (N,) of each group, each as often as it weighs;
    with `rng` drawn in proportion to them (the largest log w + Gumbel noise)."""
    whole = np.minimum(np.floor(weights), problem.most).astype(np.int64)
    if problem.most == 1:
        whole[:] = 0
    left = problem.shares - np.bincount(problem.group, whole, minlength=len(problem.shares)).astype(
        np.int64
    )
    score = np.log(np.maximum(weights - whole, 1e-9))
    score = score if rng is None else score + rng.gumbel(size=len(weights))
    plan = [np.repeat(np.arange(len(weights)), whole)]
    while left.any():
        more = best_of(np.where(whole < problem.most, score, -np.inf), problem.group, left)
        whole[more] += 1
        plan.append(more)
        left = left - np.bincount(problem.group[more], minlength=len(left))
    return np.sort(np.concatenate(plan))


def random_plan(problem: DesignProblem, rng: np.random.Generator) -> IntArray:
    """A plan (n,), sorted, drawn uniformly from the places that shares and repetitions leave."""
    plan = [np.empty(0, dtype=np.int64)]
    for label, share in enumerate(problem.shares):
        places = np.repeat(np.flatnonzero(problem.group == label), problem.most)
        plan.append(rng.choice(places, int(share), replace=False))
    return np.sort(np.concatenate(plan))


def random_information(problem: DesignProblem, seed: int, n: int = DRAWN) -> Array:
    """M (n, S, p, p) of plans drawn uniformly from the candidates of `problem`, with its shares."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAM,)))
    return np.stack([problem.information(random_plan(problem, rng)) for _ in range(n)])


def fitted(problem: DesignProblem, plan: IntArray) -> IntArray:
    """A plan (n,), sorted, of the problem's shares from one of others.

    Where a group holds more than its share, the poses that Φ misses least go; then the best are
    added.  Where no share is smaller than before the result is therefore never worse.
    """
    plan, L = np.sort(plan), len(problem.shares)
    while True:
        surplus = np.bincount(problem.group[plan], minlength=L) > problem.shares
        out = np.flatnonzero(surplus[problem.group[plan]])
        if not len(out):
            break
        plan = np.delete(plan, out[np.argmin(values_without(problem, plan)[out])])
    while len(plan) < problem.n_poses:
        taken = np.bincount(problem.group[plan], minlength=L)
        used = np.bincount(plan, minlength=problem.n_candidates)
        free = np.flatnonzero((problem.shares > taken)[problem.group] & (used < problem.most))
        V = inverse(problem.information(plan))
        _, C = problem.criterion.slope(V)
        near = free[np.argsort(-problem.prices(V @ C @ V)[free], kind="stable")[:LOOKS]]
        phis = problem.criterion.of(with_poses(V, problem.blocks[:, near]))
        plan = np.sort(np.append(plan, near[phis.argmin()]))
    return plan


def information_without(problem: DesignProblem, chosen: IntArray) -> Array:
    """M (n, S, p, p) of the plan `chosen` (n,) without its k-th pose, for every k.

    Sums of what comes before and after k: no subtraction, so that a pose that alone determines a
    parameter leaves an exactly singular M.
    """
    each = problem.matrices(chosen).swapaxes(0, 1)
    before, after = np.zeros_like(each), np.zeros_like(each)
    before[1:] = np.cumsum(each[:-1], axis=0)
    after[:-1] = np.cumsum(each[:0:-1], axis=0)[::-1]
    return np.asarray(problem.prior + before + after)


def values_without(problem: DesignProblem, chosen: IntArray) -> Array:
    """Φ (n,) of the plan `chosen` (n,) without its k-th pose; inf where nothing replaces it."""
    return problem.criterion.value(information_without(problem, chosen))


# The best plan of several starts.


def prospects(problem: DesignProblem, gap: float = 1e-4, start: Array | None = None) -> Relaxed:
    """The relaxation, whose weights begin plans and whose tangent prices candidates; of a criterion
    that has none that of D over all parameters, which bounds nothing."""
    if problem.criterion.certifiable:
        return relax(problem, gap, start)
    p = problem.prior.shape[-1]
    volume = Objective((DeterminantCriterion(np.eye(p)),) * len(problem.prior))
    found = relax(replace(problem, criterion=volume), max(gap, 1e-3), start)
    return replace(found, bound=0.0)


def excluded(problem: DesignProblem, tangent: TangentBound, d: Array, value: float) -> BoolArray:
    """(N,): no plan with Φ < `value` contains the candidate: the tangent with each group's least
    price displaced by its own.

    Harman & Pronzato (2007, Statistics & Probability Letters 77, 90–94) drop what no relaxed
    optimum contains; against a known plan such an inequality drops what no better plan does.
    """
    reach, lost = float((tangent.G * problem.prior).sum()), np.full(len(d), np.inf)
    for label in np.flatnonzero(problem.shares):
        own = np.flatnonzero(problem.group == label)
        top = np.sort(np.repeat(d[own], problem.most))[-problem.shares[label] :]
        reach += float(top.sum())
        lost[own] = np.maximum(top[0] - d[own], 0.0)
    return (reach - lost) / tangent.value**2 <= (1 - LEAST) / value


def exact_plan(
    problem: DesignProblem,
    relaxed: Relaxed,
    *,
    starts: int = 1,
    seed: int = 0,
    warm: IntArray | None = None,
    patience: int = PATIENCE,
) -> tuple[IntArray, float]:
    """The plan (n,) of least Φ found from `starts` starts, and Φ, of a `balanced` problem.

    The first start is `warm`, a plan that may have other shares, or the rounded relaxation; others
    are roundings drawn at random.  Each is improved by exchange and by iterated local search
    (Lourenço, Martin & Stützle 2003) among the candidates near in price; the best at last by
    exchange against all that a better plan may contain.
    """
    rng, d = np.random.default_rng(seed), problem.prices(relaxed.tangent.G)
    shares = problem.shares
    sizes = np.minimum(NEAR_PER_POSE * shares, np.maximum(NEAR_PER_MANY * shares, NEAR_AT_LEAST))
    near = best_of(d, problem.group, sizes)
    first = None if warm is None else fitted(problem, warm)
    near = np.unique(np.append(near, rounded(problem, relaxed.weights)))
    near = near if first is None else np.union1d(near, first)
    some, weights = problem.restricted(near), relaxed.weights[near]
    best, least = None, np.inf
    for k in range(starts):
        begun = rounded(some, weights, rng if k else None)
        if not k and first is not None:
            begun = np.searchsorted(near, first)
        plan, value = _searched(some, begun, rng, patience)
        if best is None or value < least:
            best, least = near[plan], value
    assert best is not None
    left = np.arange(problem.n_candidates)
    if problem.criterion.certifiable:
        left = np.union1d(np.flatnonzero(~excluded(problem, relaxed.tangent, d, least)), best)
    plan, value = exchange(problem.restricted(left), np.searchsorted(left, best))
    return left[plan], value


def _searched(
    problem: DesignProblem, plan: IntArray, rng: np.random.Generator, patience: int
) -> tuple[IntArray, float]:
    """The best plan so far is changed in two to MOVED poses and exchanged anew, until `patience`
    changes in a row led to nothing better."""
    plan, value = _descended(problem, plan)
    failed = 0
    while failed < patience:
        found, phi = _descended(problem, _changed(problem, plan, rng))
        failed += 1
        if phi < value * (1 - LEAST):
            plan, value, failed = found, phi, 0
    return plan, value


def _descended(problem: DesignProblem, plan: IntArray) -> tuple[IntArray, float]:
    """Exchanges on the softened criterion first, where Φ has kinks: what lowers a maximum is shut
    out wherever two of its arguments are equal and each exchange raises one of them."""
    if problem.criterion.kinked:
        smooth = _with(problem, problem.criterion.softened(SOFT))
        plan, _ = exchange(smooth, plan, LOOKS)
    looks = LOOKS if problem.criterion.certifiable else None
    return exchange(problem, plan, looks)


def _with(problem: DesignProblem, criterion: Objective) -> DesignProblem:
    other = replace(problem, criterion=criterion)
    other.__dict__["packed"] = problem.packed
    return other


def _changed(problem: DesignProblem, plan: IntArray, rng: np.random.Generator) -> IntArray:
    """The plan with some of its poses replaced by random ones of their groups."""
    new, n = plan.copy(), len(plan)
    for j in rng.choice(n, min(int(rng.integers(2, MOVED + 1)), n), replace=False):
        used = np.bincount(np.delete(new, j), minlength=problem.n_candidates)
        own = np.flatnonzero((problem.group == problem.group[new[j]]) & (used < problem.most))
        new[j] = rng.choice(own)
    return np.sort(new)


# How many poses: a curve of sizes, and the fewest that meet a target.

ProblemOf = Callable[[int], DesignProblem]


@dataclass(frozen=True)
class SizedPlan:
    """The best plan found of as many poses as `chosen` has, its Φ, and the bound on all such; None
    where the criterion has none."""

    chosen: IntArray
    value: float
    bound: float | None

    @property
    def n_poses(self) -> int:
        return len(self.chosen)


@dataclass(frozen=True)
class SizeCurve:
    """All sizes tried, ascending.

    `smallest`: the fewest poses with a plan found that meets the target, None if none does or no
    target was given.  `excluded`: the certified bound excludes the target for every plan of so
    many poses or fewer; with `smallest` − 1 = `excluded` the answer is proved on the pool.
    """

    points: tuple[SizedPlan, ...]
    smallest: int | None
    excluded: int


def size_curve(
    problem_of: ProblemOf,
    numbers: Iterable[int],
    target: float | None = None,
    *,
    between: tuple[int, int] = (1, 100),
    seed: int = 0,
    progress: Progress = lambda message: None,
) -> SizeCurve:
    """The best plans found of the given `numbers` of poses, and the fewest with Φ ≤ `target`.

    `problem_of(n)` states the problem of n poses, on the same candidates for all n.  The smaller
    plan, extended, begins the larger one, so that where no group's share falls with n, Φ of the
    points does not rise (O2 and O4, which more information may raise, excepted).  The bound falls
    with n too; bisection finds the first n in `between` at which it allows the target.  From there
    plans are sought with doubled steps, then between the last that failed and the first that met
    it.

    Raises InputError for no number and no target, an empty range, or a target that is not
    positive; InsufficientDataError where no plan of one of `numbers` determines all parameters.
    """
    wanted = sorted(set(numbers))
    require(bool(wanted) or target is not None, "a size curve needs numbers of poses or a target")
    sizes = _Sizes(problem_of, seed, progress)
    for n in wanted:
        sizes.point(n)
    if target is None:
        return SizeCurve(sizes.points(), None, 0)
    low, high = between
    require(1 <= low <= high, f"no number of poses lies between {low} and {high}")
    require(target > 0, f"the target must be positive, got {target}")
    allowed = _first_with(lambda n: sizes.bound(n) <= target, low, high + 1)
    _seek(sizes, target, allowed, high)
    points = sizes.points()
    smallest = min((p.n_poses for p in points if p.value <= target), default=None)
    return SizeCurve(points, smallest, allowed - 1)


def _seek(sizes: _Sizes, target: float, low: int, high: int) -> None:
    """Plans until the fewest poses that meet the target, or `high`, are among them."""

    def meets(n: int) -> bool:
        try:
            return sizes.point(n).value <= target
        except InsufficientDataError:
            if n == high:
                raise
            return False

    n, step, failed = min(low, high), 1, low - 1
    while not meets(n):
        if n == high:
            return
        failed, n, step = n, min(n + step, high), 2 * step
    _first_with(meets, failed + 1, n)


def _first_with(holds: Callable[[int], bool], low: int, high: int) -> int:
    """The smallest n in [low, high] where a monotone condition holds, taken to hold at high."""
    while low < high:
        middle = (low + high) // 2
        if holds(middle):
            high = middle
        else:
            low = middle + 1
    return low


@dataclass(frozen=True)
class _Sizes:
    """Plans and relaxations by number of poses, each begun from the next smaller one."""

    problem_of: ProblemOf
    seed: int
    progress: Progress
    found: dict[int, SizedPlan] = field(default_factory=dict)
    relaxed: dict[int, Relaxed] = field(default_factory=dict)

    def points(self) -> tuple[SizedPlan, ...]:
        return tuple(self.found[n] for n in sorted(self.found))

    def bound(self, n: int) -> float:
        """0 where there is none: it allows everything."""
        problem = self.problem_of(n)
        return self._relaxation(n, balanced(problem)[0]).bound

    def point(self, n: int) -> SizedPlan:
        if n not in self.found:
            self._plan(n)
            for larger in sorted(m for m in self.found if m > n):
                # Found before a smaller one that turns out better: extend that one instead.
                smaller = self.found[max(m for m in self.found if m < larger)]
                if self.found[larger].value > smaller.value * (1 + LEAST):
                    self._plan(larger)
        return self.found[n]

    def _plan(self, n: int) -> None:
        whole = self.problem_of(n)
        check_enough(whole)
        problem, _ = balanced(whole)
        relaxed = self._relaxation(n, problem)
        smaller = [m for m in self.found if m < n]
        warm = self.found[max(smaller)].chosen if smaller else None
        chosen, _ = exact_plan(problem, relaxed, warm=warm, seed=self.seed)
        value = whole.value(chosen)
        check_determined(whole, value)
        bound = relaxed.bound if problem.criterion.certifiable else None
        self.found[n] = SizedPlan(chosen, value, bound)
        told = "" if bound is None else f", bound {bound:.6g}"
        self.progress(f"{n} poses: {value:.6g}{told}")

    def _relaxation(self, n: int, problem: DesignProblem) -> Relaxed:
        if n not in self.relaxed:
            near = min(self.relaxed, key=lambda m: abs(m - n), default=None)
            start = None if near is None else self.relaxed[near].weights
            self.relaxed[n] = prospects(problem, start=start)
        return self.relaxed[n]


def check_determined(problem: DesignProblem, value: float) -> None:
    """Raise InsufficientDataError where the best plan found leaves parameters open."""
    if not np.isfinite(value):
        raise InsufficientDataError(
            f"no plan of {problem.n_poses} poses that determines all "
            f"{problem.prior.shape[-1]} parameters was found; plan more poses, other shares, or "
            "state a prior"
        )
