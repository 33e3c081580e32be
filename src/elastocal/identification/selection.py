"""Which parameters are fitted: a minimal complete set, a wider one, what ends at a bound."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import ElastocalError, InsufficientDataError
from elastocal.identification.chunked import evaluate
from elastocal.identification.fit import Fit, FitProblem, fit
from elastocal.identification.heldout import held_out_by_parts, held_out_residual, rms_3d
from elastocal.identification.linear import solve_weighted
from elastocal.identification.noise import Weights
from elastocal.identification.partition import Partition, is_large, partition
from elastocal.identification.reduction import Reduction, reduce
from elastocal.identification.triangle import Triangle
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

    @cached_property
    def parts(self) -> Partition:
        """The table cut into parts that can be worked on alone: one, unless it is large."""
        return partition(self.observations, self.weights, len(self.model.parameters))

    @property
    def large(self) -> bool:
        return is_large(self.observations, len(self.model.parameters))

    def fit_of(self, columns: NDArray[np.int64], x: Array, sizes: Array) -> FitProblem:
        """The fit of `columns` from x, the other parameters held."""
        return FitProblem(
            self.model, self.observations, self.weights, x, columns, sizes,
            bounded=self.bounded, cut=self.parts,
        )  # fmt: skip


def residual_sigma(found: Fit, n_parameters: int) -> float:
    """Standard deviation of a whitened row: √(rss / (rows − parameters))."""
    dof = max(len(found.whitened) - n_parameters, 1)
    return max(float(np.sqrt(found.whitened @ found.whitened / dof)), 1e-12)


def free_triangle(problem: Problem, found: Fit) -> Triangle:
    """The triangle of the free columns at the fitted values."""
    if np.array_equal(found.columns, problem.free):
        return found.triangle
    if found.wide is not None:
        return found.wide
    return evaluate(problem.model, problem.parts, found.x, problem.free).triangle


def choose(
    problem: Problem, sizes: Array, triangle: Triangle, sigma: float, threshold: float
) -> Reduction:
    """A minimal complete set of the free columns, as indices into all parameters.

    Raises InsufficientDataError where no column is worth keeping.
    """
    seen, free = problem.observations, problem.free
    parameters = tuple(problem.model.parameters[c] for c in free)
    local = reduce(triangle.R, sizes[free], parameters, sigma, threshold)
    if not len(local.kept):
        raise InsufficientDataError(
            f"{seen.table.source}: the readings do not depend on any parameter of the model; "
            "measure other poses or loads, or choose other effects"
        )
    return Reduction(free[local.kept], free[local.dropped], local.mixing, free[local.invisible])


def fit_kept(
    problem: Problem, sizes: Array, x: Array, chosen: Reduction, max_steps: int = 60,
    *, again: bool = False,
) -> Fit:  # fmt: skip
    """Fit of the kept parameters, the others held at the start; their share moves over first.

    `again` says that there will be another choice at its end, by `free_triangle`.
    """
    kept, dropped = chosen.kept, chosen.dropped
    among = problem.free if again else None
    start = x.copy()
    start[dropped] = problem.x0[dropped]
    shifted = start.copy()
    shifted[kept] += chosen.mixing @ (x[dropped] - problem.x0[dropped])
    # The share is a linear estimate: a soft arm may have no equilibrium so far out.
    for trial in (shifted, start):
        try:
            return fit(replace(problem.fit_of(kept, trial, sizes), among=among), max_steps)
        except ElastocalError:
            continue
    return fit(replace(problem.fit_of(kept, problem.x0, sizes), among=among), max_steps)


def heldout_of(problem: Problem, found: Fit) -> Array:
    """Residual (rows,) of each configuration under a fit to the others."""
    if not problem.large:
        seen = problem.observations
        return held_out_residual(
            found.B, found.residual, problem.weights, seen.configuration, seen.size
        )
    return held_out_by_parts(
        problem.model, problem.parts, found.x, found.columns, found.triangle,
        np.zeros(len(found.columns)),
    )  # fmt: skip


def prefer_wider(
    problem: Problem, sizes: Array, found: Fit, reduction: Reduction, heldout: Array,
    triangle: Triangle,
) -> tuple[Fit, Reduction, Array]:  # fmt: skip
    """A wider set, up to full rank, where it predicts held-out configurations better.

    Typical sizes are prior knowledge and may be wrong for this arm; held-out data decide, first
    on the linearised model, then on the refitted one.  `triangle` of the free columns at the fit.
    """
    size = problem.observations.size
    for threshold in WIDER:
        sigma = residual_sigma(found, len(reduction.kept))
        wider = choose(problem, sizes, triangle, sigma, threshold)
        if len(wider.kept) <= len(reduction.kept):
            continue
        x, linear_heldout = _linear_step(problem, sizes, found.x, wider, triangle)
        if rms_3d(linear_heldout, size) >= rms_3d(heldout, size):
            continue
        try:
            wide = fit_kept(problem, sizes, x, wider, max_steps=30, again=True)
        except (ElastocalError, np.linalg.LinAlgError, ValueError):
            continue  # along an undetermined direction the wide set may leave every valid arm
        wide_heldout = heldout_of(problem, wide)
        if wide.converged and rms_3d(wide_heldout, size) < rms_3d(heldout, size):
            found, reduction, heldout = wide, wider, wide_heldout
            triangle = free_triangle(problem, found)
    return found, reduction, heldout


def _linear_step(
    problem: Problem, sizes: Array, x: Array, chosen: Reduction, triangle: Triangle
) -> tuple[Array, Array]:
    """x after one Gauss–Newton step of the chosen set, and the linear model's held-out residual."""
    kept, seen = chosen.kept, problem.observations
    moved = x.copy()
    if not problem.large:
        at = problem.model.regressor(seen.table, x, kept, seen)
        B, e = problem.weights.apply(at.B), problem.weights.apply(at.residual)
        step = solve_weighted(B, e).x
        moved[kept] += step
        residual = at.residual - at.B @ step
        held = held_out_residual(at.B, residual, problem.weights, seen.configuration, seen.size)
        return moved, held
    own = triangle.of_columns(np.searchsorted(problem.free, kept))
    step = own.step(sizes[kept])
    moved[kept] += step
    return moved, held_out_by_parts(problem.model, problem.parts, x, kept, own, step)


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
    inner = replace(chosen, kept=kept, mixing=chosen.mixing[~at], at_bound=chosen.kept[at])
    return fit(problem.fit_of(kept, start, sizes)), inner
