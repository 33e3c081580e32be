"""Readings that the noise does not explain: found by the fit of the majority."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import ElastocalError, InsufficientDataError
from elastocal.identification.chunked import evaluate, residual_at
from elastocal.identification.judgement import Visit, judge, verdict
from elastocal.identification.outlier import FALSE_ALARM, Outlier, blocks
from elastocal.identification.partition import part_of, sample
from elastocal.identification.selection import WORTH_A_COLUMN, choose
from elastocal.identification.solve import SAMPLE, Solution, is_placed, settle
from elastocal.identification.triangle import Triangle
from elastocal.identification.trimmed import majority, median_scale

__all__ = ["FALSE_ALARM", "blocks", "describe", "find_faulty"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def find_faulty(solution: Solution, refit: Callable[[Mask], Solution]) -> tuple[Mask, Solution]:
    """Which observations (N,) are faulty, and the solution without them.

    A trimmed fit of base, markers and cable to the nominal arm shows the suspects; then the whole
    model is fitted to the others and every observation judged, in turns (`verdict`).  Where one
    step from the fit of all to that of the others accuses nobody, the first turn ends with that:
    of a clean table, one in a hundred readings is a suspect, and a fit without it is a small step.

    In a large table the majority of a sample judges all observations first.
    """
    if not solution.problem.large:
        good = ~_suspects(solution)
        visit = _acquitted(solution, good)
        if visit is not None:
            found = verdict(solution, refit, np.ones(len(good), dtype=bool), (visit,))
            if found[1] is not visit[2]:
                return found
        return verdict(solution, refit, good)

    def fit_others(good: Mask) -> Solution:
        return _fit_to(solution, good)

    return verdict(solution, fit_others, _agreeing_with_a_sample(solution))


def _acquitted(solution: Solution, good: Mask) -> Visit | None:
    """The judgement by one Gauss–Newton step from the fit of all to the `good` observations.

    None where it accuses anybody, or where the good ones ask for other parameters: then the fit
    has to be made.  Of that visit's fit, values and parameters alone are those of the good ones.
    """
    problem, kept = solution.problem, solution.reduction.kept
    independent = problem.parts.blocks is None and problem.weights.kind != "component"
    if good.all() or problem.bounded or not independent:
        return None  # what is correlated, or weighted by its residuals, is whitened anew
    seen, free, sizes = problem.observations, problem.free, solution.sizes
    try:
        at = problem.model.regressor(seen.table, solution.fit.x, free, seen)
        rows = np.repeat(good, seen.size)
        triangle = Triangle.of(
            problem.weights.apply(at.B)[rows], problem.weights.apply(at.residual)[rows]
        )
        own = triangle.of_columns(np.searchsorted(free, kept))
        if own.rows <= len(kept):
            return None
        sigma = max(own.rest / float(np.sqrt(own.rows - len(kept))), 1e-12)
        chosen = choose(problem, sizes, triangle, sigma, WORTH_A_COLUMN)
        if not np.array_equal(chosen.kept, kept):
            return None
        x = solution.fit.x.copy()
        x[kept] += own.step(sizes[kept])
        stepped = replace(solution, fit=replace(solution.fit, x=x))
        beyond, cost = judge(solution, stepped, good)
    except (ElastocalError, np.linalg.LinAlgError):
        return None
    return None if beyond.any() else (cost, good, stepped)


def _suspects(solution: Solution) -> Mask:
    """Observations outside the majority of a trimmed fit of base, markers and cable alone.

    From the nominal geometry: faulty readings have bent everything else in the whole fit.
    """
    problem = solution.problem
    model, seen = problem.model, problem.observations
    placed = problem.free[is_placed(model)[problem.free]]
    if not len(placed):
        e = problem.weights.apply(residual_at(model, problem.parts, solution.fit.x))
        return ~majority(np.zeros((len(e), 0)), e, seen.size)
    at = model.regressor(seen.table, problem.x0, placed, seen)
    B = problem.weights.apply(at.B)
    scale = np.linalg.norm(B, axis=0)
    residual = problem.weights.apply(at.residual)
    return ~majority(B / np.where(scale > 0, scale, 1.0), residual, seen.size)


def _agreeing_with_a_sample(solution: Solution) -> Mask:
    """Observations within the limit under the fit to the majority of a sample of them.

    All, where the sample does not show a parameter that the solution has.
    """
    problem = solution.problem
    every = np.ones(len(problem.observations.lead), dtype=bool)
    part = sample(problem.parts, SAMPLE)
    own = replace(problem, observations=part.observations, weights=part.weights)
    rough = replace(solution, problem=own)
    faulty, fitted = verdict(rough, lambda good: _fit_to(rough, good), ~_suspects(rough))
    shown = evaluate(problem.model, own.parts, fitted.fit.x, solution.reduction.kept).triangle
    if not np.linalg.norm(shown.R, axis=0).all():
        return every
    inside = ~every
    inside[part.index[~faulty]] = True
    try:
        return ~judge(solution, fitted, inside)[0]
    except (ElastocalError, np.linalg.LinAlgError):
        return every


def _fit_to(solution: Solution, good: Mask) -> Solution:
    """The parameters chosen anew for the good observations, and fitted to them.

    An observation that is correlated with one that is not good stays out with it.
    """
    problem, blocks = solution.problem, solution.problem.parts.blocks
    if blocks is not None:
        good = good & ~np.isin(blocks, blocks[~good])
    if good.sum() <= len(good) // 2:
        raise InsufficientDataError("fewer than half of the readings agree with each other")
    part = part_of(problem.observations, problem.weights, np.flatnonzero(good))
    own = replace(problem, observations=part.observations, weights=part.weights, bounded=False)
    settled = settle(own, solution.sizes)
    return replace(solution, problem=settled.problem, fit=settled.fit, reduction=settled.reduction)


def describe(solution: Solution, fitted: Solution, faulty: Mask) -> tuple[Outlier, ...]:
    """The faulty observations with their error under the fit to the others, in table order."""
    seen, model = solution.problem.observations, solution.problem.model
    error = residual_at(model, solution.problem.parts, fitted.fit.x)
    length = np.linalg.norm(error.reshape(-1, seen.size)[:, :3], axis=1)
    squared = (solution.problem.weights.apply(error).reshape(-1, seen.size) ** 2).sum(axis=1)
    sigma = median_scale(squared[~faulty], seen.size)
    table = seen.table
    return tuple(
        Outlier(
            int(table.row[seen.lead[k]]),
            table.configuration_labels[table.configuration[seen.lead[k]]],
            table.marker_names[table.marker[seen.lead[k]]],
            float(length[k]),
            float(np.sqrt(squared[k]) / sigma),
        )
        for k in np.flatnonzero(faulty)
    )
