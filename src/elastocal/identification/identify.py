"""From a model and a table to calibrated parameters: the whole identification, step by step.

First the course and its result, then the methods: noise estimated from the residuals, equal or
stated weights, the published ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from scipy import sparse

from elastocal.identification.faulty_readings import FaultyGroup, OutlierReport, report_faulty
from elastocal.identification.findings import KNOWN_NOISE, judged, warning_sentences
from elastocal.identification.knowledge import Constraints
from elastocal.identification.least_squares import (
    Covariance,
    Rows,
    clustered,
    drawn_by_each,
    held_out_residual,
    rms_3d,
    told_by_one,
    variance_of,
)
from elastocal.identification.mistakes import likely_mistake, refuse_nonsense
from elastocal.identification.noise_choice import (
    NoiseFit,
    estimate_noise,
    linearised,
    not_knowing_times,
    weights_of,
)
from elastocal.identification.noise_structure import Kind, Readings
from elastocal.identification.noise_summary import noise_of, summarise_residuals
from elastocal.identification.outliers import (
    FEW,
    describe,
    drops,
    find_faulty,
    robust_result,
    settle,
)
from elastocal.identification.prediction import (
    NewPoses,
    fitted_too,
    left_open,
    over_the_workspace,
    predicted_error,
)
from elastocal.identification.result import Calibration, Combination, Estimate, TestErrors, made
from elastocal.identification.scrutiny import MOST_NUMBERS
from elastocal.identification.solve import (
    Course,
    MethodResult,
    Solution,
    bent,
    choose,
    fit_kept,
    of_this_arm,
    posed,
    residual_sigma,
    solve,
)
from elastocal.identification.start import (
    ROBUST,
    IntervalKind,
    Options,
    check_rows,
    check_table,
    copied,
    fallen,
    fixed_and_free,
    ordinary,
    solved_body,
    start_values,
    turned_base,
    without_copies,
)
from elastocal.identification.weighted_problem import PriorRows, Problem, Weights, weights_for
from elastocal.measurements import Measurements, numbered, order_contradicted, past_midnight
from elastocal.messages import ElastocalError, InputError, listed, option, said_of
from elastocal.model.calibrated import Scatter, ShownPoses
from elastocal.model.effects.base import Parameter
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.effects.geometry import BY_ORDER
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations, observe, subset
from elastocal.units import Array, BoolArray, Progress

__all__ = ["Options", "identify"]


def identify(
    model: Model, table: Measurements, options: Options | None = None,
    test: Measurements | None = None, progress: Progress = lambda message: None,
    new_poses: NewPoses | None = None,
) -> Calibration:  # fmt: skip
    """Parameters with intervals from nothing but the nominal arm and a table.

    Start by registration, a first fit weakly tied to it, choice of a minimal complete set of
    parameters, search for faulty readings; then the method: by default weights from a noise model
    whose variances restricted likelihood estimates, and intervals that know they are estimated.
    `new_poses` are where the arm will be used; by default the workspace that its limits span.

    Raises InputError for data that contradict robot or cell, InsufficientDataError where the
    data cannot determine the model.
    """
    options = options or Options()
    check_table(model, table, likely_mistake)
    if test is not None:
        check_rows(model, test, likely_mistake)
    table, told = without_copies(table)
    told = (*told, *past_midnight(table))
    observed = observe(table, model.observe)
    again = copied(observed)
    copies = tuple(table.row[observed.lead[again]].tolist())
    if copies:
        observed = subset(observed, ~again)
        covariance = _of_readings(options.covariance, ~again, observed.size)
        options = replace(options, covariance=covariance)
    course = _course(model, table, observed, options, progress)
    found = run_method(course)
    progress("intervals and held-out residuals")
    result = summarise(course, found, new_poses, copies, test)
    left = found.solution.fit.residual
    body = solved_body(table, float(left.std())), turned_base(model, observed, left)
    told = (*told, *_doubts(model, table, test, result.x))
    return replace(result, warnings=(*told, *result.warnings, *filter(None, body)))


def _doubts(
    model: Model, table: Measurements, test: Measurements | None, x: Array
) -> Iterator[str]:
    """Moves out of order where an effect follows them, an arm that lies, a test of what was
    fitted."""
    if test is not None and (twice := fitted_too(test, table)):
        yield (
            f"{twice} of {len(test)} readings of {test.source} ({option('test')}) are fitted too, "
            "so that their error tests nothing; give readings of other poses"
        )
    moves = any(effect_of(p.effect).family == "move" for p in model.parameters)
    if moves or model.cell.model.approach == BY_ORDER:
        for text in (order_contradicted(one) for one in (table, test) if one is not None):
            if text:
                yield f"{text}; effects of the last move are wrong there"
    hangs = table.force.any() and not table.force[:, :2].any() and (table.force[:, 2] <= 0).all()
    weighs = (model.cell.model.link_gravity or hangs) and model.observe != "distance"
    if weighs and (lies := fallen(model, x)) is not None:
        yield str(lies)


def _course(
    model: Model, table: Measurements, observed: Observations, options: Options, progress: Progress
) -> Course:
    progress("finding the start")
    free = fixed_and_free(model, options.fixed)
    x0 = start_values(model, table, options.seed, free)
    if smooth := bool(model.shrunk[free].any()):
        options.check_functions()
    own = ordinary(model, free)

    def refit(good: BoolArray) -> Solution:
        some = observed if good.all() else subset(observed, good)
        kind = "none" if options.method == "ols" else options.weights
        covariance = _of_readings(options.covariance, good, observed.size)
        weights = weights_for(some, model.cell.tracker, kind, covariance)
        problem = posed(model, some, weights, x0, own)
        if problem.large and (options.method in ROBUST or options.noise != "auto"):
            asked = f"method {options.method}"
            asked = asked if options.noise == "auto" else f"noise model '{options.noise}'"
            raise InputError(
                f"the {asked} takes no table of this size; use the default method, which excludes "
                "outliers and scales stated or equal noise to the residual"
            )
        solution = solve(problem, progress, not smooth)
        if some.kind == "pose" and weights.kind == "none" and kind == "auto":
            # Without stated noise, metres and radians get their relative weight from a first fit.
            parts = solution.fit.residual.reshape(-1, 2, 3)
            sigma = np.tile(np.repeat(np.maximum(parts.std(axis=(0, 2)), 1e-12), 3), len(parts))
            whiten = sparse.csr_array(sparse.diags_array(1 / sigma))
            text = "position and rotation weighted by the spread of their residuals in a first fit"
            weights = Weights("component", whiten, False, text)
            solution = solve(replace(problem, weights=weights), progress, not smooth)
        return solution

    every = refit(np.ones(len(observed.lead), dtype=bool))
    progress("looking for outliers")
    none = np.zeros(len(observed.lead), dtype=bool)
    faulty, sound = none if every.exact else find_faulty(every.problem, every.fit.x), every
    if faulty.any():
        try:
            sound = refit(~faulty)
        except ElastocalError:
            faulty = none  # what does not determine a valid arm cannot judge the others
    refuse_nonsense(
        model, sound.problem.observations, sound.fit.x, sound.fit.residual, table,
        subset(observed, faulty) if faulty.any() and sound is not every else None,
    )  # fmt: skip
    report = cache(partial(report_faulty, every, sound, None, ~faulty))
    return Course(every, sound, faulty, free, refit, report, options, progress)


def _of_readings(covariance: Array | None, good: BoolArray, size: int) -> Array | None:
    """The covariance of the good readings (N,) alone; a matrix of another shape stays as it is, to
    be refused where it becomes weights."""
    rows = np.repeat(good, size)
    if covariance is None or covariance.shape != (len(rows), len(rows)):
        return covariance
    return covariance[np.ix_(rows, rows)]


def _test_errors(model: Model, result: Calibration, table: Measurements) -> TestErrors:
    table = result.as_visited(table)
    observed = observe(table, model.observe)
    error = observed.value - model.predict(table, result.x, observed)
    length = np.linalg.norm(error.reshape(-1, observed.size)[:, :3], axis=1)
    rms = rms_3d(error, observed.size)
    errors = TestErrors(rms, float(length.mean()), float(length.max()), len(length), errors=length)
    if result.shown is None:
        return errors
    B = model.regressor(table, result.x, result.columns, observed).B
    here = uncertainty_of(observed, B, result.covariance)
    far = int((here > result.shown.most).sum())
    return replace(
        errors, std=float(np.sqrt(np.mean(here**2))), most_fitted=result.shown.most, far=far,
        configurations=len(here), p_far=result.shown.chance(far, len(here)),
    )  # fmt: skip


def misread_for_a_while(model: Model, table: Measurements, seed: int) -> list[FaultyGroup]:
    """Blocks of lines that `identify` sets apart, one common shift explaining each, before and
    after which readings are sound: no jump of arm or instrument, after which all are shifted."""
    found = identify(model, table, Options(seed=seed))
    if found.faulty_report is None or not found.excluded:
        return []
    sound = np.setdiff1d(table.row, [o.line for o in found.excluded])
    blocks = found.faulty_report.blocks(table)
    return [g for g in blocks if sound[0] < min(g.lines) and max(g.lines) < sound[-1]]


def left_out(model: Model, observed: Observations, fixed: tuple[str, ...]) -> Array:
    """Residual (rows,) of each configuration under an identification of the others."""
    options = Options(fixed=fixed, faulty="keep")
    course = _course(model, observed.table, observed, options, lambda message: None)
    return run_method(course).solution.crossed[0]


CORRELATED = 0.9
NOT_SHOWN = "held: the readings do not show the smooth function that it is part of"


def summarise(
    course: Course, found: MethodResult, new_poses: NewPoses | None, copies: tuple[int, ...],
    test: Measurements | None,
) -> Calibration:  # fmt: skip
    """The result of a method; `new_poses`: where the arm will be used, by default the workspace."""
    every, solution, covariance = course.every, found.solution, found.spread.matrix
    final = solution.fit
    kept, problem = solution.reduction.kept, solution.problem
    model, observed, weights = problem.model, problem.observations, problem.weights
    spent = len(kept) if found.effective is None else found.effective
    sigma = residual_sigma(final, spent)
    noise, parts = noise_of(found, sigma)
    left_out = {int(c) for s in found.smooth if not s.scale for c in s.group.columns.ravel()}
    own_sizes, unsure = of_this_arm(solution, found.spread.std)
    estimates, combinations = _estimates(replace(found, solution=own_sizes), left_out, unsure)
    determined = tuple(model.names[c] for c in kept)
    rho, told = found.spread.correlation, ~model.shrunk[kept]
    i, j = np.nonzero(np.triu(np.abs(rho) > CORRELATED, k=1) & np.outer(told, told))
    pairs = ((determined[a], determined[b], float(rho[a, b])) for a, b in zip(i, j, strict=True))
    faulty = describe(every, solution, ~found.good)
    set_apart = len(observed.lead) < len(every.problem.observations.lead)
    heldout, leverage, _ = solution.crossed
    shown, own = _shown(solution, covariance)
    there = np.isfinite(heldout)  # under a drift one that is not would reach all
    counted = heldout[there] if there.mean() > 1 - FEW else heldout
    plainly_large = problem.large and solution.held is None
    report, stated = None, found.contradicted
    if not every.exact:
        fitted = found.solution if set_apart or found.smooth else course.sound
        report = report_faulty(every, fitted, found.noise, found.good, found.standard)
    result = Calibration(
        model=model, method=found.method, noise=noise, weights=weights,
        noise_parts=parts, estimates=estimates, combinations=combinations, x=final.x,
        determined=determined, spread=found.spread,
        correlations=tuple(sorted(pairs, key=lambda pair: -abs(pair[2]))),
        observations=observed, residual=final.residual, held_out=heldout, sigma=sigma,
        held_out_told=(own, _held_out_dof(solution)),
        dof=len(final.whitened) - spent, residual_rms=rms_3d(final.residual, observed.size),
        heldout_rms=rms_3d(counted, observed.size), nominal_rms=solution.nominal_rms,
        converged=final.converged, reason=final.reason, outliers=() if set_apart else faulty,
        excluded=faulty if set_apart else (), warnings=(),
        residual_summary=summarise_residuals(
            observed, final.whitened, None if plainly_large else leverage,
            np.where(there, weights.apply(np.where(there, heldout, 0.0)), np.inf),
            absolute=weights.absolute,
        ),
        faulty_report=report, active=found.active, prior_share=found.prior_share,
        smooth=found.smooth, left=left_open(own_sizes, found.limits), copies=copies,
        shown=shown,
        findings=(made("care", "knowledge_contradicted", **stated),) if stated else (),
    )  # fmt: skip
    predicted = predicted_error(
        result.arm, observed, result.excess, found.spread,
        new_poses or over_the_workspace(model.cell, model, observed.table),
        np.random.default_rng(0), _unchecked(result),
    )  # fmt: skip
    errors = None if test is None else _test_errors(model, result, test)
    result = replace(result, predicted=predicted, test=errors)
    result = judged(result, solution, every.problem.observations.table)
    result = replace(result, scatter=_scatter(result, solution, course.options))
    notes = (f"The robot's file: {note}." for note in model.chain.notes)
    return replace(result, warnings=(*found.warnings, *warning_sentences(result), *notes))


def _unchecked(result: Calibration) -> Array | None:
    """What single configurations alone hold (`told_by_one`); None where it is not to be had."""
    observed, kept, weights = result.observations, result.columns, result.weights
    lone = ~np.isfinite(result.held_out)
    if not lone.any():
        return np.zeros((len(kept), len(kept)))
    others = result.prior_share or result.smooth or result.active
    if others or weights.together is not None or len(lone) * len(kept) > MOST_NUMBERS:
        return None
    B = result.B[:, kept]
    configuration = np.repeat(observed.configuration, observed.size)
    return told_by_one(weights.apply(B), np.where(lone, configuration, -1))


def uncertainty_of(
    observed: Observations, B: Array, covariance: Array, left: Array | float = 1.0
) -> Array:
    """Standard deviation (configurations,) in m that the fit's own uncertainty gives a predicted
    position, mean square over a configuration's readings; B (rows, determined).  By the fit to
    other configurations a row's variance is 1/`left` (rows,) times as much."""
    B = (B.T / np.sqrt(left)).T.reshape(-1, observed.size, B.shape[1])
    each = variance_of(B[:, :3], covariance)
    code = numbered(observed.configuration)
    return np.asarray(np.sqrt(np.bincount(code, each) / np.bincount(code)))


