"""The choice of poses as a problem, its relaxation to weights, and exact plans by exchange.

A few candidates are solved for by Newton's method, all others priced against them by their
first derivatives until none of them gains (column generation).  With the tangent (Φ, G) anywhere

    Φ(w') ≥ Φ² / (⟨G, prior⟩ + max_w' Σ w'_i d_i),        d_i = ⟨G, B_iᵀB_i⟩

for all weights 0 ≤ w'_i ≤ 1 with Σ_{i∈l} w'_i = n_l, exact plans among them; the maximum is
taken greedily.  Sources: Pukelsheim, Optimal Design of Experiments (2006), ch. 5 and 7; Harman,
Filová & Richtárik, J. Am. Stat. Assoc. 115 (2020) 348.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import numpy as np

from elastocal.messages import InsufficientDataError
from elastocal.planning.criteria import (
    DeterminantCriterion,
    ScenarioCriterion,
    TangentBound,
    covariance,
    inverse,
)
from elastocal.units import Array, BoolArray, IntArray, Progress

# Of the information of even weights, added to every plan's: none is singular, and the bound holds
# all the same, since more information lowers Φ.
RIDGE = 1e-9


@dataclass(frozen=True)
class DesignProblem:
    """Choose shares[l] of the candidates of each group l, each at most once, with the least Φ(M).

    `blocks` (N, r, p): whitened, scaled B of each candidate; M(w) = prior + Σ_i w_i B_iᵀB_i with
    `prior` (p, p) from what is known and measured already.  `group` (N,) in 0 … L−1, `shares` (L,).
    `source`: the cell's file, as messages begin.
    """

    blocks: Array
    prior: Array
    group: IntArray
    shares: IntArray
    criterion: ScenarioCriterion
    source: str = ""

    @cached_property
    def products(self) -> Array:
        """B_iᵀB_i as rows (N, p²)."""
        return np.asarray(self.blocks.swapaxes(-1, -2) @ self.blocks).reshape(len(self.blocks), -1)

    def prices(self, G: Array) -> Array:
        """d_i = tr(B_i G B_iᵀ) = −∂Φ/∂w_i (N,) for G (p, p)."""
        return np.asarray(self.products @ G.ravel())

    def information(self, chosen: IntArray) -> Array:
        """M (p, p) of the candidates `chosen` (k,)."""
        B = self.blocks[chosen].reshape(-1, len(self.prior))
        return np.asarray(self.prior + B.T @ B)

    def at(self, weights: Array) -> Array:
        """M (p, p) at weights w (N,)."""
        return self.prior + (weights @ self.products).reshape(self.prior.shape)

    def even(self) -> Array:
        """w (N,): each group's share spread evenly."""
        size = np.bincount(self.group, minlength=len(self.shares))
        return np.asarray((self.shares / np.maximum(size, 1))[self.group])

    def value(self, chosen: IntArray) -> float:
        return float(self.criterion.of_information(self.information(chosen)))

    def worth(self, V: Array) -> tuple[float, Array]:
        """Φ at V (p, p), and the prices d (N,) there."""
        value, C = self.criterion.slope(V)
        return value, self.prices(V @ C @ V)

    def restricted(self, kept: IntArray) -> DesignProblem:
        return replace(self, blocks=self.blocks[kept], group=self.group[kept])

    def balancing(self) -> Array:
        """T (p, p): parameters z, y = T z, whose information at even weights is 1.  Where base,
        markers and geometry are identified together, an update of Φ by one pose would keep no
        digits otherwise."""
        B = (self.blocks * np.sqrt(self.even())[:, None, None]).reshape(-1, len(self.prior))
        M = self.prior + B.T @ B
        size = np.sqrt(np.maximum(np.diagonal(M), 0.0))
        scale = 1 / np.where(size > 0, size, 1.0)
        if not covariance(M)[1]:
            n = int(np.count_nonzero(self.shares[self.group]))
            raise InsufficientDataError(
                f"all {n} candidates of the groups with a share together do not determine the "
                f"{len(M)} parameters; allow other joint levels or more load, switch effects off, "
                "or add prior knowledge"
            )
        L: Array = np.asarray(np.linalg.cholesky(M * scale[:, None] * scale))
        return np.asarray(scale[:, None] * inverse(L).T)

    def balanced(self, T: Array | None = None) -> DesignProblem:
        """That of the parameters z, y = T z, in which the search works, with a ridge that keeps
        every plan regular."""
        T = self.balancing() if T is None else T
        prior = T.T @ self.prior @ T
        return replace(
            self,
            blocks=self.blocks @ T,
            prior=(prior + prior.T) / 2 + RIDGE * np.eye(len(T)),
            criterion=self.criterion.turned(T),
        )

    def check_enough(self) -> None:
        _, r, p = self.blocks.shape
        n = int(self.shares.sum())
        # How many combinations of parameters the prior determines.
        known = int(np.linalg.matrix_rank(self.prior, hermitian=True))
        if n * r + known < p:
            prior = f" and the prior {known}" if known else ""
            raise self._too_few(
                f"fewer equations than parameters: {n} pose{'s' * (n != 1)} of {r} readings give "
                f"{n * r}{prior}, for {p} parameters"
            )

    def check_determined(self, value: float) -> None:
        if not np.isfinite(value):
            n, p = self.shares.sum(), len(self.prior)
            raise self._too_few(f"no plan of {n} poses found determines all {p} parameters")

    def _too_few(self, told: str) -> InsufficientDataError:
        """With how many poses drawn at random determine all: readings of several markers on one
        body are fewer equations than numbers."""
        drawn = self.blocks[np.random.default_rng(0).permutation(len(self.blocks))]
        sums = enumerate(accumulate((B.T @ B for B in drawn), initial=self.prior))
        n = next((n for n, M in sums if n > self.shares.sum() and covariance(M)[1]), None)
        more = "more" if n is None else f"at least {n}"
        remedy = f"plan {more} poses, switch effects off or state a prior"
        return InsufficientDataError(f"{self.source}{told}; {remedy}")

    def random(self, rng: np.random.Generator) -> IntArray:
        """A plan (n,), sorted, drawn uniformly from those of the shares."""
        own = (np.flatnonzero(self.group == g) for g in range(len(self.shares)))
        lots = [rng.choice(o, n, replace=False) for o, n in zip(own, self.shares, strict=True)]
        return np.sort(np.concatenate(lots))

    def random_information(self, seed: int) -> Array:
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAM,)))
        return np.stack([self.information(self.random(rng)) for _ in range(DRAWN)])

    def rounded(self, weights: Array, rng: np.random.Generator | None = None) -> IntArray:
        """A plan (n,) of the largest relaxed weights (N,) of each group; with `rng` drawn in
        proportion to them (the largest log w + Gumbel noise)."""
        score = np.log(np.maximum(weights, 1e-9))
        score = score if rng is None else score + rng.gumbel(size=len(weights))
        return np.sort(best_of(score, self.group, self.shares))

    def fitted(self, plan: IntArray) -> IntArray:
        """A plan (n,), sorted, of the shares here from one of others: of each group those of the
        plan first, and by price."""
        _, price = self.worth(inverse(self.information(plan)))
        price[plan] += price.max()
        return np.sort(best_of(price, self.group, self.shares))


