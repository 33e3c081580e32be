"""The default method: noise estimated from the residuals, faulty readings judged by that noise."""

from __future__ import annotations

from collections.abc import Callable
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
Refit = Callable[[Mask, bool], Solution]  # of these observations, with wider sets tried

ROUNDS = 6
RESTARTS = 3
SETTLED = 0.01  # of a standard deviation: what relinearising may still move an estimate by


@dataclass(frozen=True)
class Adapted:
    """The fit to the `good` observations (N,) under the noise found from them."""

    solution: Solution
    noise: NoiseFit
    good: Mask


def adapt(
    whole: Solution, clean: Solution, faulty: Mask, refit: Refit, kind: str, progress: Progress
) -> Adapted:
    """Fit with weights that the residuals tell, from a fit that faulty readings do not bend.

    `whole` holds all observations, `clean` the fit to those that are not `faulty` (N,) at equal or
    stated weights.  At its values readings are screened, noise model and faulty readings settled
    (variance.search) and the kept parameters fitted anew with the weights found, until neither
    changes.  Where other readings turn out good than `clean` was fitted to, its parameters are
    chosen again for these.
    """
    start, good = clean, ~faulty
    for _ in range(RESTARTS):
        found = _settled(whole, start, good, kind, progress)
        if np.array_equal(found.good, good):
            break
        good = found.good
        start = whole if good.all() else refit(good, True)
    return found


def adapt_all(whole: Solution, kind: str, progress: Progress) -> Adapted:
    """As `adapt`, with all observations, whatever they are."""
    return _settled(whole, whole, None, kind, progress)


def _settled(
    whole: Solution, start: Solution, good: Mask | None, kind: str, progress: Progress
) -> Adapted:
    problem, kept = whole.problem, start.reduction.kept
    model, seen = problem.model, problem.observations
    solution, every = start, np.ones(len(seen.lead), dtype=bool)
    readings = linearised(model, seen, start.fit.x, kept)
    now = every if good is None else screen(readings, readings.e, good)
    for _ in range(ROUNDS):
        before = now
        if good is None:
            noise = estimate_noise(readings, kind)
        else:
            verdict = settle(readings, kind, now)
            noise, now = verdict.noise, verdict.good
        progress(f"fitting with the noise found ({noise.kind})")
        expected = solution.fit.x[kept] + noise.x
        solution = refined(whole, start, solution.fit.x, now, weights_of(noise, readings.take(now)))
        readings = linearised(model, seen, solution.fit.x, kept)
        moved = np.abs(solution.fit.x[kept] - expected) / noise.covariance.std
        if moved.max(initial=0.0) < SETTLED and np.array_equal(now, before):
            break
    # One that ended at a bound is held there and no longer a column.
    fitted = readings.take(now).of_columns(np.isin(kept, solution.reduction.kept))
    final = estimate_noise(fitted, noise.kind, noise)
    final = replace(final, trials=noise.trials, reason=noise.reason)
    return Adapted(solution, final, now)


def refined(whole: Solution, start: Solution, x: Array, good: Mask, weights: Weights) -> Solution:
    """The kept parameters of `start` fitted from x to the good observations with other weights."""
    seen = whole.problem.observations
    chosen = seen if good.all() else subset(seen, good)
    problem: Problem = replace(start.problem, observations=chosen, weights=weights)
    found = fit_kept(problem, start.sizes, x, start.reduction)
    reduction = start.reduction
    if problem.bounded:
        found, reduction = held_at_bounds(problem, start.sizes, found, reduction)
    heldout = heldout_of(problem, found)
    return replace(start, problem=problem, fit=found, reduction=reduction, heldout=heldout)
