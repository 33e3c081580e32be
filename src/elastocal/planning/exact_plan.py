"""The best exact plan of many starts, plans of chance beside it, and how many poses are enough."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InsufficientDataError, require
from elastocal.planning.checkpoint import Stage
from elastocal.planning.criterion import Gradient
from elastocal.planning.relaxation import Relaxed, relax
from elastocal.planning.selection import (
    IMPROVEMENT,
    SOFT,
    TIE,
    DesignProblem,
    Exchanged,
    balanced,
    check_enough,
    exchange,
    fitted,
    greedy_plan,
    is_regular,
    iterated_search,
    random_plan,
    regular_plan,
)
from elastocal.units import Array, IntArray, Progress

# What chance would have given: the criterion of plans drawn from the same feasible poses.

DRAWN = 20
STREAM = 10_000  # of the seed's children, beyond those that draw candidates and begin searches


def random_information(problem: DesignProblem, seed: int, n: int = DRAWN) -> Array:
    """M (n, S, p, p) of plans drawn uniformly from the candidates of `problem`, with its shares."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAM,)))
    return np.stack([problem.prior + problem.sum_of(random_plan(problem, rng)) for _ in range(n)])


# The best exact plan found from many starts, and the fewest poses that meet a target.
#
# A relaxed optimum is rounded, or a plan built up, and improved by exchange; the result is the same
# for one seed however the work is spread or interrupted.

ProblemOf = Callable[[int], DesignProblem]
# Candidates of a group that the search looks at before all of them: so many per pose of its share,
# of many poses fewer, but no less than NEAR_AT_LEAST where the first would be more.
NEAR_PER_POSE, NEAR_PER_MANY, NEAR_AT_LEAST = 50, 12, 240
# A better plan must be better by more than rounding: relative slack of what is ruled out.
SLACK = 1e-9
# A candidate without weight counts as this share of the smallest weight of its group: it is used
# only where those with weight cannot fill the share under the cap.
FLOOR = 1e-6


@dataclass(frozen=True)
class ExactPlan(Exchanged):
    """The best of several starts: no single exchange on the whole pool lowers its Φ.

    A candidate is repeated where it is measured more than once.  The starts ended at `values`
    (starts,) after altogether `passes` passes.
    """

    values: Array


NOWHERE = Stage(None)


def exact_plan(
    problem: DesignProblem,
    *,
    relaxed_weights: Array | None = None,
    tangent: Gradient | None = None,
    warm: IntArray | None = None,
    starts: int = 10,
    seed: int = 0,
    jobs: int = 1,
    looks: int | None = None,
    found: IntArray | None = None,
    checkpoint: Stage = NOWHERE,
    progress: Progress = lambda message: None,
) -> ExactPlan:
    """The plan of least Φ found from `starts` starts: exchange and iterated local search each.

    The first start is `warm`, a plan that may have other shares, else the rounded relaxation
    (`relaxed_weights` (N,), any weights), else greedy.  It and the prices at the relaxed weights
    rule out the candidates that no better plan contains, and order the others; further starts
    (roundings drawn at random, greedy, random plans) search what remains.  Each start has its own
    generator, spawned from `seed`, and none sees another's result: the plan does not depend on
    `jobs`, the number of processes (−1: all cores; joblib must be installed), nor on whether the
    work was interrupted and taken up again from `checkpoint`.  With `looks` a search evaluates no
    more candidates in an exchange and keeps to the near ones; only the best plan is exchanged
    against all.  `found`: a plan that the first start has found already.

    Raises InputError where relaxed_weights do not match, starts < 1 or jobs = 0;
    InsufficientDataError where no plan of these shares determines all parameters.
    """
    N = problem.n_candidates
    if relaxed_weights is not None:
        shape = relaxed_weights.shape
        require(shape == (N,), f"relaxed weights have shape {shape}; the pool needs {(N,)}")
    require(starts >= 1, f"an exact plan needs at least one start, got {starts}")
    require(jobs != 0, "jobs is the number of processes, or -1 for all cores; got 0")
    check_enough(problem)
    problem, tangent = balanced(problem, tangent)
    seeds = np.random.SeedSequence(seed).spawn(starts)
    done = load_finished(checkpoint, problem, seed, starts)
    if found is not None:
        value = float(problem.criterion.value(problem.prior + problem.sum_of(found)))
        done.setdefault(0, Exchanged(found, value, 0))

    def keep(k: int, finished: Exchanged) -> None:
        done[k] = finished
        save_finished(checkpoint, done, seed)
        best = min(f.value for f in done.values())
        progress(f"exact plan: start {len(done)} of {starts}, best {best:.6g}")

    if tangent is None and relaxed_weights is not None:
        tangent = _tangent(problem, relaxed_weights)
    if 0 not in done:
        begun = None if warm is None else fitted(problem, warm)
        whole = _PrunedPool.of(problem, tangent, relaxed_weights, looks=looks)
        keep(*_start(whole, 0, seeds[0], begun))
    first = done[0]
    if tangent is None:
        tangent = _tangent(problem, np.bincount(first.chosen, minlength=N).astype(float))
    pool = _PrunedPool.of(problem, tangent, relaxed_weights, first, looks)
    later = [k for k in range(starts) if k not in done]
    for k, finished in _run(pool, later, seeds, jobs):
        keep(k, finished)
    return _best(problem, [done[k] for k in range(starts)])


