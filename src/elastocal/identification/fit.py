"""Nonlinear weighted least squares on the exact B."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from elastocal.errors import ElastocalError
from elastocal.identification.chunked import Evaluation, evaluate
from elastocal.identification.descent import Objective, descend
from elastocal.identification.linear import solve_weighted
from elastocal.identification.noise import Weights
from elastocal.identification.partition import Partition, is_large, partition
from elastocal.identification.triangle import Triangle
from elastocal.manipulator.model import Model, Regression
from elastocal.manipulator.observation import Observations

Array = NDArray[np.float64]

# Relative change of the cost at which the trust region stops; one exact Gauss–Newton step follows
# and squares what error is left.
TOLERANCE = 1e-10
# The same of a large table, whose evaluations are dear.  The last step is taken: at a million rows
# it is a tenth of a standard deviation, and what it leaves behind is smaller by orders.
LARGE_TOLERANCE = 1e-8

REASON = {
    -1: "the solver reported improper input",
    0: "the step limit was reached; the start may be far off or the data ill-conditioned",
    1: "the gradient vanished",
    2: "the sum of squares no longer fell",
    3: "the steps became negligible",
    4: "sum of squares and steps both settled",
}


@dataclass(frozen=True)
class FitProblem:
    """min over X[columns] of |W (y − h(X))|² (eq. 9, nonlinear), the other parameters held at `x`.

    `sizes` (parameters,) scale the variables.  `tie` (columns,), where given, adds
    ((X − centre)/tie)² per column, in units of the noise: a weak tie, used only to keep
    undetermined directions still before they are known to be undetermined.  `among` (ascending)
    are columns of which those fitted are a choice: a large table's fit leaves their triangle too,
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
        return partition(self.observations, self.weights, len(self.model.parameters))

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
        return is_large(self.observations, len(self.model.parameters))


@dataclass(frozen=True)
class Fit:
    """Values x (parameters,), raw and whitened residual (rows,), `triangle` of whitened B and it.

    `columns` (fitted,) index the parameters; `wide`, where there is one, is the triangle of the
    columns that these were chosen among.
    """

    x: Array
    residual: Array
    whitened: Array
    triangle: Triangle
    converged: bool
    reason: str
    steps: int
    problem: FitProblem = field(repr=False)
    wide: Triangle | None = field(default=None, repr=False)

    @property
    def columns(self) -> NDArray[np.int64]:
        return self.problem.columns

    @cached_property
    def B(self) -> Array:
        """B (rows, fitted) at x, raw.  Formed on demand: of a large table, use `triangle`."""
        return _regression(self.problem, self.x).B

    def cofactor(self) -> Array:
        """(BᵀW²B)⁻¹ (fitted, fitted): covariance at unit variance (eq. 7 and 13).

        Exact to working precision for tables of ordinary size; of a large one from the triangle,
        exact to working precision times condition number.
        """
        scale = self.problem.sizes[self.columns]
        if self.problem.large:
            return self.triangle.cofactor(scale)
        B = self.problem.weights.apply(self.B)
        return solve_weighted(B, self.whitened, scale=scale).cofactor


def fit(problem: FitProblem, max_steps: int = 60, tolerance: float = LARGE_TOLERANCE) -> Fit:
    """Levenberg–Marquardt from the problem's x, derivatives exact.

    A large table is fitted on triangles, with the cost and the gradient of all rows, until a step
    promises less than `tolerance` of the cost.

    Raises ElastocalError where the start has poses without equilibrium.
    """
    if problem.large:
        return _fit_in_parts(problem, max_steps, tolerance)
    return _fit_whole(problem, max_steps)


class _Points:
    """The regression at one point after another: residual and B come from one evaluation.

    It lives as long as one descent, whose rows do not change.
    """

    def __init__(self, problem: FitProblem) -> None:
        self.problem = problem
        self._u: Array | None = None
        self._at: Regression | None = None

    def at(self, u: Array) -> Regression:
        """The regression at u (columns,).  Raises ElastocalError for poses without one."""
        if self._at is None or self._u is None or not np.array_equal(u, self._u):
            self._at = _regression(self.problem, self.problem.values(u))
            self._u = u.copy()
        return self._at

    def residual(self, u: Array) -> Array:
        """Predicted minus observed (rows,), NaN where a pose has no equilibrium."""
        try:
            return -self.at(u).residual
        except ElastocalError:
            seen, x = self.problem.observations, self.problem.values(u)
            return self.problem.model.predict(seen.table, x, seen) - seen.value


