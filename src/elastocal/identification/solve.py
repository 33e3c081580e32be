"""The course of a fit: place, tie weakly, choose the parameters, fit, compare, hold at bounds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import ElastocalError
from elastocal.identification.identifiability import (
    WORTH_A_COLUMN,
    Problem,
    Reduction,
    choose,
    fit_kept,
    free_r_factor,
    held_at_bounds,
    heldout_of,
    prefer_wider,
    residual_sigma,
)
from elastocal.identification.least_squares import Fit, fit
from elastocal.identification.residuals import rms_3d
from elastocal.identification.start import check_enough
from elastocal.identification.weighted_problem import (
    Part,
    RFactor,
    each,
    merge,
    regressor,
    residual_at,
    sample,
)
from elastocal.model.effects import effect_of
from elastocal.model.manipulator import Model
from elastocal.units import Array, Progress

# Width of the weak tie that keeps undetermined directions still before they are recognised:
# in typical sizes for deviations from nominal, in m and rad for what registration placed.
LOOSE, PLACED = 3.0, 0.3
# Relative change of the cost at which the tied fits of a large table end: what is placed is where
# parameters that get dropped are held for good; the fit of all is only where their choice begins.
PLACING, CHOOSING = 1e-14, 1e-2
# Observations that a large table's fit starts from.
SAMPLE = 5000


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
    sizes = sizes_and_check(problem)
    problem, found, reduction, r_factor, placed = settle(problem, sizes, progress)
    heldout = heldout_of(problem, found)
    if try_wider:
        progress("comparing with wider sets")
        found, reduction, heldout = prefer_wider(
            problem, sizes, found, reduction, heldout, r_factor
        )
    if problem.bounded:
        found, reduction = held_at_bounds(problem, sizes, found, reduction)
        heldout = heldout_of(problem, found)
    nominal = rms_3d(placed, problem.observations.size)
    return Solution(problem, found, reduction, sizes, heldout, nominal)


def settle(
    problem: Problem, sizes: Array, progress: Progress = lambda message: None
) -> tuple[Problem, Fit, Reduction, RFactor, Array]:
    """Place base and markers, choose a minimal complete set of parameters and fit it.

    Returns the problem with base and markers placed at x0, the fit, the set, the R factor of the
    free columns at the fit, and the residual (rows,) of the nominal arm so placed.

    Raises InsufficientDataError where the data determine nothing.
    """
    model = problem.model
    placed = problem.free[is_placed(model)[problem.free]]
    if len(placed):
        progress("placing base and markers")
        base = tied_fit(replace(problem, free=placed), sizes, PLACING)
        problem = replace(problem, x0=base.x)
        nominal = base.residual
    else:
        nominal = residual_at(model, problem.parts, problem.x0)
    progress("first fit, tied weakly to the start")
    found = tied_fit(problem, sizes, CHOOSING)
    progress("choosing the parameters that the data determine")
    sigma, kept, r_factor = residual_sigma(found, 0), None, found.r_factor
    for _ in range(5):
        reduction = choose(problem, sizes, r_factor, sigma, WORTH_A_COLUMN)
        if kept is not None and np.array_equal(kept, reduction.kept):
            break
        # The threshold is in units of the noise, and the noise is known only after the fit.
        kept = reduction.kept
        found = fit_kept(problem, sizes, found.x, reduction, again=True)
        sigma, r_factor = residual_sigma(found, len(kept)), free_r_factor(problem, found)
    return problem, found, reduction, r_factor, nominal


def is_placed(model: Model) -> NDArray[np.bool_]:
    """Which parameters (parameters,) registration places: base, markers, cable."""
    return np.array([effect_of(p.effect).registered for p in model.parameters], dtype=bool)


def sizes_and_check(problem: Problem) -> Array:
    """Typical sizes (parameters,) at the start; refuses where the equations are too few."""
    model, observed, free = problem.model, problem.observations, problem.free
    every = np.arange(len(model.parameters))
    few = len(observed.value) <= len(free)  # more equations than unknowns need no rank

    def of_part(part: Part) -> tuple[Array, RFactor | None]:
        at = regressor(model, part, problem.x0, every)
        r_factor = RFactor.of(at.B[:, free], at.residual) if few else None
        return np.abs(at.B).max(axis=0, initial=0.0), r_factor

    largest, factors = zip(*each(problem.parts, of_part), strict=True)
    sizes = model.sizes(np.stack(largest))
    sizes[is_placed(model)] = PLACED
    if few:
        check_enough(model, observed, merge(t for t in factors if t is not None).R * sizes[free])
    return sizes


def tied_fit(problem: Problem, sizes: Array, tolerance: float) -> Fit:
    """Fit of all free parameters with weak ties, scaled by a noise level found on the way.

    A large table starts where such a fit to a sample of it ends.
    """
    x = problem.x0
    if problem.large:
        part = sample(problem.parts, SAMPLE)
        rough = replace(problem, observations=part.observations, weights=part.weights)
        found = _tied_from(rough, sizes, x, _misfit(rough), tolerance)
        try:
            return _tied_from(problem, sizes, found.x, residual_sigma(found, 0), tolerance)
        except ElastocalError:
            pass  # the sample has led where other readings have no equilibrium
    return _tied_from(problem, sizes, x, _misfit(problem), tolerance)


def _misfit(problem: Problem) -> float:
    """Root mean square of the whitened residual at the start."""
    residual = problem.weights.apply(residual_at(problem.model, problem.parts, problem.x0))
    return max(float(np.sqrt(np.mean(residual**2))), 1e-12)


def _tied_from(problem: Problem, sizes: Array, x: Array, sigma: float, tolerance: float) -> Fit:
    """Tied fits from x until the noise level `sigma` that scales the ties no longer falls."""
    free = problem.free
    width = np.where(is_placed(problem.model), sizes, LOOSE * sizes)[free]
    while True:
        untied = replace(problem, bounded=False).fit_of(free, x, sizes)
        tied = replace(untied, tie=width / sigma, centre=problem.x0)
        found = fit(tied, max_steps=25, tolerance=tolerance)
        previous, sigma, x = sigma, residual_sigma(found, 0), found.x
        if sigma > 0.7 * previous or sigma <= 1e-12:
            return found