def _tangent(problem: DesignProblem, weights: Array) -> Gradient | None:
    """(Φ, G) at weights (N,), softened where Φ has a kink: one of the directions that count
    alike there says little about the others.  None where M(w) is singular."""
    M = problem.information(weights)
    return problem.criterion.softened(SOFT).gradient(M) if is_regular(M) else None


@dataclass(frozen=True)
class _PrunedPool:
    """Candidates `kept` of the whole pool as a problem of their own, those `near` looked at first,
    relaxed weights and a regular plan that is `known`, all by their places in `kept`."""

    problem: DesignProblem
    kept: IntArray
    near: IntArray
    weights: Array | None
    known: IntArray | None = None
    looks: int | None = None

    @classmethod
    def of(
        cls,
        problem: DesignProblem,
        tangent: Gradient | None,
        weights: Array | None,
        first: Exchanged | None = None,
        looks: int | None = None,
    ) -> _PrunedPool:
        """All candidates, or those that may be in a better plan than `first`."""
        if tangent is None:
            everything = np.arange(problem.n_candidates)
            return cls(problem, everything, everything, weights, None, looks)
        prices = Prices.of(problem, tangent)
        kept = prices.may_better(np.inf if first is None else first.value)
        rest = restrict(problem, kept)
        near = Prices(prices.d[kept], prices.upper[kept]).near(rest)
        known = None if first is None else np.searchsorted(kept, first.chosen)
        return cls(rest, kept, near, None if weights is None else weights[kept], known, looks)


def _start(
    pool: _PrunedPool, k: int, seed: np.random.SeedSequence, begun: IntArray | None = None
) -> tuple[int, Exchanged]:
    """k and where start k ended: from `begun` or a plan of its kind, near candidates first, then
    all."""
    rng = np.random.default_rng(seed)
    problem = pool.problem
    chosen = _begin(pool, k, rng) if begun is None else begun
    chosen = _regular(pool, chosen, rng)
    kept = np.union1d(pool.near, chosen)
    nearby = replace(restrict(problem, kept), looks=pool.looks)
    found = iterated_search(nearby, np.searchsorted(kept, chosen), rng)
    if pool.looks is not None:
        return k, replace(found, chosen=pool.kept[kept[found.chosen]])
    final = exchange(problem, kept[found.chosen])
    return k, Exchanged(pool.kept[final.chosen], final.value, found.passes + final.passes)


def _begin(pool: _PrunedPool, k: int, rng: np.random.Generator) -> IntArray:
    """The plan that start k begins from."""
    problem, weights = pool.problem, pool.weights
    if weights is not None and k == 0:
        return round_weights(problem, weights)
    if k == (0 if weights is None else 1):
        return pool.near[greedy_plan(restrict(problem, pool.near))]
    if weights is not None and k % 2 == 0:
        return round_weights(problem, weights, rng)
    return pool.near[random_plan(restrict(problem, pool.near), rng)]


def _regular(pool: _PrunedPool, chosen: IntArray, rng: np.random.Generator) -> IntArray:
    """`chosen` or a plan near it that determines all parameters, of near candidates if it can."""
    kept = np.union1d(pool.near, chosen)
    nearby = restrict(pool.problem, kept)
    try:
        return kept[regular_plan(nearby, np.searchsorted(kept, chosen), rng)]
    except InsufficientDataError:
        return regular_plan(pool.problem, chosen, rng) if pool.known is None else pool.known


