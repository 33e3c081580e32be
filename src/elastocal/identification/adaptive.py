"""The default method: noise estimated from the residuals, faulty readings judged by that noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.noise import Weights
from elastocal.identification.selection import Problem, fit_kept, held_at_bounds, heldout_of
from elastocal.identification.solve import Progress, Solution
from elastocal.identification.variance.choose import NoiseFit, estimate_noise
from elastocal.identification.variance.screen import screen
from elastocal.identification.variance.search import settle
from elastocal.identification.weighting import linearised, weights_of
from elastocal.manipulator.observation import subset

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROUNDS = 6
SETTLED = 0.01  # of a standard deviation: what relinearising may still move an estimate by


@dataclass(frozen=True)
class Adapted:
    """The fit to the `good` observations (N,) under the noise found from them."""

    solution: Solution
    noise: NoiseFit
    good: Mask


def adapt(
    whole: Solution, clean: Solution, kind: str, keep_all: bool, progress: Progress
) -> Adapted:
    """Fit with weights that the residuals tell, from a fit that faulty readings do not bend.

    `whole` holds all observations, `clean` the fit to those that agree.  At its values, readings
    are screened, noise model and faulty readings settled (variance.search) and the kept parameters
    fitted anew with the weights found, until neither changes.  `keep_all` sets nothing apart.
    """
    problem = whole.problem
    model, seen = problem.model, problem.observations
    kept = clean.reduction.kept
    solution, good = clean, np.ones(len(seen.lead), dtype=bool)
    readings = linearised(model, seen, clean.fit.x, kept)
    if not keep_all:
        good = screen(readings, readings.e)
    for _ in range(ROUNDS):
        before = good
        if keep_all:
            noise = estimate_noise(readings, kind)
        else:
            verdict = settle(readings, kind, good)
            noise, good = verdict.noise, verdict.good
        progress(f"fitting with the noise found ({noise.kind})")
        expected = solution.fit.x[kept] + noise.x
        weights = weights_of(noise, readings.take(good))
        solution = refined(whole, clean, good, weights)
        readings = linearised(model, seen, solution.fit.x, kept)
        moved = np.abs(solution.fit.x[kept] - expected) / noise.covariance.std
        if moved.max(initial=0.0) < SETTLED and np.array_equal(good, before):
            break
    chosen = solution.problem.observations
    inner = linearised(model, chosen, solution.fit.x, solution.reduction.kept)
    final = estimate_noise(inner, noise.kind)
    final = replace(final, trials=noise.trials, reason=noise.reason)
    return Adapted(solution, final, good)


def refined(whole: Solution, start: Solution, good: Mask, weights: Weights) -> Solution:
    """The kept parameters of `start` fitted to the good observations with other weights."""
    seen = whole.problem.observations
    chosen = seen if good.all() else subset(seen, good)
    problem: Problem = replace(start.problem, observations=chosen, weights=weights)
    found = fit_kept(problem, start.sizes, start.fit.x, start.reduction)
    reduction = start.reduction
    if problem.bounded:
        found, reduction = held_at_bounds(problem, start.sizes, found, reduction)
    return replace(
        start, problem=problem, fit=found, reduction=reduction, heldout=heldout_of(problem, found)
    )
