"""Readings that the others contradict: each judged as if left out of the fit to the majority.

And fits that they bend little, by Huber's loss.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, sparse, special

from elastocal.identification.least_squares import (
    ALONE,
    Covariance,
    clustered,
    f_test,
    held_out_residual,
    orthogonal,
    share_left,
)
from elastocal.identification.noise_choice import NoiseFit, estimate_noise, own_noise, weights_of
from elastocal.identification.noise_structure import Readings
from elastocal.identification.solve import MANY, PLACED, SAMPLE, MethodResult, Solution, is_placed
from elastocal.identification.start import Options
from elastocal.identification.weighted_problem import Problem, RFactor
from elastocal.messages import ElastocalError, InputError, InsufficientDataError
from elastocal.model.observations import Observations
from elastocal.units import Array, BoolArray, IntArray

FALSE_ALARM = 0.01  # chance that a clean table yields any faulty reading at all
TINY = np.finfo(float).tiny


def median_scale(length: Array, size: int) -> float:
    """σ = med|e_i| / median of χ(size): the MAD about zero for size 1; breakdown 50 %."""
    return float(np.median(length) / np.sqrt(special.chdtri(size, 0.5)))


# The majority: least trimmed squares, the sum of the smaller half of the squared lengths (FAST-LTS,
# Rousseeuw and Van Driessen 2006).
#
# Refits to the half that lies nearest from many starts, all observations and sets of a few, the
# best of them run to the end.  Student's t with the median's scale resists scattered errors as
# well, but follows a block of two fifths of the readings that err alike: in 11 of 24 tables of
# distances with one degree of freedom, in 3 with 0.3, this in none.

STARTS, FINALISTS = 300, 10
SWEEPS, MOST_SWEEPS = 3, 30  # of every start before the best are chosen, and of these
MOST_NUMBERS = 3e8  # sums of a sweep over all starts
ENOUGH = 1500  # observations that the sweeps are over
INSIDE = 0.01  # chance of a clean observation to lie outside


def majority(B: Array, e: Array, seed: int = 0) -> tuple[BoolArray, float]:
    """Observations (n,) that agree with the fit of the majority to e (n, size) ≈ B z, z ~ N(0, 1),
    and the variance of their rows; B (n, size, p).  Up to one in a hundred clean observations is
    left outside: this is a suspicion, not a verdict.  Nobody is, where none lies farther out than
    chance would have it of the whole table."""
    n, size, p = B.shape
    rng, half = np.random.default_rng(seed), special.chdtri(size, 0.5)
    # So many tell where the majority lies; all of them then have their say.
    some = np.arange(n) if n <= ENOUGH else rng.choice(n, ENOUGH, replace=False)
    near, own, m, few = B[some], e[some], len(some), min(-(-p // size) + 1, len(some))
    products = near.transpose(0, 2, 1) @ np.concatenate([near, own[..., None]], axis=2)
    products = products.reshape(m, p * (p + 1))

    def squares(weight: Array, variance: Array) -> Array:
        summed = (weight @ products).reshape(len(weight), p, p + 1)
        summed[:, np.arange(p), np.arange(p)] += variance[:, None]
        z = np.linalg.solve(summed[..., :p], summed[..., p:])[..., 0]
        return np.asarray(((own[..., None] - near @ z.T) ** 2).sum(axis=1).T)

    starts = int(np.clip(MOST_NUMBERS / (m * p * p + 1), FINALISTS, STARTS))
    subsets = rng.random((starts, m)).argpartition(few - 1, axis=1)[:, :few]
    weight = np.vstack([np.ones(m), np.zeros((starts, m))])
    np.put_along_axis(weight[1:], subsets, 1.0, axis=1)
    variance = np.full(len(weight), max(median_scale(np.linalg.norm(e, axis=1), size) ** 2, TINY))
    for sweep in range(SWEEPS + MOST_SWEEPS):
        q = squares(weight, variance)
        nearest = np.partition(q, m // 2, axis=1)[:, : m // 2 + 1]
        variance, cost = np.maximum(nearest.max(axis=1) / half, TINY), nearest.sum(axis=1)
        if sweep == SWEEPS:
            best = np.argsort(cost, kind="stable")[:FINALISTS]
            q, variance, cost, nearest = q[best], variance[best], cost[best], nearest[best]
        before, weight = weight, (q <= nearest.max(axis=1)[:, None]).astype(float)
        if sweep > SWEEPS and np.array_equal(weight, before):
            break
    k = int(np.argmin(cost))
    s2, good = float(variance[k]), np.isin(np.arange(n), some[weight[k] > 0])
    # Mean of a χ² variable cut at its 99 % point, per degree of freedom.
    limit = special.chdtri(size, INSIDE)
    cut = special.chdtr(size + 2, limit) / (1 - INSIDE)
    for sweep in range(1 + MOST_SWEEPS):
        squared = (FitToGood(B, e, good, s2).e ** 2).sum(axis=1)
        if sweep:
            rows = size * int(good.sum())
            s2 = max(float(squared[good].sum()) / (cut * max(rows - p, rows / 2)), TINY)
        updated = squared <= limit * s2
        if sweep and (np.array_equal(updated, good) or updated.sum() <= n // 2):
            break
        good = updated
    far = squared > special.chdtri(size, FALSE_ALARM / n) * s2
    return np.asarray(good if far.any() else np.ones(n, dtype=bool)), s2


@dataclass(frozen=True)
class Outlier:
    line: int
    configuration: str
    marker: str
    residual: float
    ratio: float


def blocks(lines: list[int], gap: int = 3) -> list[tuple[int, int]]:
    """Runs of faulty lines, (first, last), bridging gaps of up to `gap` lines."""
    ordered = np.sort(np.array(lines, dtype=np.int64))
    runs = np.split(ordered, np.flatnonzero(np.diff(ordered) > gap) + 1)
    return [(int(run[0]), int(run[-1])) for run in runs if len(run)]


def named_runs(lines: list[int]) -> list[str]:
    """The same in words: "142–507", "610"."""
    return [str(a) if a == b else f"{a}–{b}" for a, b in blocks(lines)]


class FitToGood:
    """y ≈ B z with z ~ N(0, 1), fitted to the observations that are `good` (n,).  B (n, size, p) is
    per prior deviation, y (n, size), and `variance` that of a row.  With RᵀR = Σ BᵀB + variance of
    the good ones, T = B R⁻¹ (n, size, p) makes T_i T_jᵀ the covariance of two predictions in units
    of the variance.  `e` (n, size) is y less its prediction."""

    def __init__(self, B: Array, y: Array, good: BoolArray, variance: float) -> None:
        self.B, self.good = B, good
        (_, size, p), n = B.shape, int(good.sum())
        rows = np.vstack([B[good].reshape(n * size, p), np.sqrt(variance) * np.eye(p)])
        found = RFactor.of(rows, np.append(y[good], np.zeros(p)))
        self.R, half = found.R, found.half
        self.z = half @ found.projected
        self.e = y - (B.reshape(y.size, p) @ self.z).reshape(y.shape)
        self.rss = float((self.e[good] ** 2).sum())
        # Σ TᵀT of the good ones is 1 less the prior's share.
        self.dof = n * size - p + variance * float((half**2).sum())

    @cached_property
    def T(self) -> Array:
        return self.coordinates(self.B)

    @property
    def variance(self) -> float:
        return max(self.rss / max(self.dof, 1.0), TINY)

    def coordinates(self, B: Array) -> Array:
        """T of further observations."""
        flat = B.reshape(len(B) * B.shape[1], B.shape[2])
        return np.asarray(linalg.solve_triangular(self.R, flat.T, trans="T").T).reshape(B.shape)

    def p_values(self, T: Array, e: Array, good: BoolArray) -> Array:
        """p-value (n,) of each error e (n, size), as if its observation had been left out of the
        fit.  A good one has eᵀ(I − TTᵀ)⁻¹e, any other eᵀ(I + TTᵀ)⁻¹e; both over size · s², s²
        without the observation, follow F."""
        size = e.shape[1]
        sign = np.where(good, -1.0, 1.0)[:, None, None]
        spread = (1 + ALONE) * np.eye(size) + sign * (T @ T.transpose(0, 2, 1))
        squared = (e * np.linalg.solve(spread, e[..., None])[..., 0]).sum(axis=1)
        dof = self.dof - size * good
        rest = np.maximum(self.rss - good * squared, TINY)
        return np.where(dof < 1, 1.0, f_test(squared, size, rest, np.maximum(dof, 1))[1])


# Which observations does a fit of the others contradict?  Fitted and judged until the set stands.

ROUNDS = 12
Found = TypeVar("Found")
# A fit, the observations (n,) it is of, and of the half of all that lies nearest the mean square
# and the degrees of freedom of a fit to so many.
Stand = tuple[Found, BoolArray, tuple[float, float]]


def explains_more(one: Stand, other: Stand) -> bool:
    """Whether its better half is nearer than the other's, beyond what chance allows."""
    (variance, dof), (larger, others) = one[2], other[2]
    return bool(larger > special.fdtri(others, dof, 1 - FALSE_ALARM) * variance)


