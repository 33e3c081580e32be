"""The methods: from a first fit to the final one, its noise, its intervals, what is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy import linalg, sparse, special

from elastocal.errors import InsufficientDataError, option, require
from elastocal.identification import published
from elastocal.identification.covariance import LEVEL, Covariance, t_quantile
from elastocal.identification.faulty_readings import report_faulty
from elastocal.identification.knowledge import Constraints, GaussianPrior
from elastocal.identification.least_squares import Fit, KnownFit, PriorRows, Problem, profile_end
from elastocal.identification.least_squares import fit as least_squares
from elastocal.identification.noise_choice import (
    NoiseFit,
    estimate_noise,
    linearised,
    over_times,
    weights_of,
)
from elastocal.identification.noise_structure import Kind, Readings, check_supported
from elastocal.identification.options import (
    ROBUST,
    FunctionPrior,
    MethodResult,
    Options,
    spread_of,
)
from elastocal.identification.outliers import robust_result, settle
from elastocal.identification.residuals import held_out_by_parts, held_out_residual, rms_3d
from elastocal.identification.smooth_fit import fit_smooth
from elastocal.identification.solve import (
    WORTH_A_COLUMN,
    Reduction,
    Solution,
    chosen_again,
    fit_kept,
    reduce,
    residual_sigma,
)
from elastocal.identification.weighted_problem import (
    RFactor,
    Weights,
    evaluate,
)
from elastocal.model.observations import subset
from elastocal.text import listed, quoted
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
    refit: Refit | None, noise: NoiseFit | None = None,
) -> Adapted:  # fmt: skip
    """Fit with weights that the residuals tell, from a fit that faulty readings do not bend.

    `every` holds all observations, `start` the fit to the `good` (N,) ones.  Noise and good
    readings are settled at its values and the kept parameters fitted anew with these weights, until
    neither changes.  Then what was chosen on the way is chosen again by what is there now:
    the parameters, if other readings are good or the weights show more, and the kind of noise,
    unless one is given.  More parameters that do not settle are none: the fit without them stays.
    Without `refit` no reading is judged.
    """
    asked = "auto" if kind == OF_READINGS else kind
    problem, solution, now, fitted = every.problem, start, good, good
    readings = _linearised(problem, start.fit.x, start.reduction.kept, kind)
    check_supported(asked, readings)
    sure, restarts, fewer = False, 0, None
    for left in reversed(range(ROUNDS)):
        before, kept, first = now, start.reduction.kept, noise is None
        if refit is None:
            noise = estimate_noise(readings, asked, noise)
        else:
            noise, now = settle(readings, asked, now, noise)
        progress(f"fitting with the noise found ({noise.kind})")
        expected = solution.fit.x[kept] + noise.x
        solution = refined(every, start, solution.fit.x, now, weights_of(noise, readings.take(now)))
        readings = _linearised(problem, solution.fit.x, kept, kind)
        moved = np.abs(solution.fit.x[kept] - expected) / noise.covariance.std
        same = np.array_equal(now, before)
        # What relinearising moves by more may have looked like some noise.
        sure = sure or (first and same and moved.max(initial=0.0) < LINEAR)
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
            fewer = None if others else (solution, noise, now, readings)
            start, sure = replace(start, reduction=more), False
            readings = _linearised(problem, solution.fit.x, more.kept, kind)
            continue
        settled, chosen = noise.kind, sure
        if not sure:
            noise, sure = estimate_noise(readings.take(now), asked), True
        if chosen or noise.kind == settled:
            break
    else:
        if fewer is not None:
            solution, noise, now, readings = fewer
    assert noise is not None
    final = readings.take(now)
    return solution, over_times(estimate_noise(final, like=noise), final), now


def _linearised(problem: Problem, x: Array, kept: IntArray, kind: str) -> Readings:
    readings = linearised(problem.model, problem.observations, x, kept)
    return replace(readings, visits=None) if kind == OF_READINGS else readings


def refined(
    every: Solution, start: Solution, x: Array, good: BoolArray, weights: Weights
) -> Solution:
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
    explained = partial(_explained, every, sound, None, ~faulty)
    drop = options.sets_aside(faulty, explained) and (
        method in ("wls", "reml") or options.faulty == "drop"
    )
    solution, good = (sound if drop else every), ~faulty
    if method in ("eq14", "eq14-residual"):
        return _published(method, every, solution, good, options, progress)
    kind = "ols" if solution.problem.weights.kind == "none" else "wls"
    spread = spread_of(solution, options.intervals, None)
    return MethodResult(
        kind, solution, spread, None, good, warnings=(COMPUTED,) if exact else ()
    )  # fmt: skip


# Parameters that the readings hardly show.
#
# A compliance or a backlash has a sign, and one whose 95 % interval reaches beyond its physical
# bound is told from nothing.  Its estimate is mostly noise, and worse than what was known before:
# where the interval has room for the nominal value, that stands in its place; else the estimate,
# or the bound where it lies beyond.  What the readings say of it is the interval.


def hardly_shown(found: MethodResult) -> dict[int, tuple[float, float]]:
    """The 95 % intervals, by parameter, of those fitted that reach beyond a physical bound and
    stand alone."""
    solution, reach = found.solution, {}
    std, ends = found.spread.std, found.ci95
    for k, c in enumerate(solution.reduction.kept.tolist()):
        p = solution.problem.model.parameters[c]
        _, (low, high) = solution.reduction.widened(
            k, solution.sizes, std[k], float(solution.fit.x[c]), ends[k]
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
        noise = over_times(estimate_noise(readings, like=noise), readings)
    spread = spread_of(solution, options.intervals, noise)
    return replace(found, solution=solution, spread=spread, noise=noise)


def is_exact(solution: Solution) -> bool:
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
        start: Solution, good: BoolArray, kind: str, known: NoiseFit | None = None
    ) -> Adapted:
        solution, noise, good = _adapted(every, start, good, kind, progress, refit, known)
        explained = partial(_explained, every, solution, noise, good)
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
        agreed = sound if np.array_equal(good, ~faulty) else every if good.all() else refit(good)
        plain = found(agreed, good, OF_READINGS, noise.of_readings())
        if _held_out_rms(solution, solution) > WORSE * _held_out_rms(plain[0], solution):
            tests = noise.tests
            solution, noise, good = plain
            noise = replace(noise, tests=tests)  # which say what is not counted
    spread = spread_of(solution, options.intervals, noise)
    return MethodResult("reml", solution, spread, noise, good)


def _explained(
    every: Solution, fitted: Solution, noise: NoiseFit | None, good: BoolArray
) -> BoolArray:
    """Readings (N,) that are not `good`, of groups which one common shift each explains."""
    report = report_faulty(every, fitted, noise, good)
    known = [] if report is None else [f.readings for f in report.shifted]
    return ~good & np.isin(np.arange(len(good)), np.concatenate([[], *known]))


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
        own = spread_of(solution, options.intervals, None)
        return MethodResult(method, solution, own, None, good)
    covariance = Covariance(
        "eq13", last.covariance * np.outer(size, size), np.full(len(size), np.inf),
        "as published, eq. (13) with the σ of eq. (14): not corrected for estimated weights",
    )  # fmt: skip
    return MethodResult(method, solution, covariance, None, good)


# The fit of a method again, under constraints and with a prior.

# Which parameters a fit with constraints and a prior has.


def fitted_columns(
    solution: Solution, constraints: Constraints, prior: GaussianPrior | None, sigma: float
) -> IntArray:
    """Indices of the parameters to fit under the constraints and the prior, ascending.

    These are the kept parameters of the solution; the free ones that the prior or an equality
    names, for that is knowledge of themselves; and what else the choice of the kept parameters
    finds worth a column with the prior and the equalities as further rows: with a prior on k,
    readings of k + d are knowledge of d.  Bounds and matrices make nothing known: they act on the
    fitted parameters, with all others held where the fit held them.

    Raises InputError for a name that is no parameter, or a prior on a parameter that is held fixed;
    InsufficientDataError where an equality names a parameter that stays undetermined.
    """
    problem, kept, model = solution.problem, solution.reduction.kept, solution.problem.model
    names, free, A = model.names, problem.free, constraints.resolve(model.names).A
    P = np.zeros((0, len(names))) if prior is None else sigma * prior.rows(names)[0]
    known, tied = (np.flatnonzero(rows.any(axis=0)) for rows in (P, A))
    fixed = [quoted(names[c]) for c in np.setdiff1d(known, free)]
    require(
        not fixed,
        f"a prior is stated for {listed(fixed)}, which is held fixed; drop the prior or the fixing",
    )
    named = np.intersect1d(np.union1d(known, tied), free)
    R = evaluate(problem.model, problem.parts, solution.fit.x, free).r_factor.R
    # An equality is exact: it counts as much as the most that anything else tells.
    A = A[:, free][A[:, free].any(axis=1)]
    most = np.linalg.norm(np.vstack([R, P[:, free]]) * solution.sizes[free], axis=0).max()
    A = A * most / np.linalg.norm(A * solution.sizes[free], axis=1)[:, None]
    rank = np.where(np.isin(free, kept), 0, np.where(np.isin(free, named), 1, 2))
    rows = np.vstack([R, P[:, free], A])
    told = free[reduce(rows, solution.sizes[free], (), sigma, WORTH_A_COLUMN, rank).kept]
    unknown = [quoted(names[c]) for c in np.setdiff1d(np.intersect1d(tied, named), [*told, *known])]
    if unknown:
        raise InsufficientDataError(
            f"readings, prior and equalities do not determine {listed(unknown)}, which an equality "
            f"names; hold it ({option('fixed')}) or state a prior for it, or drop the equality"
        )
    return np.unique(np.concatenate([kept, named, told]))


# Intervals of a fit under constraints or with a prior.
#
# At a bound the estimate is not normal and the likelihood ratio not χ²: where the truth lies on one
# bound, it is the mixture ½χ²₀ + ½χ²₁ (Chernoff 1954; Self and Liang 1987), whose 95 % point is
# 2.71.  The intervals here keep the quantile of an interior truth, 3.84.  Away from bounds they are
# exact for a linear model with normal noise of known size; at and near one bound they are
# conservative (97.5 % for 95 %).  With the truth on two bounds at once the mixture depends on the
# angle α > 90° between the two whitened columns of B: they then hold 97.5 % − 14.65 % (α −
# 90°)/360°, which is 95 % at 150° and 93.8 % in the limit of 180°, two columns that nearly cancel.

ONE_SIDED = "one-sided at a bound, and wide rather than narrow near one"


def intervals_with_knowledge(
    found: KnownFit, of_readings: Array, kind: str, many: set[str]
) -> Covariance:
    """95 % intervals of the constrained fit's columns, and their covariance.

    auto: t intervals of the posterior covariance, cut off at bounds, where no inequality is
    active; else the profile {v: S(v) − Ŝ ≤ t² σ²} of the linearised model under the constraints,
    S(v) the least objective with the parameter at v.  profile: that of the nonlinear one.

    The covariance takes equalities for exact and leaves inequalities out: knowing more than it
    says, no estimate is farther off.  `of_readings` (columns,) are the method's degrees of freedom.
    Parameters that are `many`, those of smooth functions, have t intervals in any case.
    """
    known, x, matrix = found.known, found.fit.x[found.fit.columns], found.covariance
    assert known.system is not None
    # A posterior variance V moves with the noise's variance s² by the readings' share of it,
    # d log V = (1 − share) d log s²: by Satterthwaite it has dof/(1 − share)² where s² has dof.
    left = 1 - np.nan_to_num(found.prior_share, nan=1.0)
    full = np.full(len(left), np.inf)
    dof = np.divide(of_readings, left**2, out=full, where=left > 1e-6)
    inside = not any(a.kind != "equality" for a in found.best.active)
    plain = Covariance("t", matrix, dof, "").interval(x, LEVEL)
    if kind == "auto" and inside:
        name, text = ("t under constraints", "equalities taken for exact, bounds cut off")
        if len(known.P):
            name, text = ("posterior", "readings and prior together, the prior taken at its word")
        lower, upper = known.system.lower[:, None], known.system.upper[:, None]
        plain = np.clip(plain, lower, upper)
        return Covariance(name, matrix, dof, f"{text}; assumes normal noise", ends=plain)
    ends = np.repeat(x[:, None], 2, axis=1)
    of_functions = np.array([name in many for name in found.names])
    ends[of_functions] = plain[of_functions]
    # Prior and noise are widened alike, by t for the normal quantile, so that their ratio stays.
    rises = (found.sigma * t_quantile(LEVEL, np.maximum(dof, 1.0))) ** 2
    for k, name in enumerate(found.names):
        for end, side in enumerate((-1, 1)) if name not in many else ():
            rise = float(rises[k])
            if kind == "profile":
                ends[k, end] = profile_end(found, k, rise, side)
            else:
                ends[k, end] += found.reduced.farthest(k, found.best, rise, side)[k]
    model = "nonlinear" if kind == "profile" else "linearised"
    text = f"profile of the {model} fit under the constraints, {ONE_SIDED}; assumes normal noise"
    return Covariance("constrained profile", matrix, dof, text, ends=ends)


# The fit of a method, its knowledge added: one more step on the weights that the method ends with.

ROUNDING = 1e-9  # factors below this share of a typical size are no combination
CONTRADICTED = 0.001  # false-alarm rate of a sentence that doubts what the user knows


def joined(stated: GaussianPrior | None, own: GaussianPrior | None) -> GaussianPrior | None:
    """Both priors; of a parameter that both name, the stated one."""
    if stated is None or own is None:
        return own if stated is None else stated
    rest = [k for k, name in enumerate(own.names) if name not in set(stated.names)]
    return GaussianPrior(
        (*stated.names, *(own.names[k] for k in rest)),
        np.concatenate([stated.mean, own.mean[rest]]),
        linalg.block_diag(stated.covariance, own.covariance[np.ix_(rest, rest)]),
    )


def fit_with_knowledge(
    before: MethodResult, options: Options, progress: Progress, own: FunctionPrior | None = None
) -> MethodResult:
    """Minimise |W (y − h(X))|² + σ² (X − m)ᵀ C⁻¹ (X − m) under `options.constraints`.

    W and the readings are those that the method ended with `before`, σ the noise of a whitened row
    under it.  `fitted_columns` says what is fitted, `intervals_with_knowledge` what the intervals
    are; t intervals have the method's own degrees of freedom.  `own` is the prior of smooth
    functions, which joins the stated one.

    Raises InputError for constraints that contradict each other or held values and names that are
    no parameters; InsufficientDataError where an equality names a parameter that readings, prior
    and equalities do not determine.
    """
    solution = before.solution
    problem, fit = solution.problem, solution.fit
    if own is not None:
        problem = replace(problem, free=np.union1d(problem.free, fit.columns))
        solution = replace(solution, problem=problem)
    constraints = options.constraints or Constraints()
    prior = joined(options.prior, None if own is None else own.prior)
    sigma = residual_sigma(fit, len(fit.columns)) if own is None else own.sigma
    columns = fitted_columns(solution, constraints, prior, sigma)
    stated = PriorRows.stated(problem.model.names, columns, fit.x, constraints, prior, sigma)
    progress("fitting under constraints" if prior is None else "fitting with the prior")
    found = KnownFit(
        least_squares(problem, columns, fit.x, solution.sizes, known=stated), stated, sigma
    )
    progress("intervals under constraints" if prior is None else "intervals with the prior")
    told = dict(zip(fit.columns.tolist(), before.spread.dof.tolist(), strict=True))
    spare = own.dof if own else min(told.values())
    dof = np.array([spare if own else told.get(c, spare) for c in columns.tolist()])
    many = set() if own is None else set(own.prior.names)
    spread = intervals_with_knowledge(found, dof, options.intervals, many)
    # Of smooth functions' parameters, which are many, nobody asks.
    shares = {} if prior is None else {
        name: float(share)
        for c, name, share in zip(columns, found.names, found.prior_share, strict=True)
        if np.isfinite(share) and not problem.model.shrunk[c]
    }  # fmt: skip
    fitted = _as_fit(found)
    # Linearised, with the active constraints kept active: directions of the face are orthonormal by
    # the rows of readings and prior together.
    heldout, leverage = held_out_by_parts(
        problem.model, problem.parts, found.fit.x, columns, found.face
    )
    known = replace(solution, fit=fitted, reduction=_reduction(solution, found), held=heldout)
    doubts = _contradiction(solution, before.spread, found, own)
    return replace(
        before, method="constrained", solution=known, spread=spread,
        active=found.best.active, prior_share=shares, effective=round(found.effective),
        leverage=leverage, warnings=(*before.warnings, *doubts),
        smooth=tuple(part.refitted(fitted.x, columns, spread.matrix) for part in before.smooth),
    )  # fmt: skip


def _contradiction(
    solution: Solution, before: Covariance, found: KnownFit, own: FunctionPrior | None
) -> tuple[str, ...]:
    """A sentence where the objective grew by more than noise explains (F-test).

    Rows of the prior and active constraints count as degrees of freedom, less the parameters they
    made estimable.  At active bounds the true distribution is smaller (χ̄²): the test is cautious.
    """
    rows = len(found.known.P) - (0 if own is None else len(own.prior.names))
    stated = rows + len(found.best.active) - (len(found.names) - len(solution.fit.columns))
    if stated < 1:
        return ()
    grown = found.objective - float(solution.fit.whitened @ solution.fit.whitened)
    dof = max(float(before.dof.min()), 1.0)
    if own is not None:
        grown, dof = grown - own.stands, own.dof
    F = max(grown, 0.0) / (stated * found.sigma**2)
    known = np.isinf(dof)
    p = float(special.chdtrc(stated, F * stated) if known else special.fdtrc(stated, dof, F))
    if p > CONTRADICTED:
        return ()
    what = [f"'{a.label}'" for a in found.best.active]
    what += ["the prior"] if rows else []
    return (
        f"The readings contradict {listed(what, 6)}: without, they are fitted better than noise "
        f"explains (F = {F:.1f} on {stated} and {dof:.0f} degrees of freedom, p = {p:.1g}). Check "
        "names, units and signs of what is stated, and whether the model lacks an effect.",
    )


def _as_fit(found: KnownFit) -> Fit:
    """As the fit of a method; its R factor has prior and equalities as further rows.

    Without them a parameter that no reading shows would leave it singular; equalities weigh as
    much as the readings of a parameter do.
    """
    reduced = found.reduced
    A = reduced.system.A * reduced.unit
    equalities = A / np.linalg.norm(A, axis=1)[:, None] / reduced.unit
    rows = np.vstack([reduced.J, equalities])
    return replace(found.fit, r_factor=RFactor.of(rows, np.append(reduced.t, np.zeros(len(A)))))


def _reduction(solution: Solution, found: KnownFit) -> Reduction:
    """What is fitted, what is held, and how a held parameter's error would move the estimates.

    A parameter that an active constraint holds back does not move: it stands for itself.
    """
    before, problem = solution.reduction, solution.problem
    columns, k = found.fit.columns, len(found.fit.columns)
    dropped = np.setdiff1d(before.dropped, columns)
    both = np.concatenate([columns, dropped])
    R = evaluate(problem.model, problem.parts, found.fit.x, both).r_factor.R
    mixing = found.on_face @ (R[:, :k].T @ R[:, k:])
    share = np.abs(mixing) * solution.sizes[dropped] / solution.sizes[columns][:, None]
    mixing[share < ROUNDING] = 0.0
    return Reduction(columns, dropped, mixing, np.setdiff1d(before.invisible, columns))
