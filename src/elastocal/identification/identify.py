"""From a model and a table to calibrated parameters: the whole identification, step by step."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import ElastocalError
from elastocal.identification.covariance import variance_of
from elastocal.identification.faulty_readings import report_faulty
from elastocal.identification.findings import judged, of_solution
from elastocal.identification.least_squares import Problem
from elastocal.identification.methods import is_exact, run_method
from elastocal.identification.mistakes import refuse_nonsense
from elastocal.identification.noise_summary import noise_of, noise_parts
from elastocal.identification.options import MethodResult, Options
from elastocal.identification.outliers import Outlier, describe, find_faulty
from elastocal.identification.prediction import (
    NewPoses,
    left_open,
    over_the_workspace,
    predicted_error,
)
from elastocal.identification.residuals import (
    rms_3d,
    summarise_residuals,
    told_by_one,
)
from elastocal.identification.result import Calibration, Combination, Estimate, TestErrors
from elastocal.identification.scrutiny import MOST_NUMBERS
from elastocal.identification.sentences import warning_sentences
from elastocal.identification.solve import Solution, bent, residual_sigma, solve
from elastocal.identification.start import (
    check_rows,
    check_table,
    copied,
    fallen,
    fixed_and_free,
    ordinary,
    solved_body,
    start_values,
    without_copies,
)
from elastocal.identification.weighted_problem import (
    Weights,
    partition,
    residual_at,
    scaled_by_component,
    weights_for,
)
from elastocal.measurements import NEVER_YET, Measurements, order_contradicted, ranked
from elastocal.model.arm import Parameter
from elastocal.model.calibrated import ShownPoses
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.effects.gears import BY_ORDER
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations, observe, subset
from elastocal.units import Array, BoolArray, Progress

__all__ = ["Options", "identify"]


def identify(
    model: Model,
    table: Measurements,
    options: Options | None = None,
    test: Measurements | None = None,
    progress: Progress = lambda message: None,
    new_poses: NewPoses | None = None,
) -> Calibration:
    """Parameters with intervals from nothing but the nominal arm and a table.

    Start by registration, a first fit weakly tied to it, choice of a minimal complete set of
    parameters, search for faulty readings; then the method: by default weights from a noise model
    whose variances restricted likelihood estimates, and intervals that know they are estimated.
    `new_poses` are where the arm will be used; by default the workspace that its limits span.

    Raises InputError for data that contradict robot or cell, InsufficientDataError where the
    data cannot determine the model.
    """
    options = options or Options()
    check_table(model, table)
    if test is not None:
        check_rows(model, test)
    table, told = without_copies(table)
    observed = observe(table, model.observe)
    again = copied(observed)
    copies = tuple(table.row[observed.lead[again]].tolist())
    if copies:
        observed = subset(observed, ~again)
        options = _without(options, again, observed.size)
    every, sound, found = _fitted(model, table, observed, options, progress)
    progress("intervals and held-out residuals")
    outliers = describe(every, found.solution, ~found.good)
    result = summarise(model, every, sound, found, outliers, new_poses, copies)
    body = solved_body(table, float(found.solution.fit.residual.std()))
    told = (*told, *_disordered(model, table, test), *_fallen(model, table, result.x))
    result = replace(result, warnings=(*told, *result.warnings, *filter(None, [body])))
    if test is None:
        return result
    return judged(replace(result, test=_test_errors(model, result, test)))


def _fallen(model: Model, table: Measurements, x: Array) -> tuple[str, ...]:
    hangs = table.force.any() and not table.force[:, :2].any() and (table.force[:, 2] <= 0).all()
    weighs = model.cell.model.link_gravity or bool(hangs)
    lies = fallen(model, x) if weighs and model.observe != "distance" else None
    return () if lies is None else (str(lies),)


def _disordered(model: Model, *tables: Measurements | None) -> tuple[str, ...]:
    by_order = model.cell.model.approach == BY_ORDER
    if not by_order and not any(effect_of(p.effect).family == "move" for p in model.parameters):
        return ()
    found = (order_contradicted(table) for table in tables if table is not None)
    return tuple(f"{text}; effects of the last move are wrong there" for text in found if text)


def _fitted(
    model: Model, table: Measurements, observed: Observations, options: Options, progress: Progress
) -> tuple[Solution, Solution, MethodResult]:
    progress("finding the start")
    free = fixed_and_free(model, options.fixed)
    x0 = start_values(model, table, options.seed, free)
    smooth = bool(model.shrunk[free].any())
    every = _solution(model, observed, x0, ordinary(model, free), options, progress, not smooth)

    def refit(good: NDArray[np.bool_]) -> Solution:
        chosen, own = _without(options, ~good, observed.size), ordinary(model, free)
        return _solution(model, subset(observed, good), x0, own, chosen, progress, not smooth)

    progress("looking for outliers")
    none = np.zeros(len(observed.lead), dtype=bool)
    faulty, sound = none if is_exact(every) else find_faulty(every), every
    if faulty.any():
        try:
            sound = refit(~faulty)
        except ElastocalError:
            faulty = none  # what does not determine a valid arm cannot judge the others
    refuse_nonsense(
        model, sound.problem.observations, sound.fit.x, sound.fit.residual, table,
        subset(observed, faulty) if faulty.any() and sound is not every else None,
    )  # fmt: skip
    return every, sound, run_method(every, sound, faulty, free, refit, options, progress)


def _without(options: Options, left_out: NDArray[np.bool_], size: int) -> Options:
    if options.covariance is None:
        return options
    rows = np.repeat(~left_out, size)
    return replace(options, covariance=options.covariance[np.ix_(rows, rows)])


def _solution(
    model: Model,
    observed: Observations,
    x0: Array,
    free: NDArray[np.int64],
    options: Options,
    progress: Progress,
    try_wider: bool = True,
) -> Solution:
    kind = "none" if options.method == "ols" else options.weights
    weights = weights_for(observed, model.cell.tracker, kind, options.covariance)
    problem = Problem(model, observed, weights, x0, free)
    solution = solve(problem, progress, try_wider)
    if observed.kind == "pose" and weights.kind == "none" and kind == "auto":
        # Without stated noise, metres and radians get their relative weight from a first fit.
        parts = solution.fit.residual.reshape(-1, 6)
        sigma = np.repeat([parts[:, :3].std(), parts[:, 3:].std()], 3)
        weights = scaled_by_component(observed, np.maximum(sigma, 1e-12))
        solution = solve(replace(problem, weights=weights), progress, try_wider)
    return solution


def _test_errors(model: Model, result: Calibration, table: Measurements) -> TestErrors:
    # What came before its first visit is not what came before that of the campaign.
    table = replace(table, move=None, direction=None)
    if table.time is None and model.cell.model.clock == "rows":  # after the campaign
        table = replace(table, time=np.full(len(table), NEVER_YET))
    observed = observe(table, model.observe)
    parts = partition(observed, Weights("none", None, False, ""), len(model.parameters))
    error = residual_at(model, parts, result.x)
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


CORRELATED = 0.9
NOT_SHOWN = "held: the readings do not show the smooth function that it is part of"


def summarise(
    model: Model, every: Solution, sound: Solution, found: MethodResult,
    faulty: tuple[Outlier, ...], new_poses: NewPoses | None = None, copies: tuple[int, ...] = (),
) -> Calibration:  # fmt: skip
    """The result of a method: estimates with intervals, what is combined, noise, warnings.

    `every` holds all readings, `sound` the fit to those that agree; `faulty` are those beyond the
    noise.  `new_poses`: where the arm will be used, by default the workspace.
    """
    solution, final, covariance = found.solution, found.solution.fit, found.spread.matrix
    kept, observed, weights = (
        solution.reduction.kept, solution.problem.observations, solution.problem.weights
    )  # fmt: skip
    spent = len(kept) if found.effective is None else found.effective
    sigma = residual_sigma(final, spent)
    left_out = {int(c) for s in found.smooth if not s.scale for c in s.group.columns.ravel()}
    estimates, combinations = _estimates(model, solution, found, left_out)
    determined = tuple(model.names[c] for c in kept)
    set_apart = len(observed.lead) < len(every.problem.observations.lead)
    leverage = found.leverage  # None of a large table
    if leverage is None and not solution.problem.large:
        leverage = solution.leverage
    report = None
    if not is_exact(every):
        fitted = found.solution if set_apart or found.smooth else sound
        report = report_faulty(every, fitted, found.noise, found.good, found.standard)
    result = Calibration(
        model=model, method=found.method, noise=noise_of(found, sigma), weights=weights,
        noise_parts=noise_parts(found), estimates=estimates, combinations=combinations, x=final.x,
        determined=determined, spread=found.spread,
        correlations=_correlations(covariance, determined, ~model.shrunk[kept]),
        observations=observed, residual=final.residual, held_out=solution.heldout, sigma=sigma,
        dof=len(final.whitened) - spent, residual_rms=rms_3d(final.residual, observed.size),
        heldout_rms=rms_3d(solution.heldout, observed.size), nominal_rms=solution.nominal_rms,
        converged=final.converged, reason=final.reason, outliers=() if set_apart else faulty,
        excluded=faulty if set_apart else (), warnings=(),
        residual_summary=summarise_residuals(
            observed, final.whitened, leverage, weights.apply(solution.heldout),
            absolute=weights.absolute,
        ),
        faulty_report=report, active=found.active, prior_share=found.prior_share,
        smooth=found.smooth, left=left_open(solution, found.limits), copies=copies,
        shown=_shown(solution, covariance, leverage),
    )  # fmt: skip
    poses = new_poses or over_the_workspace(model.cell, model, observed.table)
    return _judged(result, found, poses, every.problem.observations.table)


def _judged(
    result: Calibration, found: MethodResult, poses: NewPoses, whole: Measurements
) -> Calibration:
    solution = found.solution
    predicted = predicted_error(
        result.arm, result.observations, result.excess, result.spread, poses,
        np.random.default_rng(0), _unchecked(result),
    )  # fmt: skip
    result = replace(result, predicted=predicted)
    result = judged(result, of_solution(result, solution, whole))
    told = tuple(f"The robot's file: {note}." for note in result.model.chain.notes)
    return replace(result, warnings=(*found.warnings, *warning_sentences(result), *told))


def _unchecked(result: Calibration) -> Array | None:
    """What single configurations alone hold (`told_by_one`); None where it is not to be had."""
    observed, kept, weights = result.observations, result.columns, result.weights
    lone = ~np.isfinite(result.held_out)
    if not lone.any():
        return np.zeros((len(kept), len(kept)))
    usual = not (
        result.prior_share or result.smooth or result.active or weights.together is not None
    )
    if not usual or len(lone) * len(kept) > MOST_NUMBERS:
        return None
    B = result.B[:, kept]
    configuration = np.repeat(observed.configuration, observed.size)
    return told_by_one(weights.apply(B), np.where(lone, configuration, -1))


def uncertainty_of(
    observed: Observations, B: Array, covariance: Array, left: Array | float = 1.0
) -> Array:
    """Standard deviation (configurations,) in m that the fit's own uncertainty gives a predicted
    position, mean square over a configuration's readings; B (rows, determined).

    A row that the fit holds with leverage h is known with variance v there, with v/(1 − h) by the
    fit to the others; `left` (rows,) are 1 − h.
    """
    B = (B.T / np.sqrt(left)).T.reshape(-1, observed.size, B.shape[1])
    each = variance_of(B[:, :3], covariance)
    code = ranked(observed.configuration)
    return np.asarray(np.sqrt(np.bincount(code, each) / np.bincount(code)))


SEEN_BY_OTHERS = 1e-6  # of a row: the least that other configurations must see of it


def _shown(solution: Solution, covariance: Array, leverage: Array | None) -> ShownPoses | None:
    if solution.problem.large or leverage is None or not np.isfinite(covariance).all():
        return None
    left = np.maximum(1 - leverage, SEEN_BY_OTHERS)
    std = uncertainty_of(solution.problem.observations, solution.fit.B, covariance, left)
    return ShownPoses(float(std.max()), len(std))


def _estimates(
    model: Model, solution: Solution, method: MethodResult, left_out: set[int]
) -> tuple[tuple[Estimate, ...], tuple[Combination, ...]]:
    reduction, x, every_end = solution.reduction, solution.fit.x, method.ci95
    std, dof = method.spread.std, method.spread.dof
    bends = bent(solution, method.spread.matrix)
    partners: dict[int, list[str]] = {int(d): [] for d in reduction.dropped}
    found: dict[int, Estimate] = {}
    combinations = []

    def estimate(i: int, **known: Any) -> Estimate:
        p = model.parameters[i]
        return Estimate(p.name, p.unit, p.nominal, float(x[i]), **known)

    for k, c in enumerate(reduction.kept):
        parameter = model.parameters[c]
        terms = reduction.terms(k, solution.sizes, std[k])
        value = float(x[c])
        ends = every_end[k]
        spread, ci = reduction.widened(k, solution.sizes, std[k], value, ends, bends[k])
        for d in terms:
            partners[d].append(parameter.name)
        if terms:
            shares = {parameter.name: 1.0} | {model.names[d]: f for d, f in terms.items()}
            held = {model.names[d]: float(x[d]) for d in terms}
            combination = Combination(shares, parameter.unit, value, spread, ci, held)
            combinations.append(combination)
            note = f"only as {combination.expression}"
            found[int(c)] = estimate(c, combined_with=tuple(held), note=note)
        else:
            found[int(c)] = estimate(c, value=value, std=spread, ci95=ci, dof=float(dof[k]))
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
            zero = i in left_out
            found[i] = estimate(i, note=NOT_SHOWN if zero else "fixed by the user")
    return tuple(found[i] for i in range(len(model.parameters))), tuple(combinations)


def _not_stated(p: Parameter, held: float, limits: tuple[float, float]) -> str:
    if p.beyond(limits):
        return f"beyond its physical bound {p.lower if held < p.lower else p.upper:g}"
    if held == p.nominal and held != 0:
        return "held at its nominal value: the readings hardly show it"
    return f"the readings do not tell it from {p.lower if held < p.upper else p.upper:g}"


def _correlations(
    covariance: Array, names: tuple[str, ...], told: BoolArray
) -> tuple[tuple[str, str, float], ...]:
    """Pairs with |ρ| over 0.9 of those that are `told`, strongest first."""
    covariance = covariance[np.ix_(told, told)]
    names = tuple(name for name, own in zip(names, told, strict=True) if own)
    std = np.sqrt(np.diag(covariance))
    known = np.outer(std, std)
    # A value that equalities fix varies with nothing.
    rho = np.divide(covariance, known, out=np.zeros_like(known), where=known > 0)
    i, j = np.triu_indices(len(names), k=1)
    strong = [(a, b) for a, b in zip(i, j, strict=True) if abs(rho[a, b]) > CORRELATED]
    strong.sort(key=lambda ab: -abs(rho[ab]))
    return tuple((names[a], names[b], float(rho[a, b])) for a, b in strong)