def until_it_stands(
    good: BoolArray, judged: Callable[[BoolArray], tuple[Found, Array, float, BoolArray]]
) -> Stand[Found]:
    """Fit and good observations (n,) that agree with each other, starting from `good`.

    `judged` fits to the good ones and says the squared lengths of all errors, the fit's degrees of
    freedom, and which observations it does not contradict.  A set that comes back after others ends
    the search: those good at any time of that round are kept.  So does a fit that no majority
    agrees with: it cannot judge.  Observations that are taken back bend the fit, so that more of
    them seem to fit: where the better half of all is left worse explained than by an earlier set,
    beyond what chance allows, that set stands.  Raises ElastocalError where the first fit fails.
    """
    ended, visited = False, list[Stand[Found]]()
    for _ in range(ROUNDS):
        try:
            found, squared, dof, agrees = judged(good)
        except ElastocalError:
            if not visited:
                raise
            break  # so few cannot judge the others
        half = len(squared) // 2 + 1
        own = max(dof, 1.0) * half / max(int(good.sum()), 1)
        nearest = float(np.partition(squared, half - 1)[:half].sum())
        visited.append((found, good, (nearest / own, own)))
        if ended or np.array_equal(agrees, good) or 2 * agrees.sum() <= len(agrees):
            break
        masks = [mask for _, mask, _ in visited]
        again = next((k for k, mask in enumerate(masks) if np.array_equal(mask, agrees)), None)
        ended = again is not None
        good = np.logical_or.reduce(masks[again:]) if ended else agrees
    last, best = visited[-1], min(visited, key=lambda one: one[2][0])
    return best if explains_more(best, last) else last


