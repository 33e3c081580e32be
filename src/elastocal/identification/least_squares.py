"""Nonlinear weighted least squares on the exact B: Levenberg–Marquardt, and the fit it ends in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.optimize import lsq_linear

from elastocal.errors import ElastocalError
from elastocal.identification.linear_solver import solve_weighted
from elastocal.identification.weighted_problem import (
    Evaluation,
    Partition,
    RFactor,
    Weights,
    evaluate,
    is_large,
    partition,
)
from elastocal.model.manipulator import Model, Regression
from elastocal.model.observations import Observations
from elastocal.units import Array

# Levenberg–Marquardt on R factors, as a trust region.

SETTLED = "the sum of squares no longer fell"
NEGLIGIBLE = "the steps became negligible"
EXHAUSTED = "the step limit was reached; the start may be far off or the data ill-conditioned"

FIRST_RADIUS = 3.0  # in typical sizes
POOR, GOOD = 0.25, 0.75  # actual over promised fall
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
    """|e(u)|² + |(u − centre)/tie|² over lower ≤ u ≤ upper, B = −∂e/∂u.

    `evaluate` gives the R factor of e and of B per unit of u, (p,) in typical sizes; it raises
    ElastocalError where the model has no prediction.  A `tie` (p,) of infinity is none.
    `evaluate_last`, where given, evaluates in its place where the descent means to end: for what
    else is wanted there.
    """

    evaluate: Callable[[Array], Evaluation]
    tie: Array
    centre: Array
    lower: Array
    upper: Array
    evaluate_last: Callable[[Array], Evaluation] | None = None

    def cost(self, u: Array, at: Evaluation) -> float:
        """The sum of squares, ties included."""
        return at.r_factor.rss + float(np.sum(((u - self.centre) / self.tie) ** 2))

    def step(self, u: Array, at: Evaluation, radius: float) -> tuple[Array, float]:
        """Minimiser of the linearised cost over |step| ≤ radius, and by how much the cost falls;
        where there are bounds, no component of the step is longer."""
        p = len(u)
        A = np.vstack([at.r_factor.R, np.diag(1 / self.tie)])
        b = np.concatenate([at.r_factor.projected, (self.centre - u) / self.tie])
        if np.isfinite(self.lower).any() or np.isfinite(self.upper).any():
            box = (np.maximum(self.lower - u, -radius), np.minimum(self.upper - u, radius))
            step = lsq_linear(A, b, box, method="bvls", tol=1e-14).x
        else:
            U, s, Vt = linalg.svd(A, full_matrices=False)
            known = s > max(at.r_factor.rows, p) * np.finfo(float).eps * s.max(initial=0.0)
            step = _within(s[known], U[:, known].T @ b, radius) @ Vt[known]
        left = b - A @ step
        return step, float(b @ b - left @ left)


def _within(s: Array, z: Array, radius: float) -> Array:
    """Minimiser w of |z − s w|² over |w| ≤ radius, by Newton's method on the damping (Moré 1978,
    Lecture Notes in Mathematics 630, 105)."""
    w, damping = z / s, 0.0
    for _ in range(20):
        length = float(np.linalg.norm(w))
        if length <= 1.01 * radius:
            break
        damping += (length - radius) / radius * length**2 / float(w @ (w / (s**2 + damping)))
        w = s * z / (s**2 + damping)
    return w


def descend(
    objective: SumOfSquares, u: Array, tolerance: float, max_evaluations: int,
    radius: float = np.inf,
) -> Descent:  # fmt: skip
    """Gauss–Newton steps within a trust region of that `radius` to begin with.

    Ends where the linearised cost promises less than `tolerance` of itself: that last step is
    still taken, and leaves an error smaller than itself by the factor with which Gauss–Newton
    converges.  Steps are judged by the cost itself, so no rounding of it can keep it from ending.

    Raises ElastocalError where the start has no prediction.
    """
    ending = objective.evaluate_last or objective.evaluate
    at = objective.evaluate(u)
    cost, evaluations = objective.cost(u, at), 1
    while evaluations < max_evaluations:
        step, promised = objective.step(u, at, radius)
        length = float(np.linalg.norm(step))
        last = promised <= tolerance * cost and length < 0.9 * radius
        if np.abs(step).max(initial=0.0) <= ROUNDING:
            return Descent(u, at, True, NEGLIGIBLE, evaluations)
        evaluations += 1
        try:
            trial = (ending if last else objective.evaluate)(u + step)
            trial_cost = objective.cost(u + step, trial)
        except ElastocalError:
            trial, trial_cost = at, np.inf
        if last:
            kept = trial_cost <= cost * (1 + ROUNDING)
            at, u = (trial, u + step) if kept else (at, u)
            return Descent(u, at, True, SETTLED, evaluations)
        gained = cost - trial_cost
        if not gained > POOR * promised:
            radius = POOR * length
        elif gained > GOOD * promised and length > 0.9 * radius:
            radius = 2 * radius
        if gained > 0:
            u, at, cost = u + step, trial, trial_cost
    return Descent(u, at, False, EXHAUSTED, evaluations)


# Nonlinear weighted least squares on the exact B.

# What the last step may promise, of the cost.  It is taken, and one with the exact linear solver
# follows where nothing but the readings decides: each squares what error is left.
TOLERANCE = 1e-10
FIRST, LAST, MOST_POLISHES = 1e-6, 1e-11, 50
LARGEST = 1e150  # of a residual, whose square is still a number
# The same of a large table, whose evaluations are dear: at a million rows the last step is a tenth
# of a standard deviation, and what it leaves behind is smaller by orders.
LARGE_TOLERANCE = 1e-8


@dataclass(frozen=True)
class FitProblem:
    """min over X[columns] of |W (y − h(X))|² (eq. 9, nonlinear), the other parameters held at `x`.

    `sizes` (parameters,) scale the variables.  `tie` (columns,), where given, adds
    ((X − centre)/tie)² per column, in units of the noise: a weak tie, used only to keep
    undetermined directions still before they are known to be undetermined.  `among` (ascending)
    are columns of which those fitted are a choice: a large table's fit leaves their R factor too,
    which else would take another pass.
    """

    model: Model
    observations: Observations
    weights: Weights
    x: Array
    columns: NDArray[np.int64]
    sizes: Array
    tie: Array | None = None
    centre: Array | None = None
    bounded: bool = False
    # The table in parts, where whoever poses the problem has cut it already.
    cut: Partition | None = None
    among: NDArray[np.int64] | None = None

    @cached_property
    def parts(self) -> Partition:
        if self.cut is not None:
            return self.cut
        return partition(self.observations, self.weights, int((~self.model.shrunk).sum()))

    @property
    def tied_to(self) -> Array:
        """What `tie` ties the columns to."""
        return (self.x if self.centre is None else self.centre)[self.columns]

    @property
    def limits(self) -> tuple[Array, Array]:
        """Bounds (columns,) on the variables u of `values`, infinite unless the fit is bounded."""
        fitted = [self.model.parameters[c] for c in self.columns]
        if not self.bounded:
            return np.full(len(fitted), -np.inf), np.full(len(fitted), np.inf)
        x, size = self.x[self.columns], self.sizes[self.columns]
        lower, upper = np.array([(p.lower, p.upper) for p in fitted]).T
        return (lower - x) / size, (upper - x) / size

    def values(self, u: Array) -> Array:
        """Parameters (parameters,) with the columns moved by u typical sizes."""
        x = self.x.copy()
        x[self.columns] += u * self.sizes[self.columns]
        return x

    @property
    def large(self) -> bool:
        """Whether B is reduced part by part instead of being formed."""
        return is_large(self.observations, int((~self.model.shrunk).sum()))


@dataclass(frozen=True)
class Fit:
    """Values x (parameters,), raw and whitened residual (rows,), R factor of whitened B and it.

    `columns` (fitted,) index the parameters; `wide`, where there is one, is the R factor of the
    columns that these were chosen among.
    """

    x: Array
    residual: Array
    whitened: Array
    r_factor: RFactor
    converged: bool
    reason: str
    steps: int
    problem: FitProblem = field(repr=False)
    wide: RFactor | None = field(default=None, repr=False)

    @property
    def columns(self) -> NDArray[np.int64]:
        return self.problem.columns

    @cached_property
    def B(self) -> Array:
        """B (rows, fitted) at x, raw.  Formed on demand: of a large table, use `r_factor`."""
        return _regression(self.problem, self.x).B

    def cofactor(self) -> Array:
        """(BᵀW²B)⁻¹ (fitted, fitted): covariance at unit variance (eq. 7 and 13).

        Exact to working precision for tables of ordinary size; of a large one from the R factor,
        exact to working precision times condition number.
        """
        scale = self.problem.sizes[self.columns]
        if self.problem.large:
            return self.r_factor.cofactor(scale)
        B = self.problem.weights.apply(self.B)
        return solve_weighted(B, self.whitened, scale=scale).cofactor


def fit(problem: FitProblem, max_steps: int = 60, tolerance: float = LARGE_TOLERANCE) -> Fit:
    """Levenberg–Marquardt from the problem's x, derivatives exact.

    On R factors, with the cost and the gradient of all rows, until a step promises less than
    `tolerance` of the cost.

    Raises ElastocalError where the start has poses without equilibrium.
    """
    columns, large = problem.columns, problem.large
    size, weights = problem.sizes[columns], problem.weights
    known: list[tuple[Array, Regression]] = []  # of a small table: what was evaluated last

    def evaluated(u: Array) -> Evaluation:
        if large:
            at = evaluate(problem.model, problem.parts, problem.values(u), columns)
            return Evaluation(_finite(problem, at.residual), at.r_factor.scaled(size))
        here = _regression(problem, problem.values(u))
        known[:] = [(u, here)]
        e = weights.apply(_finite(problem, here.residual))
        return Evaluation(here.residual, RFactor.of(weights.apply(here.B * size), e))

    def among_others(u: Array) -> Evaluation:
        among = columns if problem.among is None else problem.among
        at = evaluate(problem.model, problem.parts, problem.values(u), among)
        own = at.r_factor.of_columns(np.searchsorted(among, columns))
        return Evaluation(at.residual, own.scaled(size), at.r_factor)

    lower, upper = problem.limits
    objective = SumOfSquares(
        evaluated, np.full(len(columns), np.inf) if problem.tie is None else problem.tie / size,
        (problem.tied_to - problem.x[columns]) / size, lower, upper,
        among_others if large and problem.among is not None else None,
    )  # fmt: skip
    start = np.clip(np.zeros(len(columns)), lower, upper)
    if not large:
        tolerance = min(tolerance, TOLERANCE)
    radius = np.inf if large else FIRST_RADIUS
    found = descend(objective, start, tolerance, max_steps, radius)
    x, at = problem.values(found.u), found.at
    residual, r_factor = at.residual, at.r_factor.scaled(1 / size)
    if not large and problem.tie is None and not problem.bounded and found.converged:
        u, here = known[0]
        x, here = _polished(
            problem, x, here if np.array_equal(u, found.u) else _regression(problem, x)
        )
        residual, e = here.residual, weights.apply(here.residual)
        r_factor = RFactor.of(weights.apply(here.B), e)
    return Fit(
        x, residual, weights.apply(residual), r_factor, found.converged, found.reason,
        found.evaluations, problem, at.wide,
    )  # fmt: skip


def _regression(problem: FitProblem, x: Array) -> Regression:
    observed = problem.observations
    return problem.model.regressor(observed.table, x, problem.columns, observed)


def _finite(problem: FitProblem, residual: Array) -> Array:
    if not np.abs(residual).max(initial=0.0) < LARGEST:
        raise ElastocalError(
            f"{problem.observations.table.source}: the model predicts no finite numbers at the "
            "start values; look in the cell for a length, force or compliance far too large"
        )
    return residual


def _polished(problem: FitProblem, x: Array, at: Regression) -> tuple[Array, Regression]:
    """Gauss–Newton steps with the exact linear solver, kept where they do not cost.

    For an arm one is enough, whose step is then less than FIRST of the residual; a model that
    bends within its residual takes more, until what is left after them is less than LAST.
    """
    weights, columns, last = problem.weights, problem.columns, 0.0
    if weights.even:
        weights = replace(weights, whiten=None)
    for _ in range(MOST_POLISHES):
        B, before = weights.apply(at.B), weights.apply(at.residual)
        step = solve_weighted(B, before, scale=problem.sizes[columns]).x
        moved = x.copy()
        moved[columns] += step
        try:
            there = _regression(problem, moved)
        except ElastocalError:
            break
        after = weights.apply(there.residual)
        cost = float(before @ before)
        if not np.isfinite(after).all() or after @ after > cost * (1 + ROUNDING):
            break
        x, at = moved, there
        moves = float(np.linalg.norm(B @ step)) / max(np.sqrt(cost), np.finfo(float).tiny)
        if moves <= FIRST and not moves**2 > LAST * last > 0:
            break
        last = moves
    return x, at
