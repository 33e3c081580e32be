"""The course of a fit: place, tie weakly, choose the parameters, fit, compare, hold at bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.checks import check_enough
from elastocal.identification.fit import Fit, FitProblem, fit
from elastocal.identification.heldout import rms_3d
from elastocal.identification.reduction import Reduction
from elastocal.identification.selection import (
    WORTH_A_COLUMN,
    Problem,
    held_at_bounds,
    heldout_of,
    prefer_wider,
    reduced_fit,
    residual_sigma,
)
from elastocal.manipulator.model import Model

Array = NDArray[np.float64]
Progress = Callable[[str], None]

# Width of the weak tie that keeps undetermined directions still before they are recognised:
# in typical sizes for deviations from nominal, in m and rad for what registration placed.
LOOSE, PLACED = 3.0, 0.3
PLACED_EFFECTS = ("base_frame", "marker_position", "marker_orientation", "distance_sensor")


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
    sizes[is_placed(model)] = PLACED
    check_enough(model, seen, start.B[:, problem.free] * sizes[problem.free])
    placed = problem.free[is_placed(model)[problem.free]]
    if len(placed):
        progress("placing base and markers")
        problem = replace(problem, x0=_tied_fit(replace(problem, free=placed), sizes).x)
    nominal = seen.value - model.predict(seen.table, problem.x0, seen)
    progress("first fit, tied weakly to the start")
    first = _tied_fit(problem, sizes)
    progress("choosing the parameters that the data determine")
    x, sigma, kept = first.x, residual_sigma(first, 0), None
    for _ in range(5):
        found, reduction = reduced_fit(problem, sizes, x, sigma, WORTH_A_COLUMN)
        if kept is not None and np.array_equal(kept, reduction.kept):
            break
        # The threshold is in units of the noise, and the noise is known only after the fit.
        x, sigma, kept = found.x, residual_sigma(found, len(reduction.kept)), reduction.kept
    heldout = heldout_of(problem, found.B, found.residual)
    if try_wider:
        progress("comparing with wider sets")
        found, reduction, heldout = prefer_wider(problem, sizes, found, reduction, heldout)
    if problem.bounded:
        found, reduction = held_at_bounds(problem, sizes, found, reduction)
        heldout = heldout_of(problem, found.B, found.residual)
    return Solution(problem, found, reduction, sizes, heldout, rms_3d(nominal, seen.size))


def is_placed(model: Model) -> NDArray[np.bool_]:
    """Which parameters (parameters,) registration places: base, markers, cable."""
    return np.array([p.effect in PLACED_EFFECTS for p in model.parameters], dtype=bool)


def _tied_fit(problem: Problem, sizes: Array) -> Fit:
    """Fit of all free parameters with weak ties, scaled by a noise level found on the way."""
    model, seen, free = problem.model, problem.observations, problem.free
    width = np.where(is_placed(model), sizes, LOOSE * sizes)[free]
    misfit = problem.weights.apply(seen.value - model.predict(seen.table, problem.x0, seen))
    sigma = max(float(np.sqrt(np.mean(misfit**2))), 1e-12)
    x = problem.x0
    while True:
        tied = FitProblem(model, seen, problem.weights, x, free, sizes, width / sigma, problem.x0)
        found = fit(tied, max_steps=25)
        previous, sigma, x = sigma, residual_sigma(found, 0), found.x
        if sigma > 0.7 * previous or sigma <= 1e-12:
            return found
