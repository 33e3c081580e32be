"""Nonlinear weighted least squares on the exact B."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from elastocal.errors import ElastocalError
from elastocal.identification.linear import solve_weighted
from elastocal.identification.noise import Weights
from elastocal.manipulator.model import Model, Regression
from elastocal.manipulator.observation import Observations

Array = NDArray[np.float64]

# Relative change of the cost at which the trust region stops; one exact Gauss–Newton step follows
# and squares what error is left.
TOLERANCE = 1e-10

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
    undetermined directions still before they are known to be undetermined.
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


@dataclass(frozen=True)
class Fit:
    """Values x (parameters,), raw and whitened residual (rows,), B of the columns, raw."""

    x: Array
    residual: Array
    whitened: Array
    B: Array
    converged: bool
    reason: str
    steps: int


def fit(problem: FitProblem, max_steps: int = 60) -> Fit:
    """Levenberg–Marquardt (trust region) from the problem's x, derivatives exact.

    Raises ElastocalError where the start has poses without equilibrium.
    """
    model, seen, columns = problem.model, problem.observations, problem.columns
    size = problem.sizes[columns]
    table = seen.table

    def values(u: Array) -> Array:
        x = problem.x.copy()
        x[columns] = problem.x[columns] + u * size
        return x

    centre = (problem.x if problem.centre is None else problem.centre)[columns]

    def residual(u: Array) -> Array:
        x = values(u)
        r = problem.weights.apply(model.predict(table, x, seen) - seen.value)
        if problem.tie is None:
            return r
        return np.concatenate([r, (x[columns] - centre) / problem.tie])

    def jacobian(u: Array) -> Array:
        B = problem.weights.apply(model.regressor(table, values(u), columns, seen).B * size)
        return B if problem.tie is None else np.vstack([B, np.diag(size / problem.tie)])

    lower, upper = np.full(len(columns), -np.inf), np.full(len(columns), np.inf)
    if problem.bounded:
        lower = np.array([model.parameters[c].lower for c in columns])
        upper = np.array([model.parameters[c].upper for c in columns])
        lower, upper = ((b - problem.x[columns]) / size for b in (lower, upper))
    start = np.clip(np.zeros(len(columns)), lower, upper)
    if not np.isfinite(residual(start)).all():
        model.regressor(table, values(start), columns, seen)  # names the row
        raise ElastocalError("the model has no finite prediction at the start values")
    found = least_squares(
        residual, start, jacobian, bounds=(lower, upper), method="trf", x_scale=1.0,
        ftol=TOLERANCE, xtol=TOLERANCE, gtol=TOLERANCE, max_nfev=max_steps,
    )  # fmt: skip
    x = values(found.x)
    final = model.regressor(table, x, columns, seen)
    if problem.tie is None and not problem.bounded and found.status > 0:
        x, final = _polished(problem, x, final)
    return Fit(
        x, final.residual, problem.weights.apply(final.residual), final.B,
        bool(found.status > 0), REASON[int(found.status)], int(found.nfev),
    )  # fmt: skip


def _polished(problem: FitProblem, x: Array, at: Regression) -> tuple[Array, Regression]:
    """One Gauss–Newton step with the exact linear solver, kept where it does not cost."""
    weights, columns = problem.weights, problem.columns
    before = weights.apply(at.residual)
    step = solve_weighted(weights.apply(at.B), before, scale=problem.sizes[columns])
    moved = x.copy()
    moved[columns] += step.x
    residual = problem.observations.value - problem.model.predict(
        problem.observations.table, moved, problem.observations
    )
    after = weights.apply(residual)
    if not np.isfinite(after).all() or after @ after > before @ before:
        return x, at
    return moved, problem.model.regressor(
        problem.observations.table, moved, columns, problem.observations
    )