# What slipped, or was misread for a while, follows the lines; a missing effect pose and load.

FEW = 0.1  # of the readings: a larger share beyond the noise is no accident of measuring
CLEAR = 0.05  # chance that accidents lie beside each other in the order of a joint, or at its end


def drops(
    options: Options, observed: Observations, faulty: BoolArray,
    explained: Callable[[], BoolArray] | None = None,
) -> bool:  # fmt: skip
    """Whether the `faulty` observations (N,) are left out of the fit: in auto, where they are
    accidents, or but for those `explained` by one common shift each, whose cause is known, few."""
    if options.faulty != "auto" or are_accidents(observed, faulty):
        return bool(faulty.any()) and options.faulty != "keep"
    if explained is None or faulty.mean() <= FEW or follow_poses(observed, faulty):
        return False  # few that are no accidents have been found to follow the poses
    return bool((faulty & ~explained()).mean() <= FEW)


def are_accidents(observed: Observations, faulty: BoolArray) -> bool:
    if faulty.mean() > FEW:
        return _by_chance(observed, faulty) < FALSE_ALARM
    return not follow_poses(observed, faulty)


def _by_chance(observed: Observations, faulty: BoolArray) -> float:
    """Chance that the `faulty` ones (N,) follow each other in the order of lines, of all or of each
    marker, as they do, over the chance of what the order of any joint within a load state shows."""
    each = [_in_turn(observed, faulty, m) for m in (None, observed.table.marker[observed.lead])]
    return 2 * min(line / max(joint, TINY) for line, joint in each)


def follow_poses(observed: Observations, faulty: BoolArray) -> bool:
    """Whether the `faulty` ones (N,), most readings of their configurations, lie beside each other
    in the order of a joint, or at one of its ends, clearly more than in the order of the lines:
    there the arm errs.  That k of n are among the m nearest to an end has the chance
    C(m, k) / C(n, k)."""
    _, first, of = np.unique(observed.configuration, return_index=True, return_inverse=True)
    q, hit = observed.table.q[observed.lead[first]], np.bincount(of, faulty) > 0
    n, k = len(hit), int(hit.sum())
    if 2 * faulty.sum() < hit[of].sum() or not k:
        return False
    line, near = _in_turn(observed, faulty, None)
    m = np.stack([(q >= q[hit].min(axis=0)).sum(axis=0), (q <= q[hit].max(axis=0)).sum(axis=0)])
    ends = np.exp(special.betaln(n - k + 1, k + 1) - special.betaln(m - k + 1, k + 1))
    ends *= (n + 1) / (m + 1)
    return bool(3 * q.shape[1] * min(near, float(ends.min())) < CLEAR * line)