def _run(
    pool: _PrunedPool, which: list[int], seeds: list[np.random.SeedSequence], jobs: int
) -> Iterator[tuple[int, Exchanged]]:
    """The starts `which`, as each is finished."""
    if jobs == 1 or len(which) < 2:
        yield from (_start(pool, k, seeds[k]) for k in which)
        return
    from joblib import Parallel, delayed

    tasks = (delayed(_start)(pool, k, seeds[k]) for k in which)
    yield from Parallel(jobs, return_as="generator_unordered")(tasks)


def _best(problem: DesignProblem, done: list[Exchanged]) -> ExactPlan:
    """The best of all starts; of equal ones the first in the order of their candidates."""
    values = np.array([f.value for f in done])
    tied = [f.chosen.tolist() for f in done if f.value <= values.min() * (1 + TIE)]
    # Candidates ruled out cannot better a plan, but for what rounding leaves: looked at once more.
    final = exchange(problem, np.array(min(tied)))
    passes = sum(f.passes for f in done) + final.passes
    return ExactPlan(final.chosen, final.value, passes, values)


def repaired(problem: DesignProblem, left: IntArray) -> IntArray:
    """The plan `left`, sorted, brought to the shares of the problem, and no exchange betters it."""
    problem, _ = balanced(problem, None)
    chosen = regular_plan(problem, fitted(problem, left), np.random.default_rng(0))
    return exchange(problem, chosen).chosen


def restrict(problem: DesignProblem, kept: IntArray) -> DesignProblem:
    """The same problem with the candidates `kept` (k,), sorted, alone."""
    if len(kept) == problem.n_candidates:
        return problem
    return replace(problem, blocks=problem.blocks[:, kept], group=problem.group[kept])


@dataclass(frozen=True)
class Prices:
    """First-order prices d (N,) of the candidates, −∂Φ/∂w_i at a tangent, and what they exclude.

    1/Φ is concave and of degree 1, so that its tangent (Φ, G) lies above it: every plan has
    1/Φ(plan) ≤ (⟨G, prior⟩ + Σ_i plan_i d_i)/Φ².  `upper` (N,) is the largest right side over the
    plans that contain i; inf where Φ is not certifiable.
    """

    d: Array
    upper: Array

    @classmethod
    def of(cls, problem: DesignProblem, tangent: Gradient) -> Prices:
        """Prices by the tangent (Φ, G) of Φ, or of any information function below it."""
        d = problem.sensitivity(tangent.G)
        if not problem.criterion.certifiable:
            return cls(d, np.full(len(d), np.inf))
        best, lost = float((tangent.G * problem.prior).sum()), np.full(len(d), np.inf)
        for label in np.flatnonzero(problem.shares):
            members = np.flatnonzero(problem.group == label)
            dearest = np.sort(np.repeat(d[members], problem.most))[-problem.shares[label] :]
            best += dearest.sum()
            lost[members] = np.maximum(dearest[0] - d[members], 0.0)
        return cls(d, (best - lost) / tangent.value**2)

    def may_better(self, value: float) -> IntArray:
        """Candidates that a plan with Φ < `value` can contain; the others are ruled out.

        Harman & Pronzato (2007, Statistics & Probability Letters 77, 90–94) drop what no relaxed
        optimum contains; against a known plan such an inequality drops what no better plan does.
        """
        return np.flatnonzero(self.upper > (1 - SLACK) / value)

    def near(self, problem: DesignProblem) -> IntArray:
        """The dearest candidates of every group, as many as its share asks for.

        The K of the KL exchange (Atkinson & Donev 1989, Applied Statistics 38, 515–526).
        """
        kept = [np.empty(0, dtype=np.int64)]
        for label, share in enumerate(problem.shares):
            members = np.flatnonzero(problem.group == label)
            order = np.argsort(-self.d[members], kind="stable")
            near = min(NEAR_PER_POSE * share, max(NEAR_PER_MANY * share, NEAR_AT_LEAST))
            kept.append(members[order[:near]])
        return np.sort(np.concatenate(kept))


