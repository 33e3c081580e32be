"""From a solution to estimates: covariance, t intervals, combinations, correlations."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from elastocal.identification.covariance import variance_of
from elastocal.identification.faulty_readings import report_faulty
from elastocal.identification.findings import judged, of_solution
from elastocal.identification.intervals import MethodResult
from elastocal.identification.methods import is_exact
from elastocal.identification.noise_summary import noise_of, noise_parts
from elastocal.identification.outliers import Outlier
from elastocal.identification.prediction import (
    NewPoses,
    left_open,
    over_the_workspace,
    predicted_error,
)
from elastocal.identification.residuals import (
    ResidualSummary,
    rms_3d,
    summarise_residuals,
    told_by_one,
)
from elastocal.identification.result import Calibration, Combination, Estimate
from elastocal.identification.scrutiny import MOST_NUMBERS
from elastocal.identification.sentences import warning_sentences
from elastocal.identification.solve import Solution, bent, residual_sigma
from elastocal.measurements import ranked
from elastocal.model.arm import Parameter
from elastocal.model.calibrated import ShownPoses
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.units import Array, BoolArray

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
    solution, final = found.solution, found.solution.fit
    kept = solution.reduction.kept
    spent = len(kept) if found.effective is None else found.effective
    sigma = residual_sigma(final, spent)
    left_out = {int(c) for s in found.smooth if not s.scale for c in s.group.columns.ravel()}
    estimates, combinations = _estimates(model, solution, found, left_out)
    determined = tuple(model.names[c] for c in kept)
    observed = solution.problem.observations
    set_apart = len(observed.lead) < len(every.problem.observations.lead)
    covariance = found.intervals.covariance.matrix
    leverage = _leverage(found)
    report = None
    if not is_exact(every):
        fitted = found.solution if set_apart or found.smooth else sound
        report = report_faulty(every, fitted, found.noise, found.good, found.standard)
    result = Calibration(
        model=model,
        method=found.method,
        noise=noise_of(found, sigma),
        estimates=estimates,
        combinations=combinations,
        x=final.x,
        determined=determined,
        spread=found.intervals.covariance,
        correlations=_correlations(covariance, determined, ~model.shrunk[kept]),
        observations=observed,
        residual=final.residual,
        held_out=solution.heldout,
        sigma=sigma,
        dof=len(final.whitened) - spent,
        residual_rms=rms_3d(final.residual, observed.size),
        heldout_rms=rms_3d(solution.heldout, observed.size),
        nominal_rms=solution.nominal_rms,
        converged=final.converged,
        reason=final.reason,
        outliers=() if set_apart else faulty,
        excluded=faulty if set_apart else (),
        warnings=(),
        residual_summary=_residual_summary(solution, leverage),
        faulty_report=report,
        active=found.active,
        prior_share=found.prior_share,
        smooth=found.smooth,
        left=left_open(solution),
        copies=copies,
        weights=solution.problem.weights,
        noise_parts=noise_parts(found),
        shown=_shown(solution, covariance, leverage),
    )
    return _judged(
        result, found, new_poses or over_the_workspace(model.cell, model, observed.table)
    )


def _judged(result: Calibration, found: MethodResult, poses: NewPoses) -> Calibration:
    """The result with the error expected at those poses, findings and warnings."""
    solution = found.solution
    predicted = predicted_error(
        result.arm, result.observations, result.excess, result.spread, poses,
        np.random.default_rng(0), _unchecked(result),
    )  # fmt: skip
    result = replace(result, predicted=predicted)
    result = judged(result, of_solution(result, solution))
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


def _leverage(found: MethodResult) -> Array | None:
    """How much each row (rows,) draws the fit to itself; None of a large table."""
    solution = found.solution
    if found.leverage is None and not solution.problem.large:
        return solution.leverage
    return found.leverage


def _residual_summary(solution: Solution, leverage: Array | None) -> ResidualSummary | None:
    """The whitened residuals against what the noise model says of them."""
    problem, fit = solution.problem, solution.fit
    return summarise_residuals(
        problem.observations, fit.whitened, leverage,
        problem.weights.apply(solution.heldout), absolute=problem.weights.absolute,
    )  # fmt: skip


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
    """How sure the fit is where it was measured; None where the table is too large to say."""
    if solution.problem.large or leverage is None or not np.isfinite(covariance).all():
        return None
    left = np.maximum(1 - leverage, SEEN_BY_OTHERS)
    std = uncertainty_of(solution.problem.observations, solution.fit.B, covariance, left)
    return ShownPoses(float(std.max()), len(std))


def _estimates(
    model: Model, solution: Solution, method: MethodResult, left_out: set[int]
) -> tuple[tuple[Estimate, ...], tuple[Combination, ...]]:
    reduction, x, intervals = solution.reduction, solution.fit.x, method.intervals
    std, dof = intervals.covariance.std, intervals.covariance.dof
    bends = bent(solution, intervals.covariance.matrix)
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
        ends = intervals.ci95[k]
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
        found[i] = estimate(i, limits=limits, note=_hardly_shown(model.parameters[i], x[i]))
    for i in range(len(model.parameters)):
        if i not in found:
            zero = i in left_out
            found[i] = estimate(i, note=NOT_SHOWN if zero else "fixed by the user")
    return tuple(found[i] for i in range(len(model.parameters))), tuple(combinations)


def _hardly_shown(p: Parameter, held: float) -> str:
    """Why the readings' value of a parameter is not stated."""
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
