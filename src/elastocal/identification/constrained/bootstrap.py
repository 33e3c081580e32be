"""Parametric bootstrap of constrained estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from elastocal.errors import require
from elastocal.identification.constrained.constraints import Constraints
from elastocal.identification.constrained.minimise import minimise
from elastocal.identification.constrained.objective import LossName, Objective
from elastocal.identification.constrained.prior import GaussianPrior
from elastocal.identification.constrained.solve import objective_of
from elastocal.identification.constrained.system import System
from elastocal.identification.covariance.parametric_bootstrap import (
    ParametricBootstrap,
    parametric_bootstrap,
)

Array = NDArray[np.float64]


def constrained_bootstrap(
    B: ArrayLike,
    y: ArrayLike,
    names: Sequence[str],
    constraints: Constraints,
    *,
    prior: GaussianPrior | None = None,
    loss: LossName = "squares",
    size: int = 1,
    sigma: float | None = None,
    draws: int = 999,
    seed: int = 0,
    jobs: int = 1,
) -> ParametricBootstrap:
    """Fit B x̂ + s·N(0, 1) again `draws` times under the same constraints (see its `interval`).

    B (rows, p), y (rows,) whitened; s is `sigma` or, where None, from s² = rss/(rows − p).  The
    prior's mean is drawn anew as well, about x̂ with its own covariance: like the data it is an
    observation of the parameters, so the spread of the draws is the posterior's.

    Draws pile up on an active bound, whose percentile interval is then one-sided.  With the truth
    on a bound the bootstrap is not consistent (Andrews 2000): there, prefer profile intervals.

    Raises InputError as `solve_constrained` does, and for a prior without `sigma`.
    """
    require(prior is None or sigma is not None, "with a prior the noise must be known: state sigma")
    objective = objective_of(B, y, names, prior, loss, size, sigma or 1.0)
    system = constraints.resolve(names)
    best = minimise(objective, system)
    rows, p = objective.B.shape
    residual = objective.y - objective.B @ best.x
    require(rows > p or sigma is not None, "no degree of freedom is left; state the noise as sigma")
    spread = float(np.sqrt(residual @ residual / (rows - p))) if sigma is None else sigma
    exact = np.concatenate([objective.B @ best.x, objective.P @ best.x])
    return parametric_bootstrap(
        partial(_draw, exact, spread), partial(_refit, objective, system), draws, seed, jobs
    )


def _draw(exact: Array, spread: float, rng: np.random.Generator) -> Array:
    return exact + spread * rng.normal(size=len(exact))


def _refit(objective: Objective, system: System, drawn: Array) -> Array:
    rows = len(objective.y)
    return minimise(replace(objective, y=drawn[:rows], target=drawn[rows:]), system).x