def _in_turn(
    observed: Observations, faulty: BoolArray, marker: IntArray | None
) -> tuple[float, float]:
    """Chance that the `faulty` ones (N,) follow each other as they do in the order of the lines,
    and of the joint within a load state that shows it most, by `marker` (N,) or all together.
    What is read before the arm moves on counts once: it has the errors of its pose in common."""
    table, lead = observed.table, observed.lead
    line, q = table.row[lead], table.q[lead]
    order, stay = np.argsort(line), np.zeros(len(line), dtype=np.int64)
    where = table.configuration[lead][order]
    stay[order] = np.cumsum(np.diff(where, prepend=where[0]) != 0)
    by = np.zeros_like(stay) if marker is None else marker
    _, first, of = np.unique([by, stay], axis=1, return_index=True, return_inverse=True)
    hit, g, load = np.bincount(of, faulty) > 0, by[first], observed.load[first]
    near = min(_so_few_runs(hit, joint, load, g) for joint in q[first].T)
    return _so_few_runs(hit, line[first], g), near


def _so_few_runs(faulty: BoolArray, *keys: ArrayLike) -> float:
    """Chance of no more runs of `faulty` ones (N,) in the order of keys (N,), the last one first,
    were any order as likely: Σ C(n − k + 1, r) C(k − 1, r − 1) / C(n, k) (Wald, Wolfowitz 1940)."""
    follows = np.diff(np.concatenate([[0], faulty[np.lexsort(np.array(keys))]])) > 0
    n, k, r = len(faulty), int(faulty.sum()), np.arange(int(follows.sum())) + 1
    of, taken = np.array([n - k + 1, k - 1, n])[:, None], np.stack([r, r - 1, np.full_like(r, k)])
    log_choose = -special.betaln(of - taken + 1, taken + 1) - np.log1p(of)
    return float(np.exp([1, 1, -1] @ log_choose).sum())


# Typical sizes in a deviation of the prior: readings of an arm whose errors are five typical sizes
# must not be taken for faulty because they move its parameters.
WEAK = 10.0
STEPS = 4  # to a set's values, from those of the set before
SETTLED = 0.1  # of its deviation: what a step may still move an estimate by at the end


