"""Robust fit of the nonlinear model: linear robust steps on the exact B."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import ElastocalError, require
from elastocal.identification.covariance.estimate import Covariance
from elastocal.identification.fit import FitProblem
from elastocal.identification.robust.asymptotic import Kind, asymptotic_covariance
from elastocal.identification.robust.clustered import clustered_covariance
from elastocal.identification.robust.design import lengths
from elastocal.identification.robust.estimate import RobustEstimate
from elastocal.identification.robust.loss import Absolute
from elastocal.identification.robust.m_estimate import m_estimate
from elastocal.identification.robust.mm_estimate import mm_estimate
from elastocal.identification.robust.student_t import student_t
from elastocal.identification.robust.tuning import huber

Array = NDArray[np.float64]
LossName = Literal["huber", "tukey", "l1", "student-t"]

SETTLED = 1e-7  # |B δx| in units of the scale at which the steps have converged
MAX_STEPS = 40
SEARCHES = 2  # steps whose S-estimate is searched by random subsets; later ones follow it


@dataclass(frozen=True)
class RobustFit:
    """x (parameters,), raw and whitened residual (rows,), observation weights (n,), scale.

    `scale` is that of a whitened row.  `linear` is the robust estimate of the linearised model at
    x, whose step is negligible; `weights` are ψ(d)/d, not inverse variances.
    """

    x: Array
    residual: Array
    whitened: Array
    linear: RobustEstimate
    converged: bool
    steps: int

    @property
    def scale(self) -> float:
        return self.linear.scale

    @property
    def weights(self) -> Array:
        return self.linear.weights

    def covariance(self, kind: Kind = "H2") -> Covariance:
        """Covariance of the fitted columns for independent errors (`asymptotic`)."""
        return asymptotic_covariance(self.linear, kind)

    def clustered(self, cluster: NDArray[np.int64]) -> Covariance:
        """Covariance of the fitted columns under dependence within `cluster` (n,)."""
        return clustered_covariance(self.linear, cluster)


def robust_fit(
    problem: FitProblem, loss_name: LossName = "tukey", size: int | None = None, seed: int = 0
) -> RobustFit:
    """Minimise Σ ρ(|W (y − h(X))_i|/σ) over X[columns] by damped Gauss–Newton steps.

    Each step is the robust linear fit of the whitened residual to the whitened B at X: "huber"
    (95 % efficient, σ by the median), "tukey" (MM-estimate), "l1", or "student-t" (ML, ν
    estimated); it is halved until Σ ρ at the step's σ falls.  `size` rows per observation share a
    weight (by default the observations' size); `seed` fixes the search of the S-estimate.

    Whitening by a covariance that couples observations (deflections that share an unloaded
    reading) mixes them: a bad reading then also shows in those whitened after it.

    Raises InputError for an unknown loss, a problem with ties or bounds, or dependent columns;
    ElastocalError where the start has poses without equilibrium.
    """
    require(
        loss_name in get_args(LossName),
        f"the loss is one of {', '.join(get_args(LossName))}; found '{loss_name}'",
    )
    require(
        problem.tie is None and not problem.bounded,
        "a robust fit takes neither ties nor bounds: fit the reduced set of parameters, unbounded",
    )
    model, seen, columns = problem.model, problem.observations, problem.columns
    per_reading = seen.size if size is None else size
    sizes = problem.sizes[columns]
    x, converged, steps = problem.x.copy(), False, 0

    def linearised(x: Array) -> tuple[Array, Array, Array]:
        at = model.regressor(seen.table, x, columns, seen)
        return problem.weights.apply(at.B), problem.weights.apply(at.residual), at.residual

    B, e, raw = linearised(x)
    while True:
        found = _step(B * sizes, e, loss_name, per_reading, seed, steps < SEARCHES)
        moved = float(np.linalg.norm(B @ (found.x * sizes)))
        converged = moved <= SETTLED * found.scale * np.sqrt(len(columns))
        if converged or steps == MAX_STEPS:
            break
        share = _damping(problem, x, found, sizes, e)
        if share == 0.0:
            break
        x[columns] += share * found.x * sizes
        B, e, raw = linearised(x)
        steps += 1
    linear = _step(B, e, loss_name, per_reading, seed, False)
    return RobustFit(x, raw, e, linear, converged, steps)


def _step(
    B: Array, e: Array, loss_name: LossName, size: int, seed: int, search: bool
) -> RobustEstimate:
    if loss_name == "huber":
        return m_estimate(B, e, huber(size), size=size)
    if loss_name == "l1":
        return m_estimate(B, e, Absolute(size), size=size)
    if loss_name == "student-t":
        return student_t(B, e, size=size)
    if search:
        return mm_estimate(B, e, size=size, seed=seed, start=np.zeros(B.shape[1]))
    return mm_estimate(B, e, size=size, subsets=0, start=np.zeros(B.shape[1]))


def _damping(problem: FitProblem, x: Array, found: RobustEstimate, sizes: Array, e: Array) -> float:
    """Largest of 1, ½, ¼, … of the step that lowers Σ ρ at its scale; 0 where none does."""
    size, seen = found.design.size, problem.observations
    before = float(found.loss.rho(lengths(e, size) / found.scale).sum())
    rounding = 1e-12 * before
    for k in range(20):
        share = 0.5**k
        trial = x.copy()
        trial[problem.columns] += share * found.x * sizes
        try:
            residual = seen.value - problem.model.predict(seen.table, trial, seen)
        except ElastocalError:
            continue
        d = lengths(problem.weights.apply(residual), size) / found.scale
        if np.isfinite(d).all() and float(found.loss.rho(d).sum()) <= before + rounding:
            return share
    return 0.0