def _scatter(result: Calibration, solution: Solution, options: Options) -> Scatter | None:
    """None where known noise explains the residual, where more than readings holds estimates, and
    where configurations err alike in time, or one of them alone holds a parameter."""
    told = {f.kind for f in result.findings}
    explained = solution.exact or told & {*KNOWN_NOISE, "repeats_agree"}
    held = result.prior_share or result.smooth or result.active or options.intervals != "auto"
    alike = result.weights.together is not None or result.observations.n_configurations < 2
    if explained or held or alike:
        return None
    found = spread_of(solution, "cr2", None)
    return Scatter(found.matrix, found.dof) if found.dof.all() else None


def _shown(solution: Solution, covariance: Array) -> tuple[ShownPoses | None, float]:
    """How sure the fit is where it was measured, where the others tell each configuration; and the
    mean square in m² that this has in the errors held out, 0 of a large table."""
    observed, left = solution.problem.observations, solution.crossed[2]
    if solution.problem.large or not np.isfinite(covariance).all():
        return None, 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        std = uncertainty_of(observed, solution.fit.B, covariance, left)
    known = std[np.isfinite(std)]
    own = float(np.mean(known**2)) if len(known) else 0.0
    return ShownPoses(float(std.max()), len(std)) if len(known) == len(std) else None, own