def _regression(problem: FitProblem, x: Array) -> Regression:
    seen = problem.observations
    return problem.model.regressor(seen.table, x, problem.columns, seen)


def _fit_whole(problem: FitProblem, max_steps: int) -> Fit:
    size, weights, points = problem.sizes[problem.columns], problem.weights, _Points(problem)

    def residual(u: Array) -> Array:
        r = weights.apply(points.residual(u))
        if problem.tie is None:
            return r
        x = problem.values(u)
        return np.concatenate([r, (x[problem.columns] - problem.tied_to) / problem.tie])

    def jacobian(u: Array) -> Array:
        B = weights.apply(points.at(u).B * size)
        return B if problem.tie is None else np.vstack([B, np.diag(size / problem.tie)])

    lower, upper = problem.limits
    start = np.clip(np.zeros(len(problem.columns)), lower, upper)
    if not np.isfinite(residual(start)).all():
        points.at(start)  # names the row
        raise ElastocalError("the model has no finite prediction at the start values")
    found = least_squares(
        residual, start, jacobian, bounds=(lower, upper), method="trf", x_scale=1.0,
        ftol=TOLERANCE, xtol=TOLERANCE, gtol=TOLERANCE, max_nfev=max_steps,
    )  # fmt: skip
    x, final = problem.values(found.x), points.at(found.x)
    if problem.tie is None and not problem.bounded and found.status > 0:
        x, final = _polished(problem, x, final)
    whitened = weights.apply(final.residual)
    return Fit(
        x, final.residual, whitened, Triangle.of(weights.apply(final.B), whitened),
        bool(found.status > 0), REASON[int(found.status)], int(found.nfev), problem,
    )  # fmt: skip


def _fit_in_parts(problem: FitProblem, max_steps: int, tolerance: float) -> Fit:
    columns = problem.columns
    size = problem.sizes[columns]
    lower, upper = problem.limits

    def evaluated(u: Array) -> Evaluation:
        at = evaluate(problem.model, problem.parts, problem.values(u), columns)
        return Evaluation(at.residual, at.triangle.scaled(size))

    def among_others(u: Array) -> Evaluation:
        among = columns if problem.among is None else problem.among
        at = evaluate(problem.model, problem.parts, problem.values(u), among)
        own = at.triangle.of_columns(np.searchsorted(among, columns))
        return Evaluation(at.residual, own.scaled(size), at.triangle)

    objective = Objective(
        evaluated, np.full(len(columns), np.inf) if problem.tie is None else problem.tie / size,
        (problem.tied_to - problem.x[columns]) / size, lower, upper,
        None if problem.among is None else among_others,
    )  # fmt: skip
    start = np.clip(np.zeros(len(columns)), lower, upper)
    found = descend(objective, start, tolerance, max_steps)
    return Fit(
        problem.values(found.u), found.at.residual, problem.weights.apply(found.at.residual),
        found.at.triangle.scaled(1 / size), found.converged, found.reason, found.evaluations,
        problem, found.at.wide,
    )  # fmt: skip


def _polished(problem: FitProblem, x: Array, at: Regression) -> tuple[Array, Regression]:
    """One Gauss–Newton step with the exact linear solver, kept where it does not cost."""
    weights, columns = problem.weights, problem.columns
    before = weights.apply(at.residual)
    step = solve_weighted(weights.apply(at.B), before, scale=problem.sizes[columns])
    moved = x.copy()
    moved[columns] += step.x
    try:
        there = _regression(problem, moved)
    except ElastocalError:
        return x, at
    after = weights.apply(there.residual)
    if not np.isfinite(after).all() or after @ after > before @ before:
        return x, at
    return moved, there
