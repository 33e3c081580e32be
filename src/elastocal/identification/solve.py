"""The fit with its choice of parameters: weak ties first, then a minimal complete set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import ElastocalError, InsufficientDataError
from elastocal.identification.checks import check_enough
from elastocal.identification.fit import Fit, FitProblem, fit
from elastocal.identification.heldout import held_out_residual, rms_3d
from elastocal.identification.linear import solve_weighted
from elastocal.identification.noise import Weights
from elastocal.identification.reduction import Reduction, reduce
from elastocal.manipulator.model import Model
from elastocal.manipulator.observation import Observations

Array = NDArray[np.float64]
Progress = Callable[[str], None]

# Width of the weak tie that keeps undetermined directions still before they are recognised:
# in typical sizes for deviations from nominal, in m and rad for what registration placed.
LOOSE, PLACED = 3.0, 0.3
PLACED_EFFECTS = ("base_frame", "marker_position", "marker_orientation", "distance_sensor")

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


@dataclass(frozen=True)
class Solution:
    """The fit of the kept set, which parameters those are, and how well it predicts.

    `reduction` holds indices into the model's parameters; `heldout` (rows,) residuals of each
    configuration under a fit to the others; `nominal_rms` the 3-D rms in m of the nominal arm
    with only base, markers and cable placed.
    """

    problem: Problem
    fit: Fit
    reduction: Reduction
    sizes: Array
    heldout: Array
    nominal_rms: float


def solve(
    problem: Problem, progress: Progress = lambda message: None, try_wider: bool = True
) -> Solution:
    """Solve `problem`; `try_wider` False skips the comparison with wider sets of parameters.

    Raises InsufficientDataError where the data determine nothing.
    """
    model, seen = problem.model, problem.observations
    start = model.regressor(seen.table, problem.x0, None, seen)
    sizes = model.sizes(start.B)
    check_enough(model, seen, start.B[:, problem.free] * sizes[problem.free])
    placed = np.array([c for c in problem.free if model.parameters[c].effect in PLACED_EFFECTS])
    if len(placed):
        progress("placing base and markers")
        problem = replace(problem, x0=_tied_fit(replace(problem, free=placed), sizes).x)
    nominal = seen.value - model.predict(seen.table, problem.x0, seen)
    progress("first fit, tied weakly to the start")
    first = _tied_fit(problem, sizes)
    progress("choosing the parameters that the data determine")
    x, sigma, kept = first.x, residual_sigma(first, 0), None
    for _ in range(5):
        found, reduction = _reduced_fit(problem, sizes, x, sigma, WORTH_A_COLUMN)
        if kept is not None and np.array_equal(kept, reduction.kept):
            break
        # The threshold is in units of the noise, and the noise is known only after the fit.
        x, sigma, kept = found.x, residual_sigma(found, len(reduction.kept)), reduction.kept
    heldout = _heldout(problem, found.B, found.residual)
    if try_wider:
        progress("comparing with wider sets")
        found, reduction, heldout = _prefer_wider(problem, sizes, found, reduction, heldout)
    return Solution(problem, found, reduction, sizes, heldout, rms_3d(nominal, seen.size))


def residual_sigma(found: Fit, n_parameters: int) -> float:
    """Standard deviation of a whitened row: √(rss / (rows − parameters))."""
    dof = max(len(found.whitened) - n_parameters, 1)
    return max(float(np.sqrt(found.whitened @ found.whitened / dof)), 1e-12)


def _tied_fit(problem: Problem, sizes: Array) -> Fit:
    """Fit of all free parameters with weak ties, scaled by a noise level found on the way."""
    model, seen, free = problem.model, problem.observations, problem.free
    placed = np.array([p.effect in PLACED_EFFECTS for p in model.parameters])
    width = np.where(placed, PLACED, LOOSE * sizes)[free]
    misfit = problem.weights.apply(seen.value - model.predict(seen.table, problem.x0, seen))
    sigma = max(float(np.sqrt(np.mean(misfit**2))), 1e-12)
    x = problem.x0
    while True:
        tied = FitProblem(
            model, seen, problem.weights, x, free, sizes, width / sigma, problem.x0
        )
        found = fit(tied, max_steps=25)
        previous, sigma, x = sigma, residual_sigma(found, 0), found.x
        if sigma > 0.7 * previous or sigma <= 1e-12:
            return found


def _reduction(
    problem: Problem, sizes: Array, x: Array, sigma: float, threshold: float
) -> Reduction:
    """A minimal complete set at x, as indices into the model's parameters."""
    model, seen, free = problem.model, problem.observations, problem.free
    B = problem.weights.apply(model.regressor(seen.table, x, free, seen).B)
    parameters = tuple(model.parameters[c] for c in free)
    local = reduce(B, sizes[free], parameters, sigma, threshold)
    if not len(local.kept):
        raise InsufficientDataError(
            f"{seen.table.source}: the readings do not depend on any parameter of the model; "
            "measure other poses or loads, or choose other effects"
        )
    return Reduction(
        free[local.kept], free[local.dropped], local.mixing, free[local.invisible]
    )


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


def _reduced_fit(
    problem: Problem, sizes: Array, x: Array, sigma: float, threshold: float
) -> tuple[Fit, Reduction]:
    chosen = _reduction(problem, sizes, x, sigma, threshold)
    return _fit_of(problem, sizes, x, chosen, max_steps=60), chosen


def _heldout(problem: Problem, B: Array, residual: Array) -> Array:
    seen = problem.observations
    return held_out_residual(B, residual, problem.weights, seen.configuration, seen.size)


def _prefer_wider(
    problem: Problem, sizes: Array, found: Fit, reduction: Reduction, heldout: Array
) -> tuple[Fit, Reduction, Array]:
    """A wider set, up to full rank, where it predicts held-out configurations better.

    Typical sizes are prior knowledge and may be wrong for this arm; held-out data decide, first
    on the linearised model, then on the refitted one.
    """
    size = problem.observations.size
    for threshold in WIDER:
        sigma = residual_sigma(found, len(reduction.kept))
        wider = _reduction(problem, sizes, found.x, sigma, threshold)
        if len(wider.kept) <= len(reduction.kept):
            continue
        x, linear_heldout = _linear_step(problem, found.x, wider)
        if rms_3d(linear_heldout, size) >= rms_3d(heldout, size):
            continue
        try:
            wide = _fit_of(problem, sizes, x, wider, max_steps=30)
        except (ElastocalError, np.linalg.LinAlgError, ValueError):
            continue  # along an undetermined direction the wide set may leave every valid arm
        wide_heldout = _heldout(problem, wide.B, wide.residual)
        if wide.converged and rms_3d(wide_heldout, size) < rms_3d(heldout, size):
            found, reduction, heldout = wide, wider, wide_heldout
    return found, reduction, heldout


def _linear_step(problem: Problem, x: Array, chosen: Reduction) -> tuple[Array, Array]:
    """x after one Gauss–Newton step of the chosen set, and the linear model's held-out residual."""
    seen, weights = problem.observations, problem.weights
    at = problem.model.regressor(seen.table, x, chosen.kept, seen)
    step = solve_weighted(weights.apply(at.B), weights.apply(at.residual)).x
    moved = x.copy()
    moved[chosen.kept] += step
    return moved, _heldout(problem, at.B, at.residual - at.B @ step)