def _held_out_dof(solution: Solution) -> float:
    """Degrees of freedom ν of the mean square T of errors held out, whose variance is 2T²/ν as
    configurations show it: by their own squares, and by how each draws the fit to the others where
    that is plain least squares of a table that is not large; 0 where fewer than two are told."""
    fit, problem, held = solution.fit, solution.problem, solution.crossed[0]
    weights, size = problem.weights, problem.observations.size
    labels = problem.observations.configuration if weights.together is None else weights.together
    code, counted = np.repeat(numbered(labels), size), np.arange(len(held)) % size < 3
    counted &= np.isfinite(held)
    held = np.where(counted, held, 0.0)
    square, count = np.bincount(code, held**2), np.bincount(code, counted)
    off = square - square.sum() / max(count.sum(), 1) * count
    if not problem.large and solution.held is None:
        seen = fit.B @ fit.r_factor.half
        off += drawn_by_each(seen, weights.apply(seen), fit.whitened, held, code)
    off = off[count > 0]
    spread = float((off**2).sum()) * len(off) / max(len(off) - 1, 1)
    return float(2 * square.sum() ** 2 / spread) if len(off) > 1 and spread > 0 else 0.0


def _estimates(
    method: MethodResult, left_out: set[int], unsure: float
) -> tuple[tuple[Estimate, ...], tuple[Combination, ...]]:
    solution, model = method.solution, method.solution.problem.model
    reduction, x = solution.reduction, solution.fit.x
    bends = zip(*bent(solution, method.spread.matrix, unsure), strict=True)
    partners: dict[int, list[str]] = {int(d): [] for d in reduction.dropped}
    found: dict[int, Estimate] = {}
    combinations = []

    def estimate(i: int, **known: Any) -> Estimate:
        p = model.parameters[i]
        return Estimate(p.name, p.unit, p.nominal, float(x[i]), **known)

    for k, (c, bend) in enumerate(zip(reduction.kept, bends, strict=True)):
        parameter = model.parameters[c]
        value, (terms, spread, dof, ci) = float(x[c]), method.told(k, *bend)
        for d in terms:
            partners[d].append(parameter.name)
        if terms:
            shares = {parameter.name: 1.0} | {model.names[d]: f for d, f in terms.items()}
            absorbed = {model.names[d]: float(x[d]) for d in terms}
            combination = Combination(shares, parameter.unit, value, spread, ci, absorbed, dof)
            combinations.append(combination)
            note = f"only as {combination.expression}"
            found[int(c)] = estimate(c, combined_with=tuple(absorbed), note=note)
        else:
            found[int(c)] = estimate(c, value=value, std=spread, ci95=ci, dof=dof)
    invisible = set(reduction.invisible.tolist())
    for d in reduction.dropped:
        note = "held: no reading depends on it enough to determine it"
        if int(d) not in invisible and partners[int(d)]:
            note = "held: known only together with " + ", ".join(partners[int(d)])
        found[int(d)] = estimate(d, combined_with=tuple(partners[int(d)]), note=note)
    for i, limits in method.limits.items():
        found[i] = estimate(i, limits=limits, note=_not_stated(model.parameters[i], x[i], limits))
    for i in range(len(model.parameters)):
        if i not in found:
            found[i] = estimate(i, note=NOT_SHOWN if (i in left_out) else "fixed by the user")
    return tuple(found[i] for i in range(len(model.parameters))), tuple(combinations)


