"""Nonlinear weighted least squares on the exact B: Levenberg–Marquardt, and the fit it ends in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import ElastocalError
from elastocal.identification.weighted_problem import (
    Evaluation,
    Partition,
    RFactor,
    Weights,
    evaluate,
    is_large,
    is_reduced,
    least_norm,
    partition,
)
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.units import Array

# Levenberg–Marquardt on R factors, where one evaluation is a pass over a large table.

SETTLED = "the sum of squares no longer fell"
NEGLIGIBLE = "the steps became negligible"
EXHAUSTED = "the step limit was reached; the start may be far off or the data ill-conditioned"

LEAST_DAMPING = 1e-18  # of the largest squared column, once a full step has failed
SHORTER = 0.3
ROUNDING = 1e-12  # relative: what separates two evaluations at the minimum


@dataclass(frozen=True)
class Descent:
    """Where it ended: variables u (p,), the evaluation there, why, and after how many."""

    u: Array
    at: Evaluation
    converged: bool
    reason: str
    evaluations: int


@dataclass(frozen=True)
class SumOfSquares:
    """|e(u)|² + |(u − centre)/tie|², B = −∂e/∂u.

    `evaluate` gives the R factor of e and of B per unit of u, (p,) in typical sizes; it raises
    ElastocalError where the model has no prediction.  A `tie` (p,) of infinity is none.
    `evaluate_last`, where given, evaluates in its place where the descent means to end: for what
    else is wanted there.
    """

    evaluate: Callable[[Array], Evaluation]
    tie: Array
    centre: Array
    evaluate_last: Callable[[Array], Evaluation] | None = None

    def cost(self, u: Array, at: Evaluation) -> float:
        """The sum of squares, ties included."""
        return at.r_factor.rss + float(np.sum(((u - self.centre) / self.tie) ** 2))

    def step(self, u: Array, at: Evaluation, damping: float) -> tuple[Array, float]:
        """Minimiser of the linearised cost + damping · |step|², and by how much the cost falls."""
        p = len(u)
        A = np.vstack([at.r_factor.R, np.diag(1 / self.tie)])
        b = np.concatenate([at.r_factor.projected, (self.centre - u) / self.tie])
        damped = np.vstack([A, np.sqrt(damping) * np.eye(p)])
        target = np.concatenate([b, np.zeros(p)])
        cond = max(at.r_factor.rows, p) * np.finfo(float).eps
        step = least_norm(damped, target, cond=cond)
        left = b - A @ step
        return step, float(b @ b - left @ left)


def descend(objective: SumOfSquares, u: Array, tolerance: float, max_evaluations: int) -> Descent:
    """Full Gauss–Newton steps while they lower the cost, damped ones where they do not.

    Ends where the linearised cost promises less than `tolerance` of itself: that last step is
    still taken, and leaves an error smaller than itself by the factor with which Gauss–Newton
    converges.  Steps are judged by the cost itself, so no rounding of it can keep it from ending.

    Raises ElastocalError where the start has no prediction.
    """
    ending = objective.evaluate_last or objective.evaluate
    at = objective.evaluate(u)
    cost, damping, evaluations = objective.cost(u, at), 0.0, 1
    failed = -1.0  # the damping that was too little a step ago
    while evaluations < max_evaluations:
        step, promised = objective.step(u, at, damping)
        last = promised <= tolerance * cost
        if last and np.abs(step).max(initial=0.0) <= ROUNDING:
            return Descent(u, at, True, NEGLIGIBLE, evaluations)
        evaluations += 1
        try:
            trial = (ending if last else objective.evaluate)(u + step)
            trial_cost = objective.cost(u + step, trial)
        except ElastocalError:
            trial, trial_cost = at, np.inf
        if last and (damping == 0 or failed >= 0):  # more than what is left is not to be had
            kept = trial_cost <= cost * (1 + ROUNDING)
            at, u = (trial, u + step) if kept else (at, u)
            return Descent(u, at, True, SETTLED, evaluations)
        if cost - trial_cost > 1e-4 * promised:
            u, at, cost = u + step, trial, trial_cost
            less = damping / 10 if damping > LEAST_DAMPING * _steepest(at) else 0.0
            damping, failed = (damping, failed / 100) if less <= failed else (less, failed)
        elif np.abs(step).max(initial=0.0) <= ROUNDING:
            return Descent(u, at, True, NEGLIGIBLE, evaluations)
        else:
            failed, damping = damping, _shortened(objective, u, at, damping, step)
    return Descent(u, at, False, EXHAUSTED, evaluations)


def _shortened(
    objective: SumOfSquares, u: Array, at: Evaluation, damping: float, step: Array
) -> float:
    """The damping with which a step that failed has at most SHORTER of its length."""
    longest = SHORTER * float(np.linalg.norm(step))
    damping = max(10 * damping, LEAST_DAMPING * _steepest(at))
    while np.linalg.norm(objective.step(u, at, damping)[0]) > longest:
        damping *= 10
    return damping


def _steepest(at: Evaluation) -> float:
    """The largest squared column of B."""
    return float((at.r_factor.R**2).sum(axis=0).max(initial=0.0))


# Nonlinear weighted least squares on the exact B.

# What a step promises of the cost where the descent ends.  The last step is taken: at a million
# rows of a large table, whose evaluations are dear, it is a tenth of a standard deviation, and what
# it leaves behind is smaller by orders.
TOLERANCE, LARGE_TOLERANCE = 1e-12, 1e-8


@dataclass(frozen=True)
class Problem:
    """Fit parameters among those that are `free` to the observations, the others held at x0
    (parameters,)."""

    model: Model
    observations: Observations
    weights: Weights
    x0: Array
    free: NDArray[np.int64]

    @cached_property
    def parts(self) -> Partition:
        """The table cut into parts that can be worked on alone: one, unless it is large."""
        return partition(self.observations, self.weights, int((~self.model.shrunk).sum()))

    @property
    def large(self) -> bool:
        return is_large(self.observations, int((~self.model.shrunk).sum()))

    @property
    def many(self) -> bool:
        """Whether the readings are so many that an evaluation is dear."""
        return is_reduced(self.observations, int((~self.model.shrunk).sum()))


@dataclass(frozen=True)
class Fit:
    """Values x (parameters,), raw and whitened residual (rows,), R factor of whitened B and it.

    `columns` (fitted,) index the parameters, `sizes` (parameters,) their typical sizes; `wide`,
    where there is one, is the R factor of the columns that these were chosen among.
    """

    x: Array
    residual: Array
    whitened: Array
    r_factor: RFactor
    converged: bool
    reason: str
    steps: int
    problem: Problem = field(repr=False)
    columns: NDArray[np.int64]
    sizes: Array
    wide: RFactor | None = field(default=None, repr=False)

    @cached_property
    def B(self) -> Array:
        """B (rows, fitted) at x, raw.  Formed on demand: of a large table, use `r_factor`."""
        observed = self.problem.observations
        return self.problem.model.regressor(observed.table, self.x, self.columns, observed).B

    def cofactor(self) -> Array:
        """(BᵀW²B)⁻¹ (fitted, fitted): covariance at unit variance (eq. 7 and 13)."""
        return self.r_factor.cofactor(self.sizes[self.columns])


def fit(
    problem: Problem, columns: NDArray[np.int64], x: Array, sizes: Array, *,
    tie: Array | None = None, among: NDArray[np.int64] | None = None, max_steps: int = 60,
    tolerance: float = LARGE_TOLERANCE,
) -> Fit:  # fmt: skip
    """min over X[columns] of |W (y − h(X))|² (eq. 9, nonlinear), the other parameters held at x, by
    Levenberg–Marquardt from there, derivatives exact.

    `sizes` (parameters,) scale the variables.  `tie` (columns,), where given, adds
    ((X − x0)/tie)² per column, in units of the noise: a weak tie, used only to keep undetermined
    directions still before they are known to be undetermined.  `among` (ascending) are columns of
    which those fitted are a choice: a large table's fit leaves their R factor too, which else would
    take another pass.

    On R factors, with the cost and the gradient of all rows, until a step promises less than
    TOLERANCE of the cost, of many readings `tolerance`.  Every step starts from the residual of the
    exact model, so that the rounding of one is taken back by the next.

    Raises ElastocalError where the start has poses without equilibrium.
    """
    size = sizes[columns]
    tied = np.full(len(columns), np.inf) if tie is None else tie / size

    def values(u: Array) -> Array:
        moved = x.copy()
        moved[columns] += u * size
        return moved

    def evaluated(u: Array) -> Evaluation:
        at = evaluate(problem.model, problem.parts, values(u), columns)
        if not np.isfinite(at.r_factor.rss):
            raise ElastocalError(
                f"{problem.observations.table.source}: the model predicts no finite numbers at the "
                "start values; look in the cell for a length, force or compliance far too large"
            )
        return Evaluation(at.residual, at.r_factor.scaled(size))

    def among_others(u: Array) -> Evaluation:
        assert among is not None
        at = evaluate(problem.model, problem.parts, values(u), among)
        own = at.r_factor.of_columns(np.searchsorted(among, columns))
        return Evaluation(at.residual, own.scaled(size), at.r_factor)

    objective = SumOfSquares(
        evaluated, tied, (problem.x0 - x)[columns] / size, None if among is None else among_others
    )
    enough = tolerance if problem.many else TOLERANCE
    found = descend(objective, np.zeros(len(columns)), enough, max_steps)
    return Fit(
        values(found.u), found.at.residual, problem.weights.apply(found.at.residual),
        found.at.r_factor.scaled(1 / size), found.converged, found.reason, found.evaluations,
        problem, columns, sizes, found.at.wide,
    )  # fmt: skip