def find_faulty(problem: Problem, found: Array) -> BoolArray:
    """Which observations (N,) are faulty, by all free parameters, tied weakly to the start, and
    noise of one variance; at a Bonferroni limit for the whole table, of which, where there are
    MANY, a sample is judged so, and its fit judges the others.  B is of the values `found`
    (parameters,) where base and markers are known."""
    n = len(problem.observations.lead)
    some = min(SAMPLE, max(MANY, n // 4))
    part = problem.part(np.arange(n)) if n <= MANY else problem.sample(some)
    width = prior_widths(problem)[problem.free]
    x0, free = problem.x0, problem.free
    placed = is_placed(problem.model)[free]
    x = (x0 if placed.any() else found).copy()
    B, y = _whitened(part, x)
    B, y = B * width, y + B @ (x - x0)[free]
    starts = [majority(B[:, :, placed], y)]
    # An arm's own errors hide what all parameters show; half of few readings shows nothing.
    rows = B.reshape(-1, B.shape[2])
    if len(rows) >= 4 * np.linalg.matrix_rank(rows / np.maximum(np.abs(rows).max(axis=0), TINY)):
        starts.append(majority(B, y))
    variance = starts[0][1]

    def judged(good: BoolArray) -> tuple[FitToGood, Array, float, BoolArray]:
        nonlocal B, y, variance
        fit = FitToGood(B, y, good, variance)
        for _ in range(STEPS):
            x, z = x0.copy(), fit.z
            x[free] += width * z
            B, e = _whitened(part, x)
            B, y, variance = B * width, e + B @ (width * z), fit.variance
            fit = FitToGood(B, y, good, variance)
            if np.linalg.norm(fit.R @ (fit.z - z)) <= SETTLED * np.sqrt(fit.variance):
                break
        agrees = fit.p_values(fit.T, fit.e, good) >= FALSE_ALARM / n
        return fit, (fit.e**2).sum(axis=1), fit.dof, agrees

    ends = []
    for good, at_first in starts:
        variance = at_first
        with suppress(ElastocalError):  # so far out the arm has no equilibrium
            ends.append(until_it_stands(good, judged))
    faulty = np.zeros(n, dtype=bool)
    if not ends:
        return faulty
    # What all parameters say against so many is noise that readings share, or a missing effect.
    last = ends[-1] if are_accidents(part.observations, ~ends[-1][1]) else ends[0]
    fit, good, _ = last if explains_more(last, ends[0]) else ends[0]
    if (~good).mean() > FEW:
        # Part of a block that errs alike bends all parameters, and is then contradicted no more.
        sets = [one for one in (good, starts[0][0]) if not one.all()]
        good = min(sets, key=lambda one: _by_chance(part.observations, ~one))
        fit = FitToGood(B, y, good, fit.variance)
    faulty[part.index[~good]] = True
    if len(part.index) < n:
        faulty |= _contradicting(problem, fit, width, part)
    return faulty if 2 * faulty.sum() < n else np.zeros(n, dtype=bool)


def prior_widths(problem: Problem) -> Array:
    """Deviations (parameters,) of the weak prior about a start: what the readings do not show stays
    there, and is not known any better."""
    return np.where(is_placed(problem.model), PLACED, WEAK * problem.sizes)


def _whitened(part: Problem, x: Array) -> tuple[Array, Array]:
    (B, e), shape = part.whitened(x, part.free), (len(part.index), part.observations.size)
    return B.reshape(*shape, -1), e.reshape(shape)


def _contradicting(problem: Problem, fit: FitToGood, width: Array, known: Problem) -> BoolArray:
    """Observations (N,) of a large table, but those of the part that the fit is of, which it
    contradicts. B is evaluated in those parts alone that hold errors too large were the fit
    exact."""
    x, n, size = problem.x0.copy(), len(problem.observations.lead), problem.observations.size
    x[problem.free] += width * fit.z
    e = problem.weights.apply(problem.residual(x)).reshape(n, size)
    level = FALSE_ALARM / n
    limit = float(special.fdtri(size, max(fit.dof, 1.0), 1 - level))
    beyond = (e**2).sum(axis=1) > size * fit.variance * limit
    beyond[known.index] = False

    def of_part(part: Problem) -> None:
        if beyond[part.index].any():
            B, own = _whitened(part, x)
            outside = np.zeros(len(own), dtype=bool)
            beyond[part.index] &= fit.p_values(fit.coordinates(B * width), own, outside) < level

    list(problem.each(of_part))
    return beyond


def describe(solution: Solution, fitted: Solution, faulty: BoolArray) -> tuple[Outlier, ...]:
    if not faulty.any():
        return ()
    observed, error = solution.problem.observations, solution.problem.residual(fitted.fit.x)
    table, lead, size = observed.table, observed.lead[faulty], observed.size
    length = np.linalg.norm(error.reshape(-1, size)[faulty, :3], axis=1)
    off = np.linalg.norm(solution.problem.weights.apply(error).reshape(-1, size), axis=1)
    ratio = off[faulty] / median_scale(off[~faulty], size)
    labels = (table.configuration_labels[c] for c in table.configuration[lead])
    markers = (table.marker_names[m] for m in table.marker[lead])
    lines = table.row[lead].tolist()
    return tuple(map(Outlier, lines, labels, markers, length.tolist(), ratio.tolist()))


def rejection_point(values: int, dof: ArrayLike = np.inf) -> Array:
    """How many standard deviations off a reading's component lies that is set apart: beyond what t
    on `dof` degrees of freedom makes of a table of so many `values`, at FALSE_ALARM for the whole
    table (Bonferroni)."""
    return np.asarray(-special.stdtrit(dof, FALSE_ALARM / values / 2))


# What setting readings apart makes of an estimate.
#
# Σ B_iᵀ ψ(r_i) = 0 with ψ(r) = r where all components of a reading are within c standard deviations
# of those kept, else 0, is an M-estimate: of the covariance
#
#     E[ψ²] / E[ψ']² · (BᵀB)⁻¹,    E[ψ'] = −∫ ψ f' dr = E[ψ · (ν + 1) r / (ν a² + r²)]
#
# (Huber 1964, Ann. Math. Stat. 35, 73), for noise of the density f, Student's t of scale a; ψ
# jumps, hence the second form.  None can have less than 1/I = a² (ν + 3)/(ν + 1).

NODES, REPEATED = 200, 50


@dataclass(frozen=True)
class TrimmedNoise:
    """Noise of variance one of which far readings are set apart: the standard deviation `sigma` and
    the `excess_kurtosis` of what is kept, and the `variance` of an estimate over that by least
    squares of normal noise of variance one."""

    sigma: float
    excess_kurtosis: float
    variance: float


@lru_cache(maxsize=256)
def kept_of(dof: float, values: int, size: int) -> TrimmedNoise:
    """What `rejection_point` keeps of a table of so many `values`, `size` independent components to
    a reading, whose noise is Student's t on `dof` > 2 degrees of freedom."""
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    squared_scale = 1 - 2 / dof
    constant = special.gammaln((dof + 1) / 2) - special.gammaln(dof / 2)
    constant -= 0.5 * np.log(dof * np.pi * squared_scale)
    point, sigma = float(rejection_point(values)), 1.0
    for _ in range(REPEATED):
        reach = point * sigma
        r = reach * (nodes + 1) / 2
        log_f = constant - (dof + 1) / 2 * np.log1p(r**2 / (dof * squared_scale))
        f = reach * weights * np.exp(log_f)  # both sides of zero
        share, second = float(f.sum()), float(f @ r**2)
        sigma = float(np.sqrt(second / share))
    slope = float(f @ (r**2 * (dof + 1) / (dof * squared_scale + r**2)))
    others = share ** (size - 1)  # the reading's other components are near as well
    kurtosis = float(f @ r**4) / share / sigma**4 - 3
    return TrimmedNoise(sigma, kurtosis, second / (slope**2 * others))


# Is a reading explained by the others?  Deletion residuals under an estimated noise model.
#
# The error of predicting reading i from all others, its configuration's shared deviation included,
# is d_i = P_ii⁻¹ (P e)_i with covariance P_ii⁻¹ (Haslett and Hayes 1998, J. R. Stat. Soc. B 60,
# 201), P = V⁻¹ − V⁻¹BΦBᵀV⁻¹: one evaluation judges all.  A reading that is not to be relied on has
# a very large noise of its own, which is taken off again.

APART = 1e8  # times its own: it then moves nothing, and taking it off again leaves digits


def prediction_errors(found: NoiseFit, readings: Readings, good: BoolArray, own: Array) -> Array:
    """Errors (N, size) of predicting each reading from the `good` ones (N,) that are not it, over
    their deviations; `own` (N, size, size) is the noise of single readings.  Along a direction that
    a reading alone determines its error is zero."""
    n, size = len(readings), readings.size
    apart = np.where(good, 0.0, APART)
    weights = weights_of(found, readings, apart[:, None, None] * own)
    assert weights.whiten is not None
    rows, e = weights.beside_common(readings.B.reshape(n * size, -1), readings.e.ravel())
    Q, back = np.linalg.qr(rows)[0], weights.whiten.T
    u = (back @ (e - Q @ (Q.T @ e))[: n * size]).reshape(n, size)
    H = (back @ Q[: n * size]).reshape(n, size, -1)
    at = np.arange(n * size).reshape(n, size)
    i, j = np.broadcast_arrays(at[:, :, None], at[:, None, :])
    inverse = np.asarray((back @ weights.whiten).tocsr()[i.ravel(), j.ravel()]).reshape(i.shape)
    P = inverse - H @ H.transpose(0, 2, 1)
    root = np.linalg.cholesky(own) * np.sqrt(1 + apart)[:, None, None]
    values, vectors = np.linalg.eigh(root.transpose(0, 2, 1) @ P @ root)
    seen, axes = values > ALONE, root @ vectors
    inverse = np.where(seen, 1 / np.maximum(values, ALONE), 0.0)
    d = ((axes * inverse[:, None, :]) @ (axes.transpose(0, 2, 1) @ u[..., None]))[..., 0]
    left = np.where(seen, inverse - (apart / (1 + apart))[:, None], 0.0)
    deviation = np.sqrt((axes**2 @ np.maximum(left, 0.0)[..., None])[..., 0])
    return np.divide(d, deviation, out=np.zeros_like(d), where=deviation > 0)


def settle(
    readings: Readings, kind: str = "auto", good: BoolArray | None = None,
    noise: NoiseFit | None = None,
) -> tuple[NoiseFit, BoolArray]:  # fmt: skip
    """Noise and good readings (N,) that agree with each other, starting from `good` (default all),
    and from the `noise` given, whose kind is kept.

    The noise model is fitted to the good readings, and every reading judged by the error of its
    prediction from them (false-alarm rate 1 % for the whole table), in turn.  Starting from all,
    errors that hide each other may stay: start from the majority.
    """
    every = np.ones(len(readings), dtype=bool)
    good = every if good is None else good
    precision: list[Array] = []  # of single readings, by the first noise

    def judged(chosen: BoolArray) -> tuple[NoiseFit, Array, float, BoolArray]:
        nonlocal noise
        noise = found = estimate_noise(readings.take(chosen), kind, noise)
        own, behind = own_noise(found.fit, readings)
        if not precision:
            precision.append(np.asarray(np.linalg.inv(own)))
        r = readings.e - readings.B @ found.x
        dof = readings.size * int(chosen.sum()) - readings.n_parameters
        # Each component's error is compared with t on the degrees of freedom behind its noise; a
        # reading that was fitted has a part in the variance it is measured with, and is left out
        # there as well.
        t = prediction_errors(found, readings, chosen, own)
        within, outside = np.minimum(t**2, behind * (1 - 1e-12)), np.maximum(behind - 1, 1.0)
        left_out, inside = np.sqrt(within * outside / (behind - within)), chosen[:, None]
        point = rejection_point(t.size, np.where(inside, outside, behind))
        agrees = np.asarray(~(np.where(inside, left_out, np.abs(t)) > point).any(axis=1))
        return found, np.einsum("ni,nij,nj->n", r, precision[0], r), dof, agrees

    try:
        return until_it_stands(good, judged)[:2]
    except ElastocalError:  # the good ones alone do not show all parameters
        return until_it_stands(every, judged)[:2]


# Robust fits by name, by reweighting.
#
# An observation of `size` whitened rows (x, y, z of a tracker reading) is right or wrong as a
# whole: Huber's loss sees the length d = |e_i|/σ of its scaled residual, its rows share a weight,
#
#     ρ(d) = d²/2 up to c, c d − c²/2 beyond,    ψ = ρ′ = min(d, c)        (Huber 1964)
#
#     huber   c of 95 % efficiency
#     l1      c near 0, the least sum of Euclidean lengths
#
# The weights ψ/d solve Σ B_iᵀ Ψ(e_i/σ) = 0, Ψ(r) = ψ(|r|) r/|r|.  They are no inverse variances: a
# weight is small because that residual came out large, not because its variance was known to be.
# The covariance follows from ψ and ψ′.  The derivative J = ∂Ψ/∂r has the eigenvalue ψ′ along the
# error and ψ/d across it (size − 1 times); for errors that are symmetric in direction E J = a I and
# E ΨΨᵀ = b I, and expanding the sum gives
#
#     a = E[ψ′ + (size − 1) ψ/d]/size,    b = E ψ²/size,
#     x̂ − x ≈ (BᵀB)⁻¹ Bᵀ (σ/a) Ψ,         cov x̂ = σ² (b/a²) (BᵀB)⁻¹
#
# (Huber 1981, sections 7.6 and 7.10, per row; Maronna 1976 for vectors): that of least squares
# whose residuals are (σ/a) Ψ.  Under normal noise d follows χ(size), and the efficiency is a²/b.

# c by the rows of an observation, 1 to 6: 95 % efficient under normal noise, by quadrature.
HUBER = (1.344997509, 1.501141084, 1.627987920, 1.731072513, 1.812018420, 1.869337729)
L1 = 1e-4  # far below any standard deviation
TOLERANCE = 1e-11  # of the step |B δx| in units of the scale
MAX_ITER = 5000


class HuberFit:
    """M-estimate x = V z (p,) of y (n·size,) ≈ B x, from least squares on, `scale` σ the MAD about
    zero of every residual anew (Huber 1981, section 7.8), no less than rounding of y lets it be; c
    by default of 95 % efficiency.

    B x = Q z with orthonormal Q, so that the parameters' units do not matter.  It has one solution,
    and resists errors in y but not at leverage points.  `distance` (n,) is |e_i|/σ.
    """

    def __init__(self, B: Array, y: Array, size: int, c: float | None = None) -> None:
        self.size, self.c = size, HUBER[size - 1] if c is None else c
        self.Q, self.V = Q, _ = orthogonal(B)
        self.z = step = Q.T @ y
        self.scale, eps = np.inf, float(np.finfo(float).eps)
        floor = eps * float(np.sqrt(np.mean(y**2))) + TINY
        for _ in range(MAX_ITER):
            self.residual, before = y - Q @ self.z, self.scale
            length = np.linalg.norm(self.residual.reshape(-1, size), axis=1)
            self.scale = max(median_scale(length, size), floor)
            self.distance, still = length / self.scale, TOLERANCE * self.scale
            # Or there are no more digits in z.
            ended = np.linalg.norm(step) <= max(still, 4 * eps * float(np.linalg.norm(self.z)))
            if ended and abs(self.scale - before) <= still:
                break
            weighted = Q.T * np.repeat(self.weights(self.c), size)
            step = linalg.solve(weighted @ Q, weighted @ self.residual, assume_a="pos")
            self.z = self.z + step

    @property
    def x(self) -> Array:
        return self.V @ self.z

    def weights(self, c: float) -> Array:
        """ψ(d)/d (n,)."""
        return c / np.maximum(self.distance, c)

    def covariance(self, cluster: NDArray[Any] | None = None) -> Covariance:
        """Covariance (p, p) of x̂.

        Of independent readings Huber's H1, k² σ² (b̂/â²) (BᵀB)⁻¹, with b̂ = Σψ²/(n·size − p) and
        his small-sample factor k = 1 + (p/(n·size)) Var(eigenvalues)/â²; t intervals with rows less
        p as dof.  Under any dependence within a `cluster` (n,), such as a configuration, CR3 of
        (σ/a) Ψ.

        Raises InsufficientDataError where nearly all readings lie far from the fit, or a cluster
        alone determines a combination of the parameters.
        """
        rows, p, size, c, d = len(self.residual), len(self.z), self.size, self.c, self.distance
        if c == L1:
            # ψ of l1 jumps at zero: a share of the residuals there tells its slope, that of Hall
            # and Sheather's bandwidth, without the p residuals that the fit makes zero (Koenker
            # 2005, section 3.4); c of that share is as good and has a curvature to be estimated.
            kept = np.sort(d)[p // size :]
            h = (special.ndtri(0.975) ** 2 * 1.5 / (2 * np.pi) / len(kept)) ** (1 / 3)
            c = max(c, float(np.quantile(kept, min(2 * h, 0.98))))
        across, along = self.weights(c), (d <= c).astype(float)
        a = float(np.mean(along + (size - 1) * across)) / size
        if not a > 0:
            raise InsufficientDataError(
                "so many readings lie far from the fit that its covariance cannot be determined; "
                "use the default method, or look for the cause of the outliers"
            )
        pseudo = np.repeat(across, size) * self.residual / a
        if cluster is not None:
            return clustered([(self.Q, pseudo, np.repeat(cluster, size))], self.V, "CR3")
        square = float((along**2).sum() + (size - 1) * (across**2).sum()) / rows
        k = 1 + p / rows * (square - a**2) / a**2
        variance = k**2 * float(pseudo @ pseudo) / (rows - p)
        name = "l1" if self.c == L1 else "huber"
        text = f"asymptotic covariance H1 of the {name} estimate, from ψ and ψ′"
        return Covariance("H1", variance * self.V @ self.V.T, np.full(p, float(rows - p)), text)


STILL = 1e-5  # |B δx| in units of the scale at which the steps have converged
MOST_MOVES = 40


def robust_result(
    method: str, every: Solution, sound: Solution, good: BoolArray, intervals: str
) -> MethodResult:
    """The robust fit of all readings in the parameters that the `good` ones (N,) determine.

    Minimises Σ ρ(|W (y − h(X))_i|/σ) over X[kept] by Gauss–Newton steps from the fit to the good
    ones: each is the robust linear fit of the whitened residual to the whitened B at X.  Whitening
    by a covariance that couples observations (deflections that share an unloaded reading) mixes
    them: a bad reading then also shows in those whitened after it.
    """
    problem, kept, x, steps = every.problem, sound.reduction.kept, sound.fit.x.copy(), 0
    if intervals not in ("auto", "cr3"):
        raise InputError(
            f"the method {method} has intervals of its own: 'auto' for independent readings, "
            "'cr3' where readings of a configuration depend on each other"
        )
    observed, weights = problem.observations, problem.weights
    while True:
        at = problem.model.regressor(observed.table, x, kept, observed)
        c = None if method == "huber" else L1
        found = HuberFit(weights.apply(at.B), weights.apply(at.residual), observed.size, c)
        converged = bool(np.linalg.norm(found.z) <= STILL * found.scale * np.sqrt(len(kept)))
        if converged or steps == MOST_MOVES:
            break
        x[kept] += found.x
        steps += 1
    fit = replace(
        sound.fit, x=x, residual=at.residual, converged=converged, columns=kept,
        problem=replace(problem, x0=sound.problem.x0, sizes=sound.problem.sizes),
        reason=sound.fit.reason if converged else "the robust steps did not settle",
    )  # fmt: skip
    # Only for predicting left-out configurations do ψ(d)/d stand in as weights.
    root = np.sqrt(np.repeat(np.minimum(found.weights(found.c), 1e6), observed.size))
    own = sparse.eye_array(len(root)) if weights.whiten is None else weights.whiten
    robust = replace(weights, whiten=sparse.csr_array(sparse.diags_array(root) @ own))
    out, Q = observed.configuration, np.linalg.qr(robust.apply(fit.B))[0]
    heldout = held_out_residual(fit.B, at.residual, robust, out, observed.size)
    left = share_left(Q, np.repeat(out, observed.size))
    solution = replace(sound, fit=fit)
    solution = replace(solution, held=(heldout, solution.crossed[1], left))
    labels = np.array(observed.table.configuration_labels)
    cluster = None if intervals == "auto" else labels[observed.configuration]
    return MethodResult(method, solution, found.covariance(cluster), None, good)
