"""Which parameters are fitted: a minimal complete set, a wider one, what ends at a bound."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import ElastocalError, InsufficientDataError
from elastocal.identification.fit import Fit, FitProblem, fit
from elastocal.identification.heldout import held_out_residual, rms_3d
from elastocal.identification.linear import solve_weighted
from elastocal.identification.noise import Weights
from elastocal.identification.reduction import Reduction, reduce
from elastocal.manipulator.model import Model
from elastocal.manipulator.observation import Observations

Array = NDArray[np.float64]

# A typical deviation must move the data by this many standard deviations to earn a column:
# at 1, the variance it adds equals the squared bias it removes.
WORTH_A_COLUMN = 1.0
WIDER = (0.1, 0.01, 0.0)


@dataclass(frozen=True)
class Problem:
    """Fit the parameters `free` of the model to the observations, from x0 (parameters,)."""

    model: Model
    observations: Observations
    weights: Weights
    x0: Array
    free: NDArray[np.int64]
    bounded: bool = False


def residual_sigma(found: Fit, n_parameters: int) -> float:
    """Standard deviation of a whitened row: √(rss / (rows − parameters))."""
    dof = max(len(found.whitened) - n_parameters, 1)
    return max(float(np.sqrt(found.whitened @ found.whitened / dof)), 1e-12)


def reduced_fit(
    problem: Problem, sizes: Array, x: Array, sigma: float, threshold: float
) -> tuple[Fit, Reduction]:
    """Choose a minimal complete set at x and fit it, the others held at the start."""
    chosen = _reduction(problem, sizes, _free_columns(problem, x), sigma, threshold)
    return _fit_of(problem, sizes, x, chosen, max_steps=60), chosen


def _free_columns(problem: Problem, x: Array) -> Array:
    """Whitened B (rows, free) at x."""
    seen = problem.observations
    return problem.weights.apply(problem.model.regressor(seen.table, x, problem.free, seen).B)


def _reduction(
    problem: Problem, sizes: Array, B: Array, sigma: float, threshold: float
) -> Reduction:
    """A minimal complete set of the whitened B (rows, free), as indices into all parameters."""
    seen, free = problem.observations, problem.free
    parameters = tuple(problem.model.parameters[c] for c in free)
    local = reduce(B, sizes[free], parameters, sigma, threshold)
    if not len(local.kept):
        raise InsufficientDataError(
            f"{seen.table.source}: the readings do not depend on any parameter of the model; "
            "measure other poses or loads, or choose other effects"
        )
    return Reduction(free[local.kept], free[local.dropped], local.mixing, free[local.invisible])


def _fit_of(problem: Problem, sizes: Array, x: Array, chosen: Reduction, max_steps: int) -> Fit:
    """Fit of the kept parameters, the others held at the start; their share moves over first."""
    kept, dropped = chosen.kept, chosen.dropped
    start = x.copy()
    start[dropped] = problem.x0[dropped]
    shifted = start.copy()
    shifted[kept] += chosen.mixing @ (x[dropped] - problem.x0[dropped])
    seen = problem.observations
    # The share is a linear estimate: a soft arm may have no equilibrium so far out.
    for trial in (shifted, start, problem.x0):
        start = trial
        if np.isfinite(problem.model.predict(seen.table, trial, seen)).all():
            break
    final = FitProblem(
        problem.model, problem.observations, problem.weights, start, kept, sizes,
        bounded=problem.bounded,
    )  # fmt: skip
    return fit(final, max_steps)


def heldout_of(problem: Problem, B: Array, residual: Array) -> Array:
    seen = problem.observations
    return held_out_residual(B, residual, problem.weights, seen.configuration, seen.size)


def prefer_wider(
    problem: Problem, sizes: Array, found: Fit, reduction: Reduction, heldout: Array
) -> tuple[Fit, Reduction, Array]:
    """A wider set, up to full rank, where it predicts held-out configurations better.

    Typical sizes are prior knowledge and may be wrong for this arm; held-out data decide, first
    on the linearised model, then on the refitted one.
    """
    size = problem.observations.size
    B = _free_columns(problem, found.x)
    for threshold in WIDER:
        sigma = residual_sigma(found, len(reduction.kept))
        wider = _reduction(problem, sizes, B, sigma, threshold)
        if len(wider.kept) <= len(reduction.kept):
            continue
        x, linear_heldout = _linear_step(problem, found.x, wider)
        if rms_3d(linear_heldout, size) >= rms_3d(heldout, size):
            continue
        try:
            wide = _fit_of(problem, sizes, x, wider, max_steps=30)
        except (ElastocalError, np.linalg.LinAlgError, ValueError):
            continue  # along an undetermined direction the wide set may leave every valid arm
        wide_heldout = heldout_of(problem, wide.B, wide.residual)
        if wide.converged and rms_3d(wide_heldout, size) < rms_3d(heldout, size):
            found, reduction, heldout = wide, wider, wide_heldout
            B = _free_columns(problem, found.x)
    return found, reduction, heldout


def _linear_step(problem: Problem, x: Array, chosen: Reduction) -> tuple[Array, Array]:
    """x after one Gauss–Newton step of the chosen set, and the linear model's held-out residual."""
    seen, weights = problem.observations, problem.weights
    at = problem.model.regressor(seen.table, x, chosen.kept, seen)
    step = solve_weighted(weights.apply(at.B), weights.apply(at.residual)).x
    moved = x.copy()
    moved[chosen.kept] += step
    return moved, heldout_of(problem, at.B, at.residual - at.B @ step)


def held_at_bounds(
    problem: Problem, sizes: Array, found: Fit, chosen: Reduction
) -> tuple[Fit, Reduction]:
    """Refit with the parameters that ended at a bound held there: they have no interval."""
    lower, upper = (
        np.array([getattr(problem.model.parameters[c], side) for c in chosen.kept])
        for side in ("lower", "upper")
    )
    x, slack = found.x[chosen.kept], 1e-6 * sizes[chosen.kept]
    at = (x <= lower + slack) | (x >= upper - slack)
    if not at.any():
        return found, chosen
    start = found.x.copy()
    start[chosen.kept[at]] = np.where(x <= lower + slack, lower, upper)[at]
    kept = chosen.kept[~at]
    if not len(kept):
        return found, chosen
    final = FitProblem(
        problem.model, problem.observations, problem.weights, start, kept, sizes, bounded=True
    )
    inner = replace(chosen, kept=kept, mixing=chosen.mixing[~at], at_bound=chosen.kept[at])
    return fit(final), inner
