"""Variances by restricted maximum likelihood: Newton and Fisher steps, variances kept ≥ 0."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.identification.variance.blocks import Stack, stacks
from elastocal.identification.variance.likelihood import Slope, State, evaluate, slope
from elastocal.identification.variance.shared import SharedEffect
from elastocal.identification.variance.structure import Structure

Array = NDArray[np.float64]

STEPS = 60
DECREMENT = 1e-18  # gain in ℓ that a step still promises: variances exact to about nine digits
VISIBLE = 1e-7  # gains below this drown in the rounding of ℓ, those of the score do not
SMALLEST = 1e-10  # of the start: a variance that falls below this (σ by 1e5) stays there
# A variance that goes to zero falls by e with every Newton step in its logarithm, and the gain with
# it.  Once no step promises more than this, one step takes it all the way.
LITTLE = 1e-3
TINY = 1e-100  # stands for the variance of perfect data: its square is still a number


@dataclass(frozen=True)
class LogPrior:
    """Gaussian prior on log θ of the structure's own variances: mean (K,), precision (K, K)."""

    mean: Array
    precision: Array

    @cached_property
    def log_constant(self) -> float:
        """log of the normalising constant."""
        log_det = float(np.linalg.slogdet(self.precision)[1])
        return 0.5 * log_det - 0.5 * len(self.mean) * float(np.log(2 * np.pi))

    def value(self, theta: Array) -> float:
        """log density at log θ."""
        d = np.log(theta) - self.mean
        return self.log_constant - 0.5 * float(d @ self.precision @ d)


@dataclass(frozen=True)
class Reml:
    """Variances θ (own ones first, then shared), state there, their covariance (K, K) of θ̂.

    `log_likelihood` is the restricted one, and with a prior the marginal one by Laplace's method.
    """

    structure: Structure
    shared: tuple[SharedEffect, ...]
    state: State
    slope: Slope
    covariance: Array
    log_likelihood: float
    converged: bool

    @property
    def own(self) -> Array:
        return self.state.theta[: len(self.structure.names)]

    @property
    def common(self) -> Array:
        return self.state.theta[len(self.structure.names) :]


def reml(
    structure: Structure,
    shared: tuple[SharedEffect, ...],
    prior: LogPrior | None = None,
    start: Array | None = None,
) -> Reml:
    """Maximise the restricted likelihood (times the prior of log θ, where there is one).

    Own variances are stepped in log θ, shared ones in θ, each with a bound (zero for shared ones,
    next to nothing for own ones): one that the likelihood pushes below it stays there.
    """
    stacked = stacks(structure, shared)
    own = len(structure.names)
    theta = usual_start(structure, shared) if start is None else start.copy()
    bound = np.zeros(len(theta))
    bound[:own] = SMALLEST * float(theta[:own].max())
    state = evaluate(structure, stacked, theta)
    at = slope(structure, state)
    if not at.told[own:].all():  # shared, and the parameters could explain all of it
        theta[own:] *= at.told[own:]
        state = evaluate(structure, stacked, theta)
        at = slope(structure, state)
    value, converged, last = _objective(state, prior, own), False, np.inf
    for _ in range(STEPS):
        score, step = _step(at, state.theta, prior, own, bound)
        gain = float(score @ step)
        if gain < DECREMENT or VISIBLE > gain >= last:
            converged = True
            break
        if gain < VISIBLE:
            state, last = evaluate(structure, stacked, _moved(state.theta, step, own, bound)), gain
        else:
            moved = _vanished(structure, stacked, state, value, gain, step, prior, own, bound)
            if moved is None:
                moved = _line_search(structure, stacked, state, value, step, prior, own, bound)
            if moved is None:
                converged = gain < 1e-4  # as good as rounding allows
                break
            state, value = moved
        at = slope(structure, state)
    _, H, chain = _working(at, state.theta, prior, own)
    covariance = np.zeros_like(H)
    kept = np.flatnonzero((state.theta > bound) & at.told)
    # A variance at its bound is taken for zero, not for uncertain (the convention of mixed-model
    # software): counting it widens intervals that are wide enough already.
    if kept.size:
        covariance[np.ix_(kept, kept)] = _inverse(H[np.ix_(kept, kept)])
    covariance = chain[:, None] * covariance * chain
    likelihood = state.log_likelihood
    if prior is not None:
        log_det = np.linalg.slogdet(H[:own, :own])[1]
        likelihood += prior.value(state.theta[:own]) + 0.5 * own * np.log(2 * np.pi) - 0.5 * log_det
    return Reml(structure, shared, state, at, covariance, likelihood, converged)


def _objective(state: State, prior: LogPrior | None, own: int) -> float:
    return state.log_likelihood + (0.0 if prior is None else prior.value(state.theta[:own]))


