"""Fits as conic programs, solved by Clarabel through CVXPY: matrix inequalities, Huber losses."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import ElastocalError
from elastocal.identification.constrained.objective import Objective
from elastocal.identification.constrained.system import Matrix, System

Array = NDArray[np.float64]

TOLERANCES = (1e-10, 1e-8, 1e-6)  # the next where the solver gives up
LONGER = (1.0, 1e2, 1e4)  # times the expected length, where the solver stops without a point
OPTIMAL = ("optimal", "optimal_inaccurate")


@dataclass(frozen=True)
class ConicPoint:
    """Minimiser x (p,) and multipliers: of the bounds (p,) each, and of each matrix (n, n)."""

    x: Array
    lower: Array
    upper: Array
    matrices: tuple[Array, ...]


def solve_conic(
    objective: Objective, system: System, basis: Array, size: float
) -> ConicPoint | None:
    """Minimise the objective over x = basis w under bounds and matrices; None where infeasible.

    `size` is the length of x to expect: the program is posed in x/size, objective by size².
    The equalities are to be met by every x = basis w.
    """
    for longer in LONGER:
        status, point = _posed(objective, system, basis, longer * size)
        if status in ("infeasible", "infeasible_inaccurate"):
            return None
        if point is not None:
            return point
    raise ElastocalError(
        f"the cone solver stopped with '{status}'; the problem may be badly scaled: check the "
        "units of the bounds and of the prior"
    )


def _posed(
    objective: Objective, system: System, basis: Array, size: float
) -> tuple[str, ConicPoint | None]:
    """Status, and the minimiser where one was found, of the program in x/size."""
    import cvxpy as cp

    w = cp.Variable(basis.shape[1])
    J, loss = objective.B @ basis, objective.loss
    if loss.quadratic:
        J = np.vstack([J, objective.P @ basis])
        Q, R = np.linalg.qr(J)
        seen = Q.T @ np.concatenate([objective.y, objective.target])
        cost = cp.sum_squares(R @ w - seen / size)
    else:
        r = objective.y / size - J @ w
        if loss.size > 1:
            r = cp.norm(
                cp.reshape(r, (len(objective.y) // loss.size, loss.size), order="C"), axis=1
            )
        cost = cp.sum(cp.huber(r, loss.threshold / size))  # type: ignore[arg-type]
        if len(objective.P):
            cost += cp.sum_squares(objective.P @ basis @ w - objective.target / size)
    below, above = np.isfinite(system.lower), np.isfinite(system.upper)
    at_least = basis[below] @ w >= system.lower[below] / size
    at_most = basis[above] @ w <= system.upper[above] / size
    cones = [_value(cp, m, basis @ w, size) >> 0 for m in system.matrices]
    wanted = ([at_least] if below.any() else []) + ([at_most] if above.any() else [])
    status = _solve(cp.Problem(cp.Minimize(cost), wanted + cones))
    if status not in OPTIMAL or w.value is None:
        return status, None
    lower, upper = np.zeros(len(below)), np.zeros(len(above))
    if below.any():
        lower[below] = at_least.dual_value
    if above.any():
        upper[above] = at_most.dual_value
    duals = tuple(size * np.asarray(cone.dual_value) for cone in cones)
    return status, ConicPoint(size * (basis @ w.value), size * lower, size * upper, duals)


def least_excess(system: System) -> dict[str, float]:
    """Multipliers by label of min t subject to every constraint relaxed by t ≥ 0."""
    import cvxpy as cp

    z, t = cp.Variable(len(system.names)), cp.Variable(nonneg=True)
    norms = np.linalg.norm(system.A, axis=1)
    norms = np.where(norms > 0, norms, 1.0)
    named: list[tuple[str, Any]] = []
    for k, label in enumerate(system.equality_labels):
        named.append((label, cp.abs(system.A[k] / norms[k] @ z - system.b[k] / norms[k]) <= t))
    for i, name in enumerate(system.names):
        if np.isfinite(system.lower[i]):
            named.append((f"the lower bound of {name}", z[i] >= system.lower[i] - t))
        if np.isfinite(system.upper[i]):
            named.append((f"the upper bound of {name}", z[i] <= system.upper[i] + t))
    for m in system.matrices:
        named.append((m.label, _value(cp, m, z, 1.0) + t * np.eye(len(m.balance)) >> 0))
    _solve(cp.Problem(cp.Minimize(t), [constraint for _, constraint in named]))
    return {
        label: 0.0 if c.dual_value is None else float(np.abs(c.dual_value).max())
        for label, c in named
    }


def extremes(system: System, index: int) -> tuple[float, float]:
    """Smallest and largest x[index] that the constraints allow; infinite where unbounded."""
    import cvxpy as cp

    x = cp.Variable(len(system.names))
    below, above = np.isfinite(system.lower), np.isfinite(system.upper)
    wanted = [_value(cp, m, x, 1.0) >> 0 for m in system.matrices]
    wanted += [x[below] >= system.lower[below]] if below.any() else []
    wanted += [x[above] <= system.upper[above]] if above.any() else []
    wanted += [system.A @ x == system.b] if len(system.b) else []
    ends = []
    for sense, beyond in ((cp.Minimize, -np.inf), (cp.Maximize, np.inf)):
        status = _solve(cp.Problem(sense(x[index]), wanted))
        ends.append(float(np.asarray(x.value)[index]) if status in OPTIMAL else beyond)
    return ends[0], ends[1]


def _value(cp: ModuleType, matrix: Matrix, x: Any, size: float) -> Any:
    n = len(matrix.balance)
    slopes = matrix.slopes.reshape(len(matrix.slopes), n * n).T
    return matrix.constant / size + cp.reshape(slopes @ x, (n, n), order="C")


def _solve(problem: Any) -> str:
    import cvxpy as cp

    with warnings.catch_warnings():
        # Inaccurate solutions are polished and judged by their KKT residual.
        warnings.simplefilter("ignore")
        for tolerance in TOLERANCES:
            options = {f"tol_{name}": tolerance for name in ("gap_abs", "gap_rel", "feas")}
            try:
                problem.solve(solver="CLARABEL", **options)
            except cp.SolverError:
                continue
            return str(problem.status)
    return "solver_error"
