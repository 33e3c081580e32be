"""Constrained and regularised linear least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from elastocal.errors import require
from elastocal.identification.constrained.constraints import Constraints
from elastocal.identification.constrained.minimise import ActiveConstraint, minimise
from elastocal.identification.constrained.objective import LossName, Objective, loss_of
from elastocal.identification.constrained.prior import GaussianPrior, share_of_prior

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ConstrainedSolution:
    """Estimates x (p,) of the parameters `names`, residual y − B x (rows,), and their optimality.

    `objective` is Σ loss + prior, `rss` the residual's sum of squares.  `cofactor` (p, p) times
    the variance of a whitened row is the (posterior) covariance with the active constraints taken
    as equalities; for Huber's loss it is the inverse of half the Hessian, no covariance.
    `prior_share` (p,) says what share of each estimate's information is the prior's (0 without
    prior, NaN where constraints fix the value).  `kkt` is the relative KKT residual, about 1e-12
    at a minimum.
    """

    names: tuple[str, ...]
    x: Array
    residual: Array
    objective: float
    rss: float
    active: tuple[ActiveConstraint, ...]
    cofactor: Array
    prior_share: Array
    kkt: float

    @property
    def mostly_prior(self) -> tuple[str, ...]:
        """Parameters that owe more than half of their information to the prior."""
        share = np.nan_to_num(self.prior_share)
        return tuple(n for n, s in zip(self.names, share, strict=True) if s > 0.5)


def solve_constrained(
    B: ArrayLike,
    y: ArrayLike,
    names: Sequence[str],
    constraints: Constraints | None = None,
    *,
    prior: GaussianPrior | None = None,
    loss: LossName = "squares",
    size: int = 1,
    sigma: float = 1.0,
) -> ConstrainedSolution:
    """Minimise Σ ρ(y − B x) + σ² (x − m)ᵀ C⁻¹ (x − m) subject to the constraints.

    B (rows, p) and y (rows,) are whitened with rows of standard deviation `sigma`; `names` (p,)
    are the columns; m and C come from the prior (maximum a posteriori).  "squares" is ρ = |r|²;
    "huber" is Huber's loss of the length of each observation of `size` rows, with the threshold
    of 95 % efficiency.

    Squares under bounds and equalities are solved by Lawson and Hanson's LDP; matrices and
    Huber's loss by an interior-point method (Clarabel); both end with Newton steps on the active
    face, so that the result is good to rounding and not to a solver's tolerance.

    Raises InputError where names are unknown, numbers not finite, constraints contradict each
    other (and names those), or Clarabel is needed and missing; InsufficientDataError where data,
    prior and equalities leave a direction undetermined.
    """
    objective = objective_of(B, y, names, prior, loss, size, sigma)
    found = minimise(objective, (constraints or Constraints()).resolve(names))
    residual = objective.y - objective.B @ found.x
    return ConstrainedSolution(
        tuple(names),
        found.x,
        residual,
        found.objective,
        float(residual @ residual),
        found.active,
        found.cofactor,
        share_of_prior(found.cofactor, objective.P),
        found.kkt,
    )


def objective_of(
    B: ArrayLike,
    y: ArrayLike,
    names: Sequence[str],
    prior: GaussianPrior | None,
    loss: LossName,
    size: int,
    sigma: float,
) -> Objective:
    """The checked objective of `solve_constrained`."""
    B, y = np.asarray(B, dtype=float), np.asarray(y, dtype=float)
    p = len(names)
    require(
        B.ndim == 2 and B.shape[1] == p and y.shape == B.shape[:1],
        f"B must be (rows, {p}) for {p} names and y (rows,); found {B.shape} and {y.shape}",
    )
    require(len(set(names)) == p and p > 0, "the names of the columns must differ, at least one")
    require(bool(np.isfinite(B).all() and np.isfinite(y).all()), "B and y must be finite")
    require(bool(np.isfinite(sigma) and sigma > 0), f"sigma must be positive, found {sigma}")
    rho = loss_of(loss, size, sigma)
    require(len(y) % size == 0, f"{len(y)} rows are no multiple of {size} per observation")
    P, target = (np.zeros((0, p)), np.zeros(0)) if prior is None else prior.rows(names)
    return Objective(B, y, sigma * P, sigma * target, rho)
