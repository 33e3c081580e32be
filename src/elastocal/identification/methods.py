"""The methods: from a first fit to the final one, its noise and its intervals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import sparse

from elastocal.identification import published
from elastocal.identification.covariance import Covariance
from elastocal.identification.faulty_readings import report_faulty
from elastocal.identification.knowledge_fit import fit_with_knowledge
from elastocal.identification.least_squares import Problem
from elastocal.identification.noise_choice import (
    NoiseFit,
    estimate_noise,
    linearised,
    over_times,
    weights_of,
)
from elastocal.identification.noise_structure import Kind, Readings, check_supported
from elastocal.identification.options import (
    LEVEL,
    ROBUST,
    Intervals,
    MethodResult,
    Options,
    intervals_of,
)
from elastocal.identification.outliers import NoiseAndOutliers, settle
from elastocal.identification.residuals import held_out_residual, rms_3d
from elastocal.identification.robust import robust_result
from elastocal.identification.smooth_fit import fit_smooth
from elastocal.identification.solve import Solution, chosen_again, fit_kept
from elastocal.identification.weighted_problem import Weights
from elastocal.model.observations import subset
from elastocal.units import Array, BoolArray, IntArray, Progress

# The default method: noise estimated from the residuals, faulty readings judged by that noise.

Refit = Callable[[BoolArray], Solution]  # of these observations

ROUNDS, RESTARTS = 14, 2
# Of a standard deviation: what relinearising may still move an estimate by at the end, and where
# the kind of noise is chosen.
SETTLED, LINEAR = 0.01, 1.0

# A fit to the good observations (N,), the noise found from them, and which they are.
Adapted = tuple[Solution, NoiseFit, BoolArray]

FIRST = ("independent", "stated")  # noise whose weights are those of the first fit
OF_READINGS = "auto, of readings"  # the best noise model but those that know the arm's visits


def _adapted(
    every: Solution, start: Solution, good: BoolArray, kind: str, progress: Progress,
    refit: Refit | None, known: NoiseAndOutliers | None = None,
) -> Adapted:  # fmt: skip
    """Fit with weights that the residuals tell, from a fit that faulty readings do not bend.

    `every` holds all observations, `start` the fit to the `good` (N,) ones.  Noise and good
    readings are settled at its values and the kept parameters fitted anew with these weights, until
    neither changes.  Then what was chosen on the way is chosen again by what is there now:
    the parameters, if other readings are good or the weights show more, and the kind of noise,
    unless it is `known`.  Without `refit` no reading is judged.
    """
    asked = "auto" if kind == OF_READINGS else kind
    problem, solution, now, fitted = every.problem, start, good, good
    readings = _linearised(problem, start.fit.x, start.reduction.kept, kind)
    check_supported(asked, readings)
    sure, restarts = False, 0
    for left in reversed(range(ROUNDS)):
        before, kept = now, start.reduction.kept
        like = None if known is None else known.noise
        name = asked if like is None else like.kind
        if refit is None:
            noise = estimate_noise(readings, name, like)
        else:
            noise, now = settle(readings, name, now, known)
        progress(f"fitting with the noise found ({noise.kind})")
        expected = solution.fit.x[kept] + noise.x
        solution = refined(every, start, solution.fit.x, now, weights_of(noise, readings.take(now)))
        readings = _linearised(problem, solution.fit.x, kept, kind)
        moved = np.abs(solution.fit.x[kept] - expected) / noise.covariance.std
        same = np.array_equal(now, before)
        # What relinearising moves by more may have looked like some noise.
        sure = sure or (known is None and same and moved.max(initial=0.0) < LINEAR)
        known = NoiseAndOutliers(noise, now)
        if moved.max(initial=0.0) >= SETTLED or not same:
            continue
        others = refit is not None and restarts < RESTARTS and not np.array_equal(now, fitted)
        if others and refit is not None:
            start, fitted, restarts = every if now.all() else refit(now), now, restarts + 1
            solution, more = start, start.reduction
        else:
            # Weights that make light of what is noisy may show more than those of the first fit.
            heavy = noise.kind not in FIRST and left > 0
            more = chosen_again(solution) if heavy else start.reduction
        if others or len(more.kept) > len(kept):
            start, sure = replace(start, reduction=more), False
            readings = _linearised(problem, solution.fit.x, more.kept, kind)
            continue
        if sure:
            break
        again, sure = estimate_noise(readings.take(now), asked), True
        known = NoiseAndOutliers(again, now)
        if again.kind == noise.kind:
            noise = again
            break
    final = readings.take(now)
    return solution, over_times(estimate_noise(final, noise.kind, noise), final), now


def _linearised(problem: Problem, x: Array, kept: IntArray, kind: str) -> Readings:
    readings = linearised(problem.model, problem.observations, x, kept)
    return replace(readings, visits=None) if kind == OF_READINGS else readings


def refined(
    every: Solution, start: Solution, x: Array, good: BoolArray, weights: Weights
) -> Solution:
    """The kept parameters of `start` fitted from x to the good observations with other weights."""
    observed = every.problem.observations
    chosen = observed if good.all() else subset(observed, good)
    problem: Problem = replace(start.problem, observations=chosen, weights=weights)
    found = fit_kept(problem, start.sizes, x, start.reduction)
    return replace(start, problem=problem, fit=found)


# The methods by name.

# Residuals below this, in m, are rounding: no instrument resolves it, and it tells of no noise.
EXACT = 1e-11
COMPUTED = (
    "The readings agree with the model to rounding: they are computed, not measured, and tell "
    "nothing of the noise."
)


def run_method(
    every: Solution, sound: Solution, faulty: BoolArray, free: IntArray, refit: Refit,
    options: Options, progress: Progress,
) -> MethodResult:  # fmt: skip
    """Carry out `options.method` from the fit to all observations and that to the good ones.

    `sound` is the fit to the observations that are not `faulty` (N,), `refit` makes another such;
    they know nothing of smooth functions among the parameters `free`.  Constraints and prior come
    last, on the weights and the readings that the method ends with.
    """
    own = None
    if every.problem.model.shrunk[free].any():
        found, own = fit_smooth(every, sound, faulty, free, options, progress)
    elif options.knows:
        alone = replace(options, constraints=None, prior=None, intervals="auto")
        found = _by_method(every, sound, faulty, refit, alone, progress)
    else:
        found = _by_method(every, sound, faulty, refit, options, progress)
        return with_limits(every, found, options)
    return fit_with_knowledge(found, options, progress, own) if options.knows else found


def _by_method(
    every: Solution, sound: Solution, faulty: BoolArray, refit: Refit, options: Options,
    progress: Progress,
) -> MethodResult:  # fmt: skip
    method, exact = options.resolved, is_exact(sound)
    if method == "reml" and not every.problem.large and not exact:
        return _reml(every, sound, faulty, refit, options, progress)
    if method in ROBUST:
        return robust_result(method, every, sound, ~faulty, options.intervals)
    # As published, every reading counts; and at equal weights noisy readings look faulty.
    drop = options.sets_aside(faulty) and (method in ("wls", "reml") or options.faulty == "drop")
    solution, good = (sound if drop else every), ~faulty
    if method in ("eq14", "eq14-residual"):
        return _published(method, every, solution, good, options, progress)
    kind = "ols" if solution.problem.weights.kind == "none" else "wls"
    intervals = intervals_of(solution, options.intervals, None)
    warnings = (COMPUTED,) if exact else ()
    return MethodResult(kind, solution, intervals, None, good, warnings=warnings)


# Parameters that the readings hardly show.
#
# A compliance or a backlash has a sign, and one whose 95 % interval reaches beyond its physical
# bound is told from nothing.  Its estimate is mostly noise, and worse than what was known before:
# where the interval has room for the nominal value, that stands in its place; else the estimate,
# or the bound where it lies beyond.  What the readings say of it is the interval.


def hardly_shown(found: MethodResult) -> dict[int, tuple[float, float]]:
    """The 95 % intervals, by parameter, of those fitted that reach beyond a physical bound and
    stand alone."""
    solution, intervals = found.solution, found.intervals
    std, reach = intervals.covariance.std, {}
    for k, c in enumerate(solution.reduction.kept.tolist()):
        p = solution.problem.model.parameters[c]
        _, (low, high) = solution.reduction.widened(
            k, solution.sizes, std[k], float(solution.fit.x[c]), intervals.ci95[k]
        )
        beyond = low <= p.lower < np.inf or -np.inf < p.upper <= high
        if beyond and not p.shrunk and not solution.reduction.terms(k, solution.sizes, std[k]):
            reach[c] = (low, high)
    return reach


def with_limits(every: Solution, found: MethodResult, options: Options) -> MethodResult:
    """The result with the parameters that the readings hardly show held, and the others fitted
    anew with the weights and the kind of noise found.

    One that lies beyond its bound by more than its interval contradicts the model and stays
    fitted: whoever reads it has to see that.  Of methods other than generalised and ordinary least
    squares all stay fitted; where bounds or knowledge were given, these say what the readings do
    not, and nothing is held.
    """
    fitted = found.method in ("reml", "wls", "ols")
    limits: dict[int, tuple[float, float]] = {}
    while True:
        limits = hardly_shown(found) | limits  # held ones keep what was found of them
        held = _held(found, limits) if fitted else {}
        again = _holding(every, found, held, options) if held else None
        if again is None:
            return replace(found, limits=limits)
        found = again


def _held(found: MethodResult, limits: dict[int, tuple[float, float]]) -> dict[int, float]:
    """The fitted parameters to be held, and where."""
    held, fit = {}, found.solution.fit
    for c in set(limits) & set(fit.columns.tolist()):
        p, (low, high), x = found.solution.problem.model.parameters[c], limits[c], float(fit.x[c])
        if p.nominal != 0 and low <= p.nominal <= high:
            held[c] = p.nominal
        elif not p.lower <= x <= p.upper and low < p.upper and p.lower < high:
            held[c] = min(max(x, p.lower), p.upper)
    return held


def _holding(
    every: Solution, found: MethodResult, held: dict[int, float], options: Options
) -> MethodResult | None:
    """The result of a fit that holds some of its parameters; None where there is none."""
    solution, noise = found.solution, found.noise
    x0, lost = solution.problem.x0.copy(), np.isin(solution.reduction.kept, list(held))
    if lost.all():
        return None
    x0[list(held)] = list(held.values())
    reduction = solution.reduction.without(lost)
    problem = replace(solution.problem, x0=x0)
    fit = fit_kept(problem, solution.sizes, solution.fit.x, reduction)
    if not fit.converged:
        return None
    solution = replace(solution, problem=problem, fit=fit, reduction=reduction)
    if noise is not None:
        observed = every.problem.observations
        readings = linearised(problem.model, observed, fit.x, reduction.kept)
        if len(problem.observations.lead) < len(found.good):
            readings = readings.take(found.good)
        noise = over_times(estimate_noise(readings, noise.kind, noise), readings)
    intervals = intervals_of(solution, options.intervals, noise)
    return replace(found, solution=solution, intervals=intervals, noise=noise)


def is_exact(solution: Solution) -> bool:
    """Are these residuals mere rounding?"""
    return rms_3d(solution.fit.residual, solution.problem.observations.size) < EXACT


def _reml(
    every: Solution,
    sound: Solution,
    faulty: BoolArray,
    refit: Refit,
    options: Options,
    progress: Progress,
) -> MethodResult:
    def found(
        start: Solution, good: BoolArray, kind: str, known: NoiseAndOutliers | None = None
    ) -> Adapted:
        solution, noise, good = _adapted(every, start, good, kind, progress, refit, known)

        def explained() -> BoolArray:
            report = report_faulty(every, solution, noise, good)
            known = [] if report is None else [f.readings for f in report.shifted]
            return ~good & np.isin(np.arange(len(good)), np.concatenate([[], *known]))

        if not good.all() and not options.sets_aside(~good, explained):
            # So many faulty readings look like anything that scatters or drifts.
            plainly, everything = OF_READINGS if kind == "auto" else kind, np.ones_like(good)
            solution, noise, _ = _adapted(every, every, everything, plainly, progress, None)
        return solution, noise, good

    solution, noise, good = found(sound, ~faulty, options.noise)
    if options.noise == "auto" and Kind.of(noise.kind).by_visit:
        # What the model lacks looks like scatter of the joints as well.  That is no noise: weights
        # which make light of it let the fit go where poses left out are predicted worse.
        progress("comparing with noise of the readings alone")
        known = NoiseAndOutliers(noise.of_readings(), good)
        agreed = sound if np.array_equal(good, ~faulty) else every if good.all() else refit(good)
        plain = found(agreed, good, OF_READINGS, known)
        if _held_out_rms(solution, solution) > WORSE * _held_out_rms(plain[0], solution):
            tests = noise.tests
            solution, noise, good = plain
            noise = replace(noise, tests=tests)  # which say what is not counted
    intervals = intervals_of(solution, options.intervals, noise)
    return MethodResult("reml", solution, intervals, noise, good)


WORSE = 1.02  # held-out errors that differ by less are alike


def _held_out_rms(solution: Solution, judge: Solution) -> float:
    """Root mean square length in m of what poses left out are off by: those which the noise of
    `judge` takes for one, configurations or blocks in time."""
    judged, together = judge.problem.observations, judge.problem.weights.together
    held = solution.heldout
    if together is not None:
        block = dict(zip(judged.configuration.tolist(), together.tolist(), strict=True))
        observed, weights = solution.problem.observations, solution.problem.weights
        left_out = np.array([block.get(c, -1) for c in observed.configuration.tolist()])
        if weights.together is not None:
            weights = replace(weights, together=left_out)
        fit = solution.fit
        held = held_out_residual(fit.B, fit.residual, weights, left_out, observed.size)
    known = held[np.isfinite(held)]
    return float(np.sqrt(np.mean(known**2)))


def _published(
    method: str,
    every: Solution,
    start: Solution,
    good: BoolArray,
    options: Options,
    progress: Progress,
) -> MethodResult:
    """Eq. (14) on the linearised model, and a fit of the exact one with the weights it ends at."""
    progress("iterating the weights of eq. (14)")
    observed, fit = start.problem.observations, start.fit
    group = None
    if method == "eq14":
        key = observed.configuration[:, None] * observed.size + np.arange(observed.size)
        group = np.unique(key.ravel(), return_inverse=True)[1].ravel()
    size = start.sizes[fit.columns]
    last = published.eq14(fit.B * size, fit.residual, group)[-1]
    text = "weights of eq. (14), σ " + ("by group" if group is not None else "of each residual")
    weights = Weights(method, sparse.csr_array(sparse.diags_array(last.weights)), False, text)
    fitted = good if len(observed.lead) < len(good) else np.ones_like(good)
    solution = refined(every, start, start.fit.x, fitted, weights)
    if options.intervals != "auto":
        own = intervals_of(solution, options.intervals, None)
        return MethodResult(method, solution, own, None, good)
    covariance = Covariance(
        "eq13", last.covariance * np.outer(size, size), np.full(len(size), np.inf),
        "as published, eq. (13) with the σ of eq. (14): not corrected for estimated weights",
    )  # fmt: skip
    x = solution.fit.x[fit.columns]
    return MethodResult(
        method, solution, Intervals(covariance, covariance.interval(x, LEVEL)), None, good
    )
