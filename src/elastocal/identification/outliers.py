"""Readings that the others contradict: each judged as if left out of the fit to the majority."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg, special

from elastocal.errors import ElastocalError
from elastocal.identification.least_squares import Problem
from elastocal.identification.noise_choice import (
    NoiseFit,
    NoisyReadings,
    covariance_of,
    estimate_noise,
    own_noise,
    variances_of,
)
from elastocal.identification.noise_structure import Readings
from elastocal.identification.residuals import f_test
from elastocal.identification.solve import PLACED, SAMPLE, Solution, is_placed
from elastocal.identification.weighted_problem import (
    Part,
    each,
    least_norm,
    regressor,
    residual_at,
    sample,
)
from elastocal.model.manipulator import Model
from elastocal.units import Array, BoolArray, IntArray


def median_scale(length: Array, size: int) -> float:
    """σ = med|e_i| / median of χ(size): the MAD about zero for size 1; breakdown 50 %.

    `length` (n,) of the observations' residuals.
    """
    return float(np.median(length) / np.sqrt(special.chdtri(size, 0.5)))


FALSE_ALARM = 0.01  # chance that a clean table yields any faulty reading at all

STARTS, FINALISTS = 500, 10
SWEEPS, MOST_SWEEPS = 2, 30  # of every start before the best are chosen, and of these
TOGETHER = 100  # starts whose residuals are held at a time
RIDGE = 1e-12  # keeps a direction that some observations do not show where it is
INSIDE = 0.01  # chance of a clean observation to lie outside


def trimmed_fit(Q: Array, e: Array, seed: int = 0) -> Array:
    """z (p,) minimising the sum of the smaller half of |e_i − Q_i z|², Q (n, size, p) orthonormal.

    Up to half of the observations e (n, size) may be arbitrarily wrong.  FAST-LTS (Rousseeuw and
    Van Driessen 2006): many smallest possible random subsets and z = 0, refits to the half with the
    smallest residuals, the best few run to the end.

    Student's t with the median's scale needs no subsets and resists scattered errors as well, but
    follows a block of two fifths of the readings that err alike: in 11 of 24 tables of distances
    with one degree of freedom, in 3 with 0.3; this in none.
    """
    n, size, p = Q.shape
    half = (n + p // size + 1) // 2
    # The normal equations of any choice of observations are a sum of those of single ones.
    products = Q.transpose(0, 2, 1) @ np.concatenate([Q, e[..., None]], axis=2)
    products = products.reshape(n, -1)

    def squares(z: Array) -> Array:
        left = e[..., None] - Q @ z.T
        return np.asarray((left**2).sum(axis=1).T)

    def concentrated(chosen: IntArray, steps: int) -> tuple[Array, Array]:
        """Fits (starts, p) `steps` from the `chosen` (starts, k), and their trimmed costs."""
        for step in range(steps + 1):
            inside = np.zeros((len(chosen), n))
            np.put_along_axis(inside, chosen, 1.0, axis=1)
            summed = (inside @ products).reshape(-1, p, p + 1)
            summed[:, np.arange(p), np.arange(p)] += RIDGE
            z = np.linalg.solve(summed[..., :p], summed[..., p:])[..., 0]
            squared = squares(z)
            if step < steps:
                chosen = np.argpartition(squared, half - 1, axis=1)[:, :half]
        return z, np.partition(squared, half - 1, axis=1)[:, :half].sum(axis=1)

    rng, need = np.random.default_rng(seed), min(-(-p // size) + 1, n)
    subsets = np.array([rng.choice(n, need, replace=False) for _ in range(STARTS)])
    found = [concentrated(subsets[k : k + TOGETHER], SWEEPS) for k in range(0, STARTS, TOGETHER)]
    z, cost = (np.concatenate(parts) for parts in zip(*found, strict=True))
    best = np.vstack([z[np.argsort(cost, kind="stable")[:FINALISTS]], np.zeros(p)])
    nearest = np.argpartition(squares(best), half - 1, axis=1)[:, :half]
    z, cost = concentrated(nearest, MOST_SWEEPS)
    return np.asarray(z[int(np.argmin(cost))], dtype=np.float64)


def majority(B: Array, e: Array, seed: int = 0) -> tuple[BoolArray, float]:
    """Observations (n,) that agree with the least trimmed squares fit of the majority, B (n, size,
    p) and e (n, size), and the variance of their rows.

    Reweighted LTS, repeated: fit to the observations inside the 99 % limit of χ²(size), scale
    from those corrected for the cut, new limit.  Up to one in a hundred clean observations is
    left outside, so this is a suspicion, not a verdict; nobody is, where none lies farther out
    than chance would have it of the whole table.
    """
    n, size, p = B.shape
    limit, Q, z = special.chdtri(size, INSIDE), B, np.zeros(0)
    if p:
        flat = B.reshape(-1, p)
        scale = np.linalg.norm(flat, axis=0)
        U, values, _ = linalg.svd(flat / np.where(scale > 0, scale, 1.0), full_matrices=False)
        Q = U[:, values > 1e-10 * values[0]].reshape(n, size, -1)
        z = trimmed_fit(Q, e, seed)
    # Mean of a χ² variable cut at its 99 % point, per degree of freedom.
    cut = special.chdtr(size + 2, limit) / (1 - INSIDE)
    squared = ((e - Q @ z) ** 2).sum(axis=1)
    variance = median_scale(np.sqrt(squared), size) ** 2
    good = squared <= limit * variance
    for _ in range(50):
        if p:
            z = least_norm(Q[good].reshape(-1, Q.shape[2]), e[good].ravel())
        squared = ((e - Q @ z) ** 2).sum(axis=1)
        variance = float(squared[good].mean() / (size * cut))
        updated = squared <= limit * variance
        if np.array_equal(updated, good) or updated.sum() <= n // 2:
            break
        good = updated
    far = squared > special.chdtri(size, FALSE_ALARM / n) * variance
    return np.asarray(good if far.any() else np.ones(n, dtype=bool)), variance


# Readings that the others contradict: each judged as if left out of the fit to the majority.


@dataclass(frozen=True)
class Outlier:
    """A reading whose residual lies beyond what the noise explains."""

    line: int
    configuration: str
    marker: str
    residual: float
    ratio: float


def blocks(lines: list[int], gap: int = 3) -> list[tuple[int, int]]:
    """Runs of faulty lines, (first, last), bridging gaps of up to `gap` lines."""
    runs: list[tuple[int, int]] = []
    for line in sorted(lines):
        if runs and line - runs[-1][1] <= gap:
            runs[-1] = (runs[-1][0], line)
        else:
            runs.append((line, line))
    return runs


# What a linear fit to some of the readings says of all of them.

TINY = np.finfo(float).tiny
ALONE = 1e-9  # share of an observation's direction that the other observations must see


class FitToGood:
    """y ≈ B z with z ~ N(0, 1), fitted to the observations that are `good` (n,).

    B (n, size, p) is per prior deviation, y (n, size), and `variance` that of a row.  With
    RᵀR = Σ BᵀB + variance of the good ones, T = B R⁻¹ (n, size, p) makes T_i T_jᵀ the covariance of
    two predictions in units of the variance.  `e` (n, size) is y less its prediction.
    """

    def __init__(self, B: Array, y: Array, good: BoolArray, variance: float) -> None:
        p, self.good = B.shape[2], good
        rows = np.vstack([B[good].reshape(-1, p), np.sqrt(variance) * np.eye(p)])
        self.R = np.asarray(np.linalg.qr(rows, mode="r"))
        self.T = self.coordinates(B)
        fitted = np.einsum("nij,ni->j", self.T[good], y[good])
        self.z = np.asarray(linalg.solve_triangular(self.R, fitted))
        self.e = y - self.T @ fitted
        self.rss = float((self.e[good] ** 2).sum())
        self.dof = self.e[good].size - float((self.T[good] ** 2).sum())

    @property
    def variance(self) -> float:
        return max(self.rss / max(self.dof, 1.0), TINY)

    def coordinates(self, B: Array) -> Array:
        """T of further observations."""
        flat = B.reshape(-1, B.shape[2])
        return np.asarray(linalg.solve_triangular(self.R, flat.T, trans="T").T).reshape(B.shape)

    def p_values(self, T: Array, e: Array, good: BoolArray) -> Array:
        """p-value (n,) of each error e (n, size), as if its observation had been left out of the
        fit.

        A good one has eᵀ(I − TTᵀ)⁻¹e, any other eᵀ(I + TTᵀ)⁻¹e; both over size · s², s² without
        the observation, follow F.
        """
        size = e.shape[1]
        sign = np.where(good, -1.0, 1.0)[:, None, None]
        spread = (1 + ALONE) * np.eye(size) + sign * (T @ T.transpose(0, 2, 1))
        squared = (e * np.linalg.solve(spread, e[..., None])[..., 0]).sum(axis=1)
        dof = self.dof - size * good
        rest = np.maximum(self.rss - good * squared, TINY)
        return np.where(dof < 1, 1.0, f_test(squared, size, rest, np.maximum(dof, 1))[1])


# Which observations does a fit of the others contradict?  Judged in turns until it stands.

# Typical sizes in a deviation of the prior: readings of an arm whose errors are five typical sizes
# must not be taken for faulty because they move its parameters.
WEAK = 10.0
ROUNDS = 12
SETTLED = 0.1  # of its deviation: what a round may still move an estimate by


def find_faulty(solution: Solution) -> BoolArray:
    """Which observations (N,) are faulty.

    The majority's fit of base, markers and cable to the nominal arm shows the suspects.  Then all
    free parameters, tied weakly to the start, are fitted to the others, every observation is
    judged at a Bonferroni limit for the whole table, which makes new good ones, and so on.  Of a
    large table a sample does so, and its fit judges the others.
    """
    problem, n = solution.problem, len(solution.problem.observations.lead)
    part = sample(problem.parts, SAMPLE) if problem.large else problem.parts.part((0, n))
    width = prior_widths(problem.model, solution.sizes)[problem.free]
    good, fit = _agreeing(solution, part, width, FALSE_ALARM / n)
    faulty = np.zeros(n, dtype=bool)
    faulty[part.index[~good]] = True
    if not problem.large or fit is None:
        return faulty
    faulty |= _contradicting(problem, fit, width, part)
    return faulty if 2 * faulty.sum() < n else np.zeros(n, dtype=bool)


def prior_widths(model: Model, sizes: Array) -> Array:
    """Deviations (parameters,) of the weak prior about a start: what the readings do not show stays
    there, and is not known any better."""
    return np.where(is_placed(model), PLACED, WEAK * sizes)


def _agreeing(
    solution: Solution, part: Part, width: Array, level: float
) -> tuple[BoolArray, FitToGood | None]:
    """Observations (n,) of the part that a fit does not contradict at this level, and the fit.

    Where taking readings back in has bent the fit away from the majority, an earlier verdict
    stands: the sum of the smaller half of the squared lengths tells.
    """
    problem, size = solution.problem, part.observations.size
    x0, free, n = problem.x0, problem.free, len(part.index)
    placed = is_placed(problem.model)[free]
    x = x0 if placed.any() else solution.fit.x
    B, e = _whitened(problem, part, x)
    good, variance = majority(B[:, :, placed], e)
    masks: list[BoolArray] = []
    none: tuple[float, BoolArray, FitToGood | None] = np.inf, np.ones(n, dtype=bool), None
    final = best = none
    for _ in range(ROUNDS):
        z = (x - x0)[free] / width
        fit = FitToGood(B * width, e + B @ (x - x0)[free], good, max(variance, TINY))
        agrees = fit.p_values(fit.T, fit.e, good) >= level
        if 2 * agrees.sum() <= n:
            break  # no majority agrees with this fit: it cannot judge
        lengths = (fit.e**2).sum(axis=1)
        final = float(np.partition(lengths, n // 2)[: n // 2 + 1].sum()), good, fit
        best = min(best, final, key=lambda one: one[0])
        masks.append(good)
        settled = np.linalg.norm(fit.R @ (fit.z - z)) <= SETTLED * np.sqrt(fit.variance)
        if settled and any(np.array_equal(agrees, before) for before in masks):
            break
        good, variance, x = agrees, fit.variance, x0.copy()
        x[free] += width * fit.z
        try:
            B, e = _whitened(problem, part, x)
        except ElastocalError:
            break  # so far out the arm has no equilibrium
    half = n * size // 2
    bent = final[0] > best[0] * special.fdtri(half, half, 1 - FALSE_ALARM)
    return best[1:] if bent else final[1:]


def _whitened(problem: Problem, part: Part, x: Array) -> tuple[Array, Array]:
    """B (n, size, free) and residual (n, size) of a part at x, whitened."""
    at, shape = regressor(problem.model, part, x, problem.free), (len(part.index), -1)
    B, e = part.weights.apply(at.B), part.weights.apply(at.residual)
    return B.reshape(len(part.index), part.observations.size, -1), e.reshape(shape)


def _contradicting(problem: Problem, fit: FitToGood, width: Array, known: Part) -> BoolArray:
    """Observations (N,) of a large table, but those of the part that the fit is of, which it
    contradicts.

    B is evaluated in those parts alone that hold errors too large were the fit exact.
    """
    x, n, size = problem.x0.copy(), len(problem.observations.lead), problem.observations.size
    x[problem.free] += width * fit.z
    e = problem.weights.apply(residual_at(problem.model, problem.parts, x)).reshape(n, size)
    level = FALSE_ALARM / n
    limit = float(special.fdtri(size, max(fit.dof, 1.0), 1 - level))
    beyond = (e**2).sum(axis=1) > size * fit.variance * limit
    beyond[known.index] = False

    def of_part(part: Part) -> None:
        if beyond[part.index].any():
            B, own = _whitened(problem, part, x)
            outside = np.zeros(len(own), dtype=bool)
            beyond[part.index] &= fit.p_values(fit.coordinates(B * width), own, outside) < level

    for _ in each(problem.parts, of_part):
        pass
    return beyond


def describe(solution: Solution, fitted: Solution, faulty: BoolArray) -> tuple[Outlier, ...]:
    """The faulty observations with their error under the fit to the others, in table order."""
    if not faulty.any():
        return ()
    observed, model = solution.problem.observations, solution.problem.model
    error = residual_at(model, solution.problem.parts, fitted.fit.x)
    length = np.linalg.norm(error.reshape(-1, observed.size)[:, :3], axis=1)
    squared = (solution.problem.weights.apply(error).reshape(-1, observed.size) ** 2).sum(axis=1)
    sigma = median_scale(np.sqrt(squared[~faulty]), observed.size)
    table = observed.table
    return tuple(
        Outlier(
            int(table.row[observed.lead[k]]),
            table.configuration_labels[table.configuration[observed.lead[k]]],
            table.marker_names[table.marker[observed.lead[k]]],
            float(length[k]),
            float(np.sqrt(squared[k]) / sigma),
        )
        for k in np.flatnonzero(faulty)
    )


def rejection_point(values: int, dof: ArrayLike = np.inf, level: float = FALSE_ALARM) -> Array:
    """How many standard deviations off a reading's component lies that is set apart: beyond what t
    on `dof` degrees of freedom makes of a table of so many `values`, at a `level` for the whole
    table (Bonferroni)."""
    return np.asarray(-special.stdtrit(dof, level / values / 2))


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
# 201): one evaluation judges every reading of the fit.  A reading outside it, of the covariance k
# with those inside, errs by d = e − BΔx − kᵀV⁻¹r, which varies by Σ − kᵀV⁻¹k + FΦ_AFᵀ with
# F = B − kᵀV⁻¹B_fit.


def unexplained_readings(
    found: NoiseFit, readings: Readings, good: BoolArray, level: float
) -> BoolArray:
    """Readings (N,) that the noise does not explain, at `level` for the whole table (Bonferroni).

    `found` was estimated from the `good` readings (N,); each component of a reading's
    `standard_errors` is compared with t on the degrees of freedom behind it.
    """
    size, dof = standard_errors(found, readings, good)
    return np.asarray((size > rejection_point(size.size, dof, level)).any(axis=1))


def standard_errors(found: NoiseFit, readings: Readings, good: BoolArray) -> tuple[Array, Array]:
    """Errors (N, size) of predicting each reading from the `good` ones (N,) that are not it, in
    units of their own deviation, and the degrees of freedom (N, size) behind that."""
    own, dof = own_noise(found.fit, readings)
    t = _predicted(found, readings, good, own)
    # A fitted reading has a part in the variance it is measured with: leave it out there as well.
    squared = np.minimum(t**2, dof * (1 - 1e-12))
    outside = np.maximum(dof - 1, 1.0)
    deleted = np.sqrt(squared * outside / (dof - squared))
    fitted_too = good[:, None]
    return np.where(fitted_too, deleted, np.abs(t)), np.where(fitted_too, outside, dof)


def _predicted(found: NoiseFit, readings: Readings, good: BoolArray, own: Array) -> Array:
    """Errors (N, size) of predicting each reading from the others, each over its deviation."""
    structure, theta, _ = variances_of(found.fit, readings)
    basis = found.basis[: readings.n_parameters, : readings.n_parameters]
    turned = replace(readings, B=readings.B @ basis)
    noisy = NoisyReadings(turned, found.fit.noisy.kind, found.lasting, structure, ~good)
    known = dict(zip(found.fit.noisy.names, found.fit.theta, strict=True))
    rest = [known.get(name, 0.0) for name in noisy.names[len(theta) :]]
    state = noisy.model().state(np.concatenate([theta, rest]))
    spread = covariance_of(found.fit, np.eye(len(state.x)))[0]
    size, sets = readings.size, noisy.sets
    P, variance = np.zeros((2, sets.n, size, size))
    Pe, d = np.zeros((2, sets.n, size))
    for (members, _), w, (pack, inside, u) in zip(
        noisy.packs, state.packs, state.projected(), strict=False
    ):
        here, M = members >= 0, members.shape[1]
        P[members[here]] = _blocks(inside, M)[here]
        Pe[members[here]] = u.reshape(-1, M, size)[here]
        some = (pack.absent & np.repeat(here, size, axis=1)).any(axis=1)
        if some.any():
            # R⁻¹k of every row with those that count, F and d.
            V = pack.V(state.theta)[some]
            k = w.root[some] @ V
            back, own_sets = k.transpose(0, 2, 1), members[some]
            F = sets.B[own_sets].reshape(*V.shape[:2], -1) - back @ w.B[some]
            off = sets.e[own_sets].reshape(V.shape[:2]) - (back @ w.e[some][..., None])[..., 0]
            left = _blocks(V - back @ k + F @ spread @ F.transpose(0, 2, 1), M)
            d[own_sets[here[some]]] = (off - F @ state.x).reshape(-1, M, size)[here[some]]
            variance[own_sets[here[some]]] = left[here[some]]
    out = _deleted(noisy, P, Pe, own)
    outside = d / np.sqrt(np.maximum(np.diagonal(variance, axis1=1, axis2=2), 1e-300))
    out[~good] = outside[sets.of[~good]]
    return out


def _blocks(V: Array, M: int) -> Array:
    """The blocks (C, M, size, size) along the diagonal of V (C, M·size, M·size)."""
    size, at = V.shape[1] // M, np.arange(M)
    return V.reshape(-1, M, size, M, size)[:, at, :, at, :].transpose(1, 0, 2, 3)


def _deleted(noisy: NoisyReadings, P: Array, Pe: Array, own: Array) -> Array:
    """d_i over its deviation (N, size), of P (S, size, size) and Pe (S, size) of sets of repeats,
    whose contrasts have their own noise alone."""
    sets, of, e = noisy.sets, noisy.sets.of, noisy.readings.e
    precision = np.linalg.inv(sets.mean(own))[of]
    share = (1 / sets.root**2)[of, None, None]
    mean = (sets.e / sets.root[:, None])[of]
    inside = share * P[of] + (1 - share) * precision
    right = Pe[of] / sets.root[of, None] + (precision @ (e - mean)[..., None])[..., 0]
    # A direction that this reading alone determines has no deletion residual.
    values, vectors = np.linalg.eigh(inside)
    smallest = 1e-9 * np.linalg.eigvalsh(precision)[:, -1:]
    inverse = np.where(values > smallest, 1 / np.maximum(values, smallest), 0.0)
    spread = (vectors * inverse[:, None, :]) @ vectors.transpose(0, 2, 1)
    d = (spread @ right[..., None])[..., 0]
    deviation = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    return np.divide(d, deviation, out=np.zeros_like(d), where=deviation > 0)


# The default estimate: faulty readings set apart, noise model chosen, x by its weights.

FEWEST_GOOD = 0.5


class NoiseAndOutliers(NamedTuple):
    """The noise found from the `good` readings (N,); the noise does not explain the others."""

    noise: NoiseFit
    good: BoolArray


def settle(
    readings: Readings, kind: str = "auto", good: BoolArray | None = None,
    known: NoiseAndOutliers | None = None,
) -> NoiseAndOutliers:  # fmt: skip
    """Noise and good readings that agree with each other, starting from `good` (default all).

    The search begins with the noise that is `known`, and keeps the kind of noise that it begins
    with.

    The noise model is fitted to the good readings, every reading is judged by the error of its
    prediction from them (false-alarm rate 1 % for the whole table), and so on.  Starting from
    all, errors that hide each other may stay: start from a robust fit.  A set that comes back
    after others ends the search: readings that were good at any time of that round are kept.

    Faulty readings that are taken back bend the fit, so that more of them seem to fit.  Where the
    better half of all readings is left worse explained than by an earlier set, beyond what chance
    allows, that set stands.
    """
    good = np.ones(len(readings), dtype=bool) if good is None else good
    like = None if known is None else known.noise
    first = kind if like is None else like.kind
    try:
        noise = estimate_noise(readings.take(good), first, like)
    except ElastocalError:
        good = np.ones(len(readings), dtype=bool)  # the others alone do not show all parameters
        noise = estimate_noise(readings, first, like)
    own = np.asarray(np.linalg.inv(own_noise(noise.fit, readings)[0]), dtype=np.float64)
    visited = [(_misfit(noise, readings, own), good, noise)]
    for _ in range(ROUNDS):
        updated = ~unexplained_readings(noise, readings, good, FALSE_ALARM)
        if np.array_equal(updated, good) or updated.mean() < FEWEST_GOOD:
            break
        masks = [mask for _, mask, _ in visited]
        again = next((k for k, mask in enumerate(masks) if np.array_equal(mask, updated)), None)
        if again is not None:
            updated = np.logical_or.reduce(masks[again:])
        try:
            noise = estimate_noise(readings.take(updated), noise.kind, noise)
        except ElastocalError:
            break  # so few readings cannot judge the others
        good = updated
        visited.append((_misfit(noise, readings, own), good, noise))
        if again is not None:
            break
    last, best = visited[-1], min(visited, key=lambda v: v[0])
    half = (len(readings) // 2 + 1) * readings.size
    if last[0] > best[0] * special.fdtri(half, half, 1 - FALSE_ALARM):
        last = best
    _, good, noise = last
    return NoiseAndOutliers(noise, good)


def _misfit(noise: NoiseFit, readings: Readings, precision: Array) -> float:
    """Sum of the smaller half of the squared residuals, in units of `precision` (N, size, size)."""
    r = readings.e - readings.B @ noise.x
    squared = np.einsum("ni,nij,nj->n", r, precision, r)
    return float(np.sort(squared)[: len(squared) // 2 + 1].sum())
