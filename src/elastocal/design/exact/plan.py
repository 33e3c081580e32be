"""The best exact plan found from many starts, the same for one seed however the work is spread."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from elastocal.design.exact.escape import SOFT, search
from elastocal.design.exact.exchange import TIE, exchange
from elastocal.design.exact.finished import Checkpoint, Finished, load_finished, save_finished
from elastocal.design.exact.greedy import fitted, greedy_plan
from elastocal.design.exact.pool import Prices, random_plan, restrict
from elastocal.design.exact.regular import check_enough, is_regular, regular_plan
from elastocal.design.exact.rounding import round_weights
from elastocal.design.problem import Array, DesignProblem, IntArray
from elastocal.errors import InsufficientDataError, require
from elastocal.planning.criterion import Gradient

Progress = Callable[[str], None]


@dataclass(frozen=True)
class ExactPlan:
    """`chosen` (n_poses,): candidate indices, sorted, repeated where measured more than once.

    `value` is Φ; no single exchange on the whole pool lowers it.  `starts` were made, each ended
    at one of `values` (starts,) after altogether `passes` passes of exchanges.
    """

    chosen: IntArray
    value: float
    starts: int
    passes: int
    values: Array


def exact_plan(
    problem: DesignProblem,
    *,
    relaxed_weights: Array | None = None,
    tangent: Gradient | None = None,
    warm: IntArray | None = None,
    starts: int = 10,
    seed: int = 0,
    jobs: int = 1,
    checkpoint: Checkpoint | None = None,
    progress: Progress = lambda message: None,
) -> ExactPlan:
    """The plan of least Φ found from `starts` starts: exchange and iterated local search each.

    The first start is `warm`, a plan that may have other shares, else the rounded relaxation
    (`relaxed_weights` (N,), any weights), else greedy.  It and the prices at the relaxed weights
    rule out the candidates that no better plan contains, and order the others; further starts
    (roundings drawn at random, greedy, random plans) search what remains.  Each start has its own
    generator, spawned from `seed`, and none sees another's result: the plan does not depend on
    `jobs`, the number of processes (−1: all cores; joblib must be installed), nor on whether the
    work was interrupted and taken up again from `checkpoint`.

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
    seeds = np.random.SeedSequence(seed).spawn(starts)
    done = load_finished(checkpoint, problem, seed, starts)

    def keep(k: int, finished: Finished) -> None:
        done[k] = finished
        save_finished(checkpoint, done, seed)
        best = min(f.value for f in done.values())
        progress(f"exact plan: start {len(done)} of {starts}, best {best:.6g}")

    if tangent is None and relaxed_weights is not None:
        tangent = _tangent(problem, relaxed_weights)
    if 0 not in done:
        begun = None if warm is None else fitted(problem, warm)
        keep(0, _start(_Pool.of(problem, tangent, relaxed_weights), 0, seeds[0], begun))
    first = done[0]
    if tangent is None:
        tangent = _tangent(problem, np.bincount(first.chosen, minlength=N).astype(float))
    pool = _Pool.of(problem, tangent, relaxed_weights, first)
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
class _Pool:
    """Candidates `kept` of the whole pool as a problem of their own, those `near` looked at first,
    relaxed weights and a regular plan that is `known`, all by their places in `kept`."""

    problem: DesignProblem
    kept: IntArray
    near: IntArray
    weights: Array | None
    known: IntArray | None = None

    @classmethod
    def of(
        cls,
        problem: DesignProblem,
        tangent: Gradient | None,
        weights: Array | None,
        first: Finished | None = None,
    ) -> _Pool:
        """All candidates, or those that may be in a better plan than `first`."""
        if tangent is None:
            everything = np.arange(problem.n_candidates)
            return cls(problem, everything, everything, weights)
        prices = Prices.of(problem, tangent)
        kept = prices.may_better(np.inf if first is None else first.value)
        rest = restrict(problem, kept)
        near = Prices(prices.d[kept], prices.upper[kept]).near(rest)
        known = None if first is None else np.searchsorted(kept, first.chosen)
        return cls(rest, kept, near, None if weights is None else weights[kept], known)


def _start(
    pool: _Pool, k: int, seed: np.random.SeedSequence, begun: IntArray | None = None
) -> Finished:
    """Start k, all of it: from `begun` or a plan of its kind, near candidates first, then all."""
    rng = np.random.default_rng(seed)
    problem = pool.problem
    chosen = _begin(pool, k, rng) if begun is None else begun
    chosen = _regular(pool, chosen, rng)
    kept = np.union1d(pool.near, chosen)
    found = search(restrict(problem, kept), np.searchsorted(kept, chosen), rng)
    final = exchange(problem, kept[found.chosen])
    return Finished(pool.kept[final.chosen], final.value, found.passes + final.passes)


def _begin(pool: _Pool, k: int, rng: np.random.Generator) -> IntArray:
    """The plan that start k begins from."""
    problem, weights = pool.problem, pool.weights
    if weights is not None and k == 0:
        return round_weights(problem, weights)
    if k == (0 if weights is None else 1):
        return pool.near[greedy_plan(restrict(problem, pool.near))]
    if weights is not None and k % 2 == 0:
        return round_weights(problem, weights, rng)
    return pool.near[random_plan(restrict(problem, pool.near), rng)]


def _regular(pool: _Pool, chosen: IntArray, rng: np.random.Generator) -> IntArray:
    """`chosen` or a plan near it that determines all parameters, of near candidates if it can."""
    kept = np.union1d(pool.near, chosen)
    nearby = restrict(pool.problem, kept)
    try:
        return kept[regular_plan(nearby, np.searchsorted(kept, chosen), rng)]
    except InsufficientDataError:
        return regular_plan(pool.problem, chosen, rng) if pool.known is None else pool.known


def _run(
    pool: _Pool, which: list[int], seeds: list[np.random.SeedSequence], jobs: int
) -> Iterator[tuple[int, Finished]]:
    """The starts `which`, as each is finished."""
    if jobs == 1 or len(which) < 2:
        for k in which:
            yield k, _start(pool, k, seeds[k])
        return
    from joblib import Parallel, delayed

    tasks = (delayed(_numbered)(pool, k, seeds[k]) for k in which)
    yield from Parallel(jobs, return_as="generator_unordered")(tasks)


def _numbered(pool: _Pool, k: int, seed: np.random.SeedSequence) -> tuple[int, Finished]:
    return k, _start(pool, k, seed)


def _best(problem: DesignProblem, done: list[Finished]) -> ExactPlan:
    """The best of all starts; of equal ones the first in the order of their candidates."""
    values = np.array([f.value for f in done])
    tied = [f.chosen.tolist() for f in done if f.value <= values.min() * (1 + TIE)]
    # Candidates ruled out cannot better a plan, but for what rounding leaves: looked at once more.
    final = exchange(problem, np.array(min(tied)))
    passes = sum(f.passes for f in done) + final.passes
    return ExactPlan(final.chosen, final.value, len(done), passes, values)