def _not_stated(p: Parameter, held: float, limits: tuple[float, float]) -> str:
    if p.beyond(limits):
        return f"beyond its physical bound {p.lower if held < p.lower else p.upper:g}"
    if held == p.nominal and held != 0:
        return "held at its nominal value: the readings hardly show it"
    return f"the readings do not tell it from {p.lower if held < p.upper else p.upper:g}"


# The default method: noise estimated from the residuals, faulty readings judged by that noise.

ROUNDS, RESTARTS = 14, 2
SETTLED = 0.01  # of a standard deviation: what relinearising may still move an estimate by

# A fit to the good observations (N,), the noise found from them, and which they are.
Adapted = tuple[Solution, NoiseFit, BoolArray]

FIRST = ("independent", "stated")  # noise whose weights are those of the first fit


def _adapted(
    course: Course, start: Solution, good: BoolArray, kind: str, *,
    visits: bool = True, judging: bool = True,
) -> Adapted:  # fmt: skip
    """Fit with weights that the residuals tell, from `start`, the fit to the `good` (N,)
    observations.

    Noise and good readings are settled at its values and the kept parameters fitted anew with these
    weights, until neither changes.  Then the parameters are chosen again, if other readings are
    good or the weights show more, and with them, as whenever the good readings have changed, the
    kind of noise. Noise that knows the arm's `visits` counts, and readings are judged, unless told
    otherwise.  More parameters that do not settle are none: the fit without them stays.
    """
    every, same = course.every, True
    noise: NoiseFit | None = None
    fewer: tuple[Solution, NoiseFit, BoolArray, Readings] | None = None
    problem, solution, now, fitted, restarts = every.problem, start, good, good, 0

    def linear() -> Readings:
        kept = linearised(problem.model, problem.observations, solution.fit.x, start.reduction.kept)
        return kept if visits else replace(kept, visits=None)

    readings = linear()
    for left in reversed(range(ROUNDS)):
        before, kept, known = now, start.reduction.kept, noise if same else None
        if judging:
            noise, now = settle(readings, kind, now, known)
        else:
            noise = estimate_noise(readings, kind, known)
        course.progress(f"fitting with the noise found ({noise.kind})")
        expected = solution.fit.x[kept] + noise.x
        solution = refined(every, start, solution.fit.x, now, weights_of(noise, readings.take(now)))
        readings = linear()
        moved = np.abs(solution.fit.x[kept] - expected) / noise.covariance.std
        same = np.array_equal(now, before)
        if moved.max(initial=0.0) >= SETTLED or not same:
            continue
        if judging and restarts < RESTARTS and not np.array_equal(now, fitted):
            start, fitted, restarts = every if now.all() else course.refit(now), now, restarts + 1
            solution, fewer = start, None
        else:
            # Weights that make light of what is noisy may show more than those of the first fit.
            more = start.reduction
            if noise.kind not in FIRST and left > 0:
                fit, sigma = solution.fit, residual_sigma(solution.fit, len(kept))
                more = choose(fit.problem, fit.of_free, sigma, more.threshold)
            if len(more.kept) <= len(kept):
                break
            fewer = solution, noise, now, readings
            start = replace(start, reduction=more)
        readings, same = linear(), False
    else:
        if fewer is not None:
            solution, noise, now, readings = fewer
    assert noise is not None
    return solution, not_knowing_times(estimate_noise(readings.take(now), like=noise)), now