def tangent_bound(problem: DesignProblem, tangent: TangentBound) -> float:
    """By max Σ w_i d_i over 0 ≤ w_i ≤ 1 with Σ_{i∈l} w_i = shares[l], d (N,) the prices."""
    shares, d = problem.shares, problem.prices(tangent.G)
    best = (np.sort(d[problem.group == g])[-shares[g] :].sum() for g in np.flatnonzero(shares))
    return tangent.bound(problem.prior, float(sum(best)))


GAP = 1e-4  # 1 − bound/Φ at which the relaxation ends
EVEN = 0.05  # part of even weights in those that show where the support lies
PER_PARAMETER = 4  # candidates of the first support per parameter, shared among the groups
MOST_ROUNDS = 60
# Of a round's gap that the master may leave: more would be lost on candidates that will change.
MASTER = 0.1
NEGLIGIBLE = 1e-3  # of the largest weight, below which a candidate leaves the support


@dataclass(frozen=True)
class Relaxed:
    """Optimal weights (N,) of the relaxation, Φ = `value` there, and the `bound` below which no
    plan with these candidates and shares has a Φ, by the `tangent`."""

    weights: Array
    value: float
    bound: float
    tangent: TangentBound

    @property
    def gap(self) -> float:
        return max(1 - self.bound / self.value, 0.0)


