"""Readings that the others contradict: each judged as if left out of the fit to the majority."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, special

from elastocal.errors import ElastocalError
from elastocal.identification.residuals import f_test
from elastocal.identification.solve import PLACED, SAMPLE, Problem, Solution, is_placed
from elastocal.identification.trimmed import majority, median_scale
from elastocal.identification.weighted_problem import (
    Part,
    each,
    regressor,
    residual_at,
    sample,
)
from elastocal.model.manipulator import Model
from elastocal.units import Array, BoolArray

FALSE_ALARM = 0.01  # chance that a clean table yields any faulty reading at all


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