def refined(
    every: Solution, start: Solution, x: Array, good: BoolArray, weights: Weights
) -> Solution:
    observed = every.problem.observations
    chosen = observed if good.all() else subset(observed, good)
    problem: Problem = replace(start.problem, observations=chosen, weights=weights)
    return replace(start, fit=fit_kept(problem, x, start.reduction))


# Configurations per parameter from which the scatter of those of a large table counts.
ENOUGH = 10


def spread_of(solution: Solution, kind: IntervalKind, noise: NoiseFit | None) -> Covariance:
    """Covariance and intervals of the fitted parameters; InsufficientDataError where the data
    cannot give it.

    auto: those of the estimated noise (Kenward–Roger), where there is one, else classical, or in a
    large table with several readings per configuration cr1; classical: s²(BᵀW²B)⁻¹ with t (eq. 7,
    13); hc…, cr…: sandwich, clusters being configurations, or rows by themselves, in passes over
    the parts of the table; profile: {v: S(v) − Ŝ ≤ t² s²} of the nonlinear sum of squares.
    """
    fit, problem = solution.fit, solution.problem
    if kind == "auto" and noise is not None:
        return noise.covariance
    observed, table = problem.observations, problem.observations.table
    if kind == "auto" and problem.large:
        enough = len(observed.lead) > observed.n_configurations >= ENOUGH * len(fit.columns)
        kind = "cr1" if enough else kind
    sigma, dof = residual_sigma(fit, len(fit.columns)), len(fit.whitened) - len(fit.columns)
    V = fit.r_factor.half
    classical = Covariance(
        "classical", sigma**2 * V @ V.T, np.full(len(fit.columns), float(dof)),
        "all readings independent, their noise scaled to the residual",
    )  # fmt: skip
    if kind in ("auto", "classical"):
        return classical
    if kind == "profile":
        from elastocal.identification.knowledge_fit import KnownFit, intervals_with_knowledge

        free = Constraints().resolve([problem.model.names[c] for c in fit.columns])
        known = PriorRows(np.zeros((0, len(fit.columns))), np.zeros(0), free)
        many = np.zeros(len(fit.columns), dtype=bool)
        own = intervals_with_knowledge(KnownFit(fit, known, sigma), classical.dof, kind, many)
        text = "profile of the nonlinear sum of squares (all readings independent)"
        return replace(classical, kind=kind, description=text, ends=own.ends)

    def rows(part: Problem) -> Rows:
        (B, e), own = part.whitened(fit.x, fit.columns), part.observations
        return B @ V, e, part.rows if kind[0] == "h" else np.repeat(own.configuration, own.size)

    def named(cluster: int) -> str:
        if kind[0] == "h":
            return f"the reading of line {table.row[observed.lead[cluster // observed.size]]}"
        return f"configuration {table.configuration_labels[cluster]}"

    found = clustered(problem.each(rows), V, kind.upper(), named)
    if lone := [problem.model.names[c] for c in fit.columns[found.dof == 0]]:
        one = "reading" if kind[0] == "h" else "configuration"
        told = f"{found.description}; a single {one} determines {listed(lone, 4)}"
        found = replace(found, description=told)
    return found