def relax(problem: DesignProblem, gap: float = GAP, start: Array | None = None) -> Relaxed:
    """Minimise Φ(prior + Σ w_i A_i) over 0 ≤ w_i ≤ 1 with Σ_{i∈l} w_i = shares[l], of a `balanced`
    problem.  `start` (N,) ≥ 0: weights near the optimum, as those of a smaller pool.  Where
    rounding forbids the `gap` that is asked for, the bound holds all the same.  Of a criterion that
    is not certifiable it is that of D over all parameters, which bounds nothing."""
    if not problem.criterion.certifiable:
        volume = replace(problem, criterion=DeterminantCriterion(np.eye(len(problem.prior))))
        return replace(relax(volume, max(gap, 1e-3), start), bound=0.0)
    size = np.bincount(problem.group, minlength=len(problem.shares))
    full = (size == problem.shares)[problem.group]
    if full.any():
        return _around(problem, full, gap, start)
    # Even weights, or `start` with a part of them, times √d_i: where the support lies (Silvey,
    # Titterington & Torsney, Commun. Stat. Theory Methods 7 (1978) 1379).
    weights, rounds = problem.even(), list[Relaxed]()
    weights = weights if start is None else EVEN * weights + (1 - EVEN) * start
    V = inverse(problem.at(weights))
    _, C = problem.criterion.softened(1.0).slope(V)  # of a kink all sides count
    weights = weights * np.sqrt(np.maximum(problem.prices(V @ C @ V), 0.0))
    least = problem.shares + 2  # of a group: as its share takes, and a choice
    sizes = np.where(
        problem.shares > 0,
        -(-PER_PARAMETER * len(problem.prior) // np.count_nonzero(problem.shares)) + 2 * least,
        0,
    )
    support = best_of(weights, problem.group, sizes)
    w, accuracy = weights[support], 0.05
    for _ in range(MOST_ROUNDS):
        w, tangent, value = newton(problem.restricted(support), w, accuracy)
        d = problem.prices(tangent.G)
        bound = tangent_bound(problem, tangent)
        weights = np.zeros(len(d))
        weights[support] = w
        rounds.append(Relaxed(weights, value, bound, tangent))
        tightest = max(rounds, key=lambda found: found.bound)
        best = min(rounds, key=lambda found: found.value)
        best = replace(best, bound=tightest.bound, tangent=tightest.tangent)
        if best.gap <= gap:
            break
        accuracy = min(accuracy, max(MASTER * best.gap, 0.3 * gap))
        keep = w > NEGLIGIBLE * w.max()
        keep |= np.isin(np.arange(len(w)), best_of(d[support], problem.group[support], least))
        support, w = support[keep], w[keep]
        d[support] = -np.inf
        new = best_of(d, problem.group, np.maximum(sizes // 4, np.minimum(sizes, 1)))
        new = new[np.isfinite(d[new])]
        support, w = np.append(support, new), np.append(w, np.full(len(new), NEGLIGIBLE))
    return best


def _around(problem: DesignProblem, full: BoolArray, gap: float, start: Array | None) -> Relaxed:
    """Where shares take every candidate of a group, these count as known."""
    fixed, free = np.flatnonzero(full), np.flatnonzero(~full)
    weights, shares = full.astype(float), problem.shares.copy()
    prior = problem.information(fixed)
    shares[np.unique(problem.group[fixed])] = 0
    if not shares.any():
        tangent = problem.criterion.tangent_at(inverse(prior))
        return Relaxed(weights, tangent.value, tangent_bound(problem, tangent), tangent)
    rest = replace(problem.restricted(free), prior=prior, shares=shares)
    found = relax(rest, gap, None if start is None else start[free])
    weights[free] = found.weights
    return replace(found, weights=weights)


def best_of(score: Array, group: IntArray, counts: IntArray) -> IntArray:
    found = [np.zeros(0, dtype=np.int64)]
    for g in np.flatnonzero(counts):
        own = np.flatnonzero(group == g)
        found.append(own[np.argsort(-score[own], kind="stable")[: counts[g]]])
    return np.concatenate(found)


# Newton's method for a few hundred candidates, by a primal barrier:
#
#     minimise log Φ(M(w)) − s Σ_i [log w_i + log(1 − w_i)],   E w = n,   s → 0
#
# log Φ is convex since 1/Φ is concave; E (L, k) sums the weights of each group.  Kinks are softened
# by a power mean whose order grows as s falls, so that what it hides is as small as the barrier's.
# Boyd & Vandenberghe, Convex Optimization (2004), ch. 11.

MOST_STEPS = 80
TO_BOUNDARY = 0.99
REDUCTION = 0.1  # of s, once the decrement of Newton's step is below CENTRED · s · (constraints)
# A power mean's slopes, which weigh the pieces of a kink, settle later than its value.
CENTRED, SETTLED = 0.3, 3e-4
SHARPEST = 1e6  # order of a power mean beyond which rounding takes it for the maximum


def newton(problem: DesignProblem, w: Array, accuracy: float) -> tuple[Array, TangentBound, float]:
    """Weights (k,) with log Φ within `accuracy` of the least, tangent, and Φ."""
    k = len(w)
    E = (problem.group == np.flatnonzero(problem.shares)[:, None]).astype(float)
    w, s, best = _inside(w, E, problem.shares[problem.shares > 0].astype(float)), None, None
    criterion = problem.criterion.softened(4.0)
    centred = SETTLED if problem.criterion.kinked else CENTRED

    def at(w: Array) -> tuple[Array, float, Array]:
        V = inverse(problem.at(w))
        return V, *criterion.slope(V)

    def merit(phi: float, w: Array, s: float) -> float:
        return float(np.log(phi) - s * (np.log(w).sum() + np.log(1 - w).sum()))

    here = at(w)
    for _ in range(MOST_STEPS):
        V, phi, _ = here
        tangent, value = criterion.tangent_at(V), float(problem.criterion.value(V))
        gap = float(np.log(value / tangent_bound(problem, tangent)))
        if best is None or gap < best[0]:
            best = gap, w, tangent, value
        if gap <= accuracy or (s is not None and s * 2 * k < 1e-2 * accuracy):
            break
        if s is None:
            s = min(gap / (2 * k), 1.0)
            criterion = problem.criterion.softened(min(2 / gap + 4, SHARPEST))
            here = V, *criterion.slope(V)
        step, slope = _step(problem, criterion, here, w, s, E)
        low, high = float(np.min(step / w)), float(np.max(step / (1 - w)))
        t = min(1.0, TO_BOUNDARY / max(-low, 1e-9), TO_BOUNDARY / max(high, 1e-9))
        now, moved = merit(phi, w, s), None
        while t > 1e-8:
            there = at(w + t * step)
            if 0 < there[1] < np.inf and merit(there[1], w + t * step, s) <= now + 1e-4 * t * slope:
                moved = there
                break
            t /= 2
        if moved is not None:
            w, here = w + t * step, moved
        if moved is None or -slope < centred * s * 2 * k:
            s *= REDUCTION
            criterion = problem.criterion.softened(min(1 / (k * s) + 4, SHARPEST))
            here = here[0], *criterion.slope(here[0])
    assert best is not None
    return best[1], best[2], best[3]


def _step(
    problem: DesignProblem, criterion: ScenarioCriterion, here: tuple[Array, float, Array],
    w: Array, s: float, E: Array,
) -> tuple[Array, float]:  # fmt: skip
    (V, phi, C), k = here, len(w)
    A = problem.products.reshape(k, *V.shape)
    G, AV = V @ C @ V, A @ V
    d = problem.prices(G) / phi
    AG = (A @ G).swapaxes(1, 2).reshape(k, -1)
    H = 2 / phi * AV.reshape(k, -1) @ AG.T - np.outer(d, d)
    bent = criterion.curvature(V, V @ AV)
    H = H + bent / phi if np.ndim(bent) else H
    H[np.diag_indices(k)] += s / w**2 + s / (1 - w) ** 2 + 1e-12 * np.trace(H) / k
    g = -d - s / w + s / (1 - w)
    solved = np.linalg.solve((H + H.T) / 2, np.column_stack([g, E.T]))
    step = solved[:, 1:] @ np.linalg.solve(E @ solved[:, 1:], E @ solved[:, 0]) - solved[:, 0]
    return step, float(g @ step)


def _inside(w: Array, E: Array, share: Array) -> Array:
    """w (k,) moved strictly inside its bounds, with the right sums per group."""
    room = (share / E.sum(axis=1)) @ E  # even weights, which are inside
    w = np.clip(w, 0.0, 1.0)
    for _ in range(20):
        w = np.minimum(w * ((share / np.maximum(E @ w, 1e-300)) @ E), 1.0)
    w = 0.98 * w + 0.02 * room
    missing = share - E @ w
    return np.asarray(w + ((missing / (E @ (w * (1 - w)))) @ E) * w * (1 - w))


# Exact plans by exchange, and how many poses are enough; all on a `balanced` problem.

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
    """Until no candidate betters the plan (n,) in the place of any of its poses.  1/Φ is concave:
    with pose i in an open place 1/Φ ≤ (1 + d_i/Φ₋)/Φ₋, Φ₋ and d those without it: candidates are
    evaluated in the order of d until the best found exceeds all that are left.  Of a criterion
    without a bound all are; with `looks`, no more than so many."""
    plan, criterion = plan.copy(), problem.criterion
    value, d = problem.worth(inverse(problem.information(plan)))
    places = list(np.argsort(d[plan], kind="stable"))
    vain = 0
    while vain < len(plan):
        k = int(places[0])
        places = [*places[1:], k]
        V = inverse(problem.information(np.delete(plan, k)))
        free = np.setdiff1d(np.flatnonzero(problem.group == problem.group[plan[k]]), plan)
        phi, d = problem.worth(V)
        d = d[free]
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


def exact_plan(
    problem: DesignProblem, relaxed: Relaxed, *, starts: int = 2, seed: int = 0,
    warm: IntArray | None = None,
) -> tuple[IntArray, float]:  # fmt: skip
    rng, weights = np.random.default_rng(seed), relaxed.weights
    begins = [problem.rounded(weights) if warm is None else problem.fitted(warm)]
    begins += [problem.rounded(weights, rng) for _ in range(starts - 1)]
    plan, _ = min((_descended(problem, plan) for plan in begins), key=lambda found: found[1])
    return exchange(problem, plan)


def _descended(problem: DesignProblem, plan: IntArray) -> tuple[IntArray, float]:
    """Exchanges on the softened criterion first, where Φ has kinks: what lowers a maximum is shut
    out wherever two of its arguments are equal and each exchange raises one of them."""
    if problem.criterion.kinked:
        soft = replace(problem, criterion=problem.criterion.softened(SOFT))
        plan, _ = exchange(soft, plan, LOOKS)
    return exchange(problem, plan, LOOKS)


def sized_plans(
    problem_of: Callable[[int], DesignProblem], numbers: Iterable[int], seed: int,
    progress: Progress,
) -> dict[int, tuple[float, float]]:  # fmt: skip
    found: dict[int, tuple[float, float]] = {}
    chosen, weights = None, None
    for n in sorted(numbers):
        whole = problem_of(n)
        whole.check_enough()
        problem = whole.balanced()
        relaxed = relax(problem, start=weights)
        chosen, _ = exact_plan(problem, relaxed, warm=chosen, seed=seed)
        value, weights = whole.value(chosen), relaxed.weights
        whole.check_determined(value)
        found[n] = value, relaxed.bound if problem.criterion.certifiable else np.nan
        progress(f"{n} poses: {problem.criterion.told(value)}")
    return found
