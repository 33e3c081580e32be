"""From a model and a table to calibrated parameters: the whole identification, step by step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import ElastocalError
from elastocal.identification.estimates import summarise, uncertainty_of
from elastocal.identification.findings import judged
from elastocal.identification.intervals import MethodResult
from elastocal.identification.methods import (
    is_exact,
    run_method,
    with_limits,
    with_smooth,
)
from elastocal.identification.mistakes import copied, refuse_nonsense
from elastocal.identification.options import Options
from elastocal.identification.outliers import describe, find_faulty
from elastocal.identification.prediction import NewPoses
from elastocal.identification.residuals import rms_3d
from elastocal.identification.result import Calibration, TestErrors
from elastocal.identification.rigid_markers import solved_body, without_copies
from elastocal.identification.solve import Problem, Solution, solve
from elastocal.identification.start import (
    check_rows,
    check_table,
    fixed_and_free,
    ordinary,
    start_values,
)
from elastocal.identification.upright import fallen
from elastocal.identification.weighted_problem import (
    Weights,
    partition,
    residual_at,
    scaled_by_component,
    weights_for,
)
from elastocal.measurements import NEVER_YET, Measurements, order_contradicted
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.effects.gears import BY_ORDER
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations, observe, subset
from elastocal.units import Array, Progress

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
    """That the base lies far from upright, where weights act, or loads that hang."""
    hangs = table.force.any() and not table.force[:, :2].any() and (table.force[:, 2] <= 0).all()
    weighs = model.cell.model.link_gravity or bool(hangs)
    lies = fallen(model, x) if weighs and model.observe != "distance" else None
    return () if lies is None else (str(lies),)


def _disordered(model: Model, *tables: Measurements | None) -> tuple[str, ...]:
    """That effects of the last move rest on an order which is not that of the campaign."""
    by_order = model.cell.model.approach == BY_ORDER
    if not by_order and not any(effect_of(p.effect).family == "move" for p in model.parameters):
        return ()
    found = (order_contradicted(table) for table in tables if table is not None)
    return tuple(f"{text}; effects of the last move are wrong there" for text in found if text)


def _fitted(
    model: Model, table: Measurements, observed: Observations, options: Options, progress: Progress
) -> tuple[Solution, Solution, MethodResult]:
    """The fits to all observations and to those that are not faulty, and what the method found."""
    progress("finding the start")
    free = fixed_and_free(model, options.fixed)
    x0 = start_values(model, table, options.seed, free)
    smooth = bool(model.shrunk[free].any())
    every = _solution(model, observed, x0, ordinary(model, free), options, progress, not smooth)

    def refit(good: NDArray[np.bool_]) -> Solution:
        chosen, own = _without(options, ~good, observed.size), ordinary(model, free)
        return _solution(model, subset(observed, good), x0, own, chosen, progress, not smooth)

    progress("looking for faulty readings")
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
    if smooth:
        return every, sound, with_smooth(every, sound, faulty, free, options, progress)
    found = run_method(every, sound, faulty, refit, options, progress)
    return every, sound, with_limits(every, found, options)


def _without(options: Options, left_out: NDArray[np.bool_], size: int) -> Options:
    """The options for the observations that are not `left_out` (N,)."""
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