COMPUTED = (
    "The readings agree with the model to rounding: they are computed, not measured, and tell "
    "nothing of the noise."
)


def run_method(course: Course) -> MethodResult:
    """Constraints and prior come last, on the weights and readings that the method ends with."""
    options, smooth = course.options, course.every.problem.model.shrunk[course.free].any()
    if smooth:
        from elastocal.identification.smooth_fit import fit_smooth  # few models have any

        found = fit_smooth(course)
    else:
        alone = replace(options, constraints=None, prior=None, intervals="auto")
        found = _by_method(replace(course, options=alone) if options.knows else course)
    if options.knows:
        from elastocal.identification.knowledge_fit import fit_with_knowledge  # few state any

        with said_of(options.constraints.source if options.constraints else option("prior")):
            return fit_with_knowledge(found, options, course.progress)
    return found if smooth else with_limits(course.every, found, options)


def _by_method(course: Course) -> MethodResult:
    every, sound, faulty, options = course.every, course.sound, course.faulty, course.options
    method, exact = options.resolved, sound.exact
    if method == "reml" and not every.problem.large and not exact:
        return _reml(course)
    if method in ROBUST:
        return robust_result(method, every, sound, ~faulty, options.intervals)
    # As published, every reading counts; and at equal weights noisy readings look faulty.
    explained = partial(_explained, course.report, ~faulty)
    drop = drops(options, every.problem.observations, faulty, explained)
    drop = drop and (method in ("wls", "reml") or options.faulty == "drop")
    solution, good = (sound if drop else every), ~faulty
    if method in ("eq14", "eq14-residual"):
        return _published(course, solution)
    kind = "ols" if solution.problem.weights.kind == "none" else "wls"
    spread = spread_of(solution, options.intervals, None)
    return MethodResult(kind, solution, spread, None, good, warnings=(COMPUTED,) * exact)