def efficient_rounding(weights: Array, n: int, most: int | None = None) -> IntArray:
    """Counts ν (k,) with Σ ν_i = n that lose least against positive weights w (k,), k ≤ n.

    Starts from ν_i = ⌈(n − k/2) w_i⌉; a pose too few goes where ν_i/w_i is smallest, one too many
    is taken where (ν_i − 1)/w_i is largest.  Among all roundings this has the largest
    min_i ν_i/(n w_i), which bounds the efficiency of the rounded plan for every criterion
    (Pukelsheim & Rieder 1992, Biometrika 79, 763–770).  With `most`, ν_i ≤ most ≥ n/k.
    """
    w = weights / weights.sum()
    cap = n if most is None else most
    counts = np.clip(np.ceil((n - len(w) / 2) * w), 1, cap).astype(np.int64)
    while counts.sum() < n:
        counts[np.argmin(np.where(counts < cap, counts / w, np.inf))] += 1
    while counts.sum() > n:
        counts[np.argmax(np.where(counts > 1, (counts - 1) / w, -np.inf))] -= 1
    return counts


def round_weights(
    problem: DesignProblem, weights: Array, rng: np.random.Generator | None = None
) -> IntArray:
    """A plan (n_poses,), sorted, from relaxed weights (N,): shares and cap hold exactly.

    A relaxed optimum spreads over more candidates than a share has poses, so in every group the
    largest weights are rounded efficiently and the rest dropped.  With `rng` those kept are drawn
    without replacement in proportion to their weights (the largest log w_i + Gumbel noise), for
    starts that differ.
    """
    plan = [np.empty(0, dtype=np.int64)]
    for label, share in enumerate(problem.shares):
        members = np.flatnonzero(problem.group == label)
        if share == 0:
            continue
        w = np.maximum(weights[members], 0.0)
        positive = int(np.count_nonzero(w))
        w = np.maximum(w, FLOOR * w[w > 0].min() if positive else 1.0)
        fewest = -(-int(share) // problem.most)
        kept = min(max(fewest, positive), int(share))
        score = np.log(w) if rng is None else np.log(w) + rng.gumbel(size=len(w))
        order = np.argsort(-score, kind="stable")[:kept]
        counts = efficient_rounding(w[order], int(share), problem.most)
        plan.append(np.repeat(members[order], counts))
    return np.sort(np.concatenate(plan))


def save_finished(checkpoint: Stage, done: Mapping[int, Exchanged], seed: int) -> None:
    """Keep all starts `done` so far, by their numbers."""
    fields = ("chosen", "value", "passes")
    ends = {name: np.array([getattr(f, name) for f in done.values()]) for name in fields}
    checkpoint.save({"seed": np.array(seed), "start": np.array(list(done)), **ends})


def load_finished(
    checkpoint: Stage, problem: DesignProblem, seed: int, starts: int
) -> dict[int, Exchanged]:
    """The starts that need not be made again; none where they are of another problem or seed."""
    state = checkpoint.load()
    if state is None or int(state["seed"]) != seed or not _belongs(state, problem):
        return {}
    numbered = zip(state["start"], state["chosen"], state["value"], state["passes"], strict=True)
    return {
        int(k): Exchanged(chosen, float(value), int(passes))
        for k, chosen, value, passes in numbered
        if k < starts
    }


def _belongs(state: Mapping[str, NDArray[Any]], problem: DesignProblem) -> bool:
    """Do the saved plans fit the problem, with the values saved with them?"""
    chosen = state["chosen"]
    if chosen.shape[1:] != (problem.n_poses,) or chosen.max(initial=-1) >= problem.n_candidates:
        return False
    for plan, value in zip(chosen, state["value"], strict=True):
        shares = np.bincount(problem.group[plan], minlength=len(problem.shares))
        if not np.array_equal(shares, problem.shares):
            return False
        now = problem.criterion.value(problem.prior + problem.sum_of(plan))
        if not np.isclose(now, value, rtol=1e-9, atol=0):
            return False
    return True


@dataclass(frozen=True)
class SizedPlan:
    """The best plan found of `n_poses` poses, and the relaxation that bounds every plan of so
    many; None where the criterion has none."""

    n_poses: int
    plan: ExactPlan
    relaxed: Relaxed | None

    @property
    def value(self) -> float:
        return self.plan.value

    @property
    def bound(self) -> float | None:
        return None if self.relaxed is None else self.relaxed.bound

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What `kept` makes it from again."""
        own = {"chosen": self.plan.chosen, "plan_value": np.array(self.plan.value)}
        if (r := self.relaxed) is None:
            return own
        numbers = np.array([r.value, r.bound, r.gap, r.tangent.value])
        return own | {"weights": r.weights, "relaxed": numbers, "G": r.tangent.G}

    @classmethod
    def kept(cls, state: Mapping[str, NDArray[Any]]) -> SizedPlan | None:
        """From the arrays of one, among others; None where there are none."""
        if "chosen" not in state:
            return None
        value = float(state["plan_value"])
        plan = ExactPlan(state["chosen"], value, 0, np.array([value]))
        relaxed = None
        if "weights" in state:
            at, bound, gap, tangent = (float(v) for v in state["relaxed"])
            relaxed = Relaxed(
                state["weights"], at, bound, gap, 0, "first-order", (),
                Gradient(tangent, state["G"]),
            )  # fmt: skip
        return cls(len(plan.chosen), plan, relaxed)


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
    starts: int = 10,
    seed: int = 0,
    jobs: int = 1,
    looks: int | None = None,
    progress: Progress = lambda message: None,
) -> SizeCurve:
    """The best plans found of the given `numbers` of poses, and the fewest with Φ ≤ `target`.

    `problem_of(n)` states the problem of n poses, on the same candidates for all n.  Where no
    group's share falls with n, Φ of the points does not rise: the smaller plan, extended, is one
    of the starts of the larger (O2 and O4, which more information may raise, excepted).  The
    bound falls with n too; bisection finds the first n in `between` at which it allows the target.
    From there plans are sought with doubled steps, then between the last that failed and the
    first that met it.

    Raises InputError for no number and no target, an empty range, or a target that is not
    positive; InsufficientDataError where no plan of one of `numbers` determines all parameters.
    """
    wanted = sorted(set(numbers))
    require(bool(wanted) or target is not None, "a size curve needs numbers of poses or a target")
    sizes = _Sizes(problem_of, starts, seed, jobs, looks, progress)
    for n in wanted:
        sizes.point(n)
    if target is None:
        return SizeCurve(sizes.points(), None, 0)
    low, high = between
    require(1 <= low <= high, f"no number of poses lies between {low} and {high}")
    require(target > 0, f"the target must be positive, got {target}")
    allowed = _first_with(lambda n: (sizes.bound(n) or 0.0) <= target, low, high + 1)
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
    starts: int
    seed: int
    jobs: int
    looks: int | None
    progress: Progress
    found: dict[int, SizedPlan] = field(default_factory=dict)
    relaxed: dict[int, Relaxed] = field(default_factory=dict)

    def points(self) -> tuple[SizedPlan, ...]:
        return tuple(self.found[n] for n in sorted(self.found))

    def bound(self, n: int) -> float | None:
        relaxed = self._relaxation(n, self.problem_of(n))
        return None if relaxed is None else relaxed.bound

    def point(self, n: int) -> SizedPlan:
        if n not in self.found:
            self._plan(n)
            for larger in sorted(m for m in self.found if m > n):
                # Found before a smaller one that turns out better: extend that one instead.
                smaller = self.found[max(m for m in self.found if m < larger)]
                if self.found[larger].value > smaller.value * (1 + IMPROVEMENT):
                    self._plan(larger)
        return self.found[n]

    def _plan(self, n: int) -> None:
        problem = self.problem_of(n)
        relaxed = self._relaxation(n, problem)
        smaller = [m for m in self.found if m < n]
        plan = exact_plan(
            problem,
            relaxed_weights=None if relaxed is None else relaxed.weights,
            tangent=None if relaxed is None else relaxed.tangent,
            warm=self.found[max(smaller)].plan.chosen if smaller else None,
            starts=self.starts,
            seed=self.seed,
            jobs=self.jobs,
            looks=self.looks,
        )
        self.found[n] = SizedPlan(n, plan, relaxed)
        told = "" if relaxed is None else f", bound {relaxed.bound:.6g}"
        self.progress(f"{n} poses: {plan.value:.6g}{told}")

    def _relaxation(self, n: int, problem: DesignProblem) -> Relaxed | None:
        if not problem.criterion.certifiable:
            return None
        if n not in self.relaxed:
            near = min(self.relaxed, key=lambda m: abs(m - n), default=None)
            start = None if near is None else self.relaxed[near].weights
            self.relaxed[n] = relax(problem, start=start)
        return self.relaxed[n]