def _working(
    at: Slope, theta: Array, prior: LogPrior | None, own: int
) -> tuple[Array, Array, Array]:
    """Score and expected information in the stepping variables, and dθ/d(variable)."""
    chain = np.ones(len(theta))
    chain[:own] = theta[:own]
    score, H = chain * at.score, chain[:, None] * at.information * chain
    if prior is not None:
        score[:own] -= prior.precision @ (np.log(theta[:own]) - prior.mean)
        H[:own, :own] += prior.precision
    return score, H, chain


def _step(
    at: Slope, theta: Array, prior: LogPrior | None, own: int, bound: Array
) -> tuple[Array, Array]:
    """Score and step in the stepping variables.

    Newton's step where the objective is concave, else Fisher's.
    """
    score, expected, chain = _working(at, theta, prior, own)
    free = ((theta > bound) | (score > 0)) & at.told
    curvature = chain[:, None] * (at.observed - at.information) * chain
    curvature[np.arange(own), np.arange(own)] -= (chain * at.score)[:own]
    step = np.zeros(len(theta))
    if not free.any():
        return score, step
    inside = np.ix_(free, free)
    try:
        step[free] = _solve((expected + curvature)[inside], score[free])
    except np.linalg.LinAlgError:
        step[free] = _solve(expected[inside], score[free])
    return score, step


def _solve(H: Array, score: Array) -> Array:
    """H⁻¹ score.  Raises LinAlgError unless H is positive definite."""
    diagonal = np.diag(H)
    if diagonal.min() <= 0:
        raise np.linalg.LinAlgError
    scale = np.sqrt(diagonal)
    # A trace of ridge: variances that the data cannot separate share the step.
    factor = linalg.cho_factor(H / np.outer(scale, scale) + 1e-9 * np.eye(len(H)), lower=True)
    return np.asarray(linalg.cho_solve(factor, score / scale)) / scale


def _inverse(H: Array) -> Array:
    """Inverse of the information; the pseudo-inverse where variances cannot be told apart."""
    scale = np.sqrt(np.diag(H))
    scaled = H / np.outer(scale, scale)
    factor, failed = linalg.lapack.dpotrf(scaled, lower=True)
    if failed or np.diag(factor).min() < 1e-6:
        inverse = np.linalg.pinv(scaled, hermitian=True)
    else:
        inverse = linalg.cho_solve((factor, True), np.eye(len(H)))
    return np.asarray(inverse / np.outer(scale, scale))


def _moved(theta: Array, step: Array, own: int, bound: Array) -> Array:
    """θ after a step, own variances in their logarithm, none below its bound."""
    moved = theta + step
    moved[:own] = theta[:own] * np.exp(step[:own])
    return np.maximum(moved, bound)


def _vanished(
    structure: Structure,
    stacked: list[Stack],
    state: State,
    value: float,
    gain: float,
    step: Array,
    prior: LogPrior | None,
    own: int,
    bound: Array,
) -> tuple[State, float] | None:
    """The step that takes variances on their way to zero to their bound; None where there are
    none or that costs."""
    falling = np.zeros(len(step), dtype=bool)
    falling[:own] = np.abs(step[:own] + 1.0) < 0.1
    if gain > LITTLE or not falling.any():
        return None
    theta = _moved(state.theta, step, own, bound)
    theta[falling] = bound[falling]
    try:
        trial = evaluate(structure, stacked, theta)
    except np.linalg.LinAlgError:
        return None
    found = _objective(trial, prior, own)
    return (trial, found) if found > value else None


def _line_search(
    structure: Structure,
    stacked: list[Stack],
    state: State,
    value: float,
    step: Array,
    prior: LogPrior | None,
    own: int,
    bound: Array,
) -> tuple[State, float] | None:
    """The first of ever shorter steps that raises the objective; None where none does."""
    largest = float(np.abs(step[:own]).max(initial=0.0))
    length = min(1.0, 2.0 / largest) if largest > 0 else 1.0
    for _ in range(30):
        try:
            trial = evaluate(structure, stacked, _moved(state.theta, length * step, own, bound))
        except np.linalg.LinAlgError:
            length /= 2
            continue
        found = _objective(trial, prior, own)
        if found > value:
            return trial, found
        length /= 2
    return None


def usual_start(structure: Structure, shared: tuple[SharedEffect, ...]) -> Array:
    """Own variances from the scatter of repeats where there is any, else from all residuals."""
    cells = structure.cells
    size = cells.e.shape[1]
    # Variance of one reading that θ = 1 would give: 1, but for noise that is stated.
    unit = np.trace(structure.mean_matrix.sum(axis=1), axis1=1, axis2=2) * cells.repeats / size
    own = float(np.median((cells.e**2).mean(axis=1) * cells.repeats / unit))
    if cells.dof.sum() > 0:
        squares = float(np.trace(cells.scatter, axis1=1, axis2=2).sum())
        own = max(squares / (float(cells.dof.sum()) * size), 1e-9 * own)
    # Shared effects start above zero, from where they are free to go there.
    share = max(0.1 * float((cells.e**2).mean()), TINY)
    return np.concatenate(
        [np.full(len(structure.names), max(own, TINY)), np.full(len(shared), share)]
    )