# Parameters that the readings hardly show.
#
# A compliance or a backlash has a sign, and one whose 95 % interval reaches beyond its physical
# bound is told from nothing.  Its estimate is mostly noise, and worse than what was known before:
# where the interval has room for the nominal value, that stands in its place; else the estimate,
# or the bound where it lies beyond.  What the readings say of it is the interval.


def with_limits(every: Solution, found: MethodResult, options: Options) -> MethodResult:
    """The result with the parameters that the readings hardly show held, and the others fitted anew
    with the weights and the kind of noise found.  One that lies beyond its bound by more than its
    interval contradicts the model and stays fitted, for all to see.  Of methods other than
    generalised and ordinary least squares all stay fitted, and where bounds or knowledge say what
    the readings do not."""
    fitted = found.method in ("reml", "wls", "ols")
    limits: dict[int, tuple[float, float]] = {}  # held ones keep what was found of them
    while True:
        held, solution, noise = {}, found.solution, found.noise
        fit, parameters = solution.fit, solution.problem.model.parameters
        for k, c in enumerate(solution.reduction.kept.tolist()):
            p, (terms, _, dof, (low, high)) = parameters[c], found.told(k)
            beyond = low <= p.lower < np.inf or -np.inf < p.upper <= high
            # Without a degree of freedom it is the interval that is not known.
            if beyond and dof > 0 and not p.shrunk and not terms:
                limits.setdefault(c, (low, high))
            if c not in limits or not fitted:
                continue
            (low, high), x = limits[c], float(fit.x[c])
            if p.nominal != 0 and low <= p.nominal <= high:
                held[c] = p.nominal
            elif not p.lower <= x <= p.upper and low < p.upper and p.lower < high:
                held[c] = min(max(x, p.lower), p.upper)
        lost = np.isin(solution.reduction.kept, list(held))
        if not held or lost.all():
            break
        x0, reduction = solution.problem.x0.copy(), solution.reduction.without(lost)
        x0[list(held)] = list(held.values())
        problem = replace(solution.problem, x0=x0)
        fit = fit_kept(problem, solution.fit.x, reduction)
        if not fit.converged:
            break
        solution = replace(solution, fit=fit, reduction=reduction)
        if noise is not None:
            readings = linearised(problem.model, every.problem.observations, fit.x, reduction.kept)
            if len(problem.observations.lead) < len(found.good):
                readings = readings.take(found.good)
            noise = not_knowing_times(estimate_noise(readings, like=noise))
        spread = spread_of(solution, options.intervals, noise)
        found = replace(found, solution=solution, spread=spread, noise=noise)
    return replace(found, limits=limits)


def _reml(course: Course) -> MethodResult:
    every, sound, options = course.every, course.sound, course.options

    def found(start: Solution, good: BoolArray, visits: bool = True) -> Adapted:
        solution, noise, good = _adapted(course, start, good, options.noise, visits=visits)
        report = partial(report_faulty, every, solution, noise, good)
        explained = partial(_explained, report, good)
        if not good.all() and not drops(options, every.problem.observations, ~good, explained):
            # So many faulty readings look like anything that scatters or drifts.
            everything, visits = np.ones_like(good), visits and options.noise != "auto"
            solution, noise, _ = _adapted(
                course, every, everything, options.noise, visits=visits, judging=False
            )
        return solution, noise, good

    solution, noise, good = found(sound, ~course.faulty)
    if options.noise == "auto" and Kind.of(noise.kind).by_visit:
        # What the model lacks looks like scatter of the joints as well.  That is no noise: weights
        # which make light of it let the fit go where poses left out are predicted worse.
        course.progress("comparing with noise of the readings alone")
        agreed = every if good.all() else sound
        if not good.all() and not np.array_equal(good, ~course.faulty):
            agreed = course.refit(good)
        plain = found(agreed, good, visits=False)
        if _held_out_rms(solution, solution) > WORSE * _held_out_rms(plain[0], solution):
            solution, good = plain[::2]
            noise = replace(plain[1], tests=noise.tests)  # which say what is not counted
    spread = spread_of(solution, options.intervals, noise)
    return MethodResult("reml", solution, spread, noise, good)


def _explained(reported: Callable[[], OutlierReport | None], good: BoolArray) -> BoolArray:
    """Readings (N,) that are not `good`, of groups which one common shift each explains."""
    report = reported()
    known = [] if report is None else [f.readings for f in report.shifted]
    return ~good & np.isin(np.arange(len(good)), np.concatenate([[], *known]))


WORSE = 1.02  # held-out errors that differ by less are alike


def _held_out_rms(solution: Solution, judge: Solution) -> float:
    """Root mean square length in m of what poses left out are off by: those which the noise of
    `judge` takes for one, configurations or blocks in time."""
    judged, together = judge.problem.observations, judge.problem.weights.together
    held = solution.crossed[0]
    if together is not None:
        block = dict(zip(judged.configuration.tolist(), together.tolist(), strict=True))
        observed, fit = solution.problem.observations, solution.fit
        left_out = np.array([block.get(c, -1) for c in observed.configuration.tolist()])
        weights = replace(solution.problem.weights, together=left_out)
        held = held_out_residual(fit.B, fit.residual, weights, left_out, observed.size)
    return float(np.sqrt(np.mean(held[np.isfinite(held)] ** 2)))


def _published(course: Course, start: Solution) -> MethodResult:
    """Eq. (14) on the linearised model, and a fit of the exact one with the weights it ends at."""
    from elastocal.identification import published

    course.progress("iterating the weights of eq. (14)")
    observed, fit, options = start.problem.observations, start.fit, course.options
    method, good, group = options.resolved, ~course.faulty, None
    if method == "eq14":
        group = (observed.configuration[:, None] * observed.size + np.arange(observed.size)).ravel()
    size = start.problem.sizes[fit.columns]
    with said_of(f"{observed.table.source}: {option('method', method)}"):
        last = published.eq14(fit.B * size, fit.residual, group)[-1]
    text = "weights of eq. (14), σ " + ("by group" if group is not None else "of each residual")
    weights = Weights(method, sparse.csr_array(sparse.diags_array(last.weights)), False, text)
    fitted = good if len(observed.lead) < len(good) else np.ones_like(good)
    solution = refined(course.every, start, start.fit.x, fitted, weights)
    covariance = Covariance(
        "eq13", last.covariance * np.outer(size, size), np.full(len(size), np.inf),
        "as published, eq. (13) with the σ of eq. (14): not corrected for estimated weights",
    )  # fmt: skip
    if options.intervals != "auto":
        covariance = spread_of(solution, options.intervals, None)
    return MethodResult(method, solution, covariance, None, good)
