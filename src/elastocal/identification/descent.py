"""Least squares on triangles: Levenberg–Marquardt where one evaluation is a pass over the table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.optimize import lsq_linear

from elastocal.errors import ElastocalError
from elastocal.identification.chunked import Evaluation

Array = NDArray[np.float64]

SETTLED = "the sum of squares no longer fell"
NEGLIGIBLE = "the steps became negligible"
EXHAUSTED = "the step limit was reached; the start may be far off or the data ill-conditioned"

FIRST_DAMPING = 1e-3  # of the largest squared column, once a full step has failed
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
class Objective:
    """|e(u)|² + |(u − centre)/tie|² over lower ≤ u ≤ upper, B = −∂e/∂u.

    `evaluate` gives the triangle of e and of B per unit of u, (p,) in typical sizes; it raises
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
        return at.triangle.rss + float(np.sum(((u - self.centre) / self.tie) ** 2))

    def step(self, u: Array, at: Evaluation, damping: float) -> tuple[Array, float]:
        """Minimiser of the linearised cost + damping · |step|², and by how much the cost falls."""
        p = len(u)
        A = np.vstack([at.triangle.R, np.diag(1 / self.tie)])
        b = np.concatenate([at.triangle.projected, (self.centre - u) / self.tie])
        damped = np.vstack([A, np.sqrt(damping) * np.eye(p)])
        target = np.concatenate([b, np.zeros(p)])
        if np.isfinite(self.lower).any() or np.isfinite(self.upper).any():
            box = (self.lower - u, self.upper - u)
            step = lsq_linear(damped, target, box, method="bvls", tol=1e-14).x
        else:
            cond = max(at.triangle.rows, p) * np.finfo(float).eps
            step = linalg.lstsq(damped, target, cond=cond)[0]
        left = b - A @ step
        return step, float(b @ b - left @ left)


def descend(objective: Objective, u: Array, tolerance: float, max_evaluations: int) -> Descent:
    """Full Gauss–Newton steps while they lower the cost, damped ones where they do not.

    Ends where the linearised cost promises less than `tolerance` of itself: that last step is
    still taken, and leaves an error smaller than itself by the factor with which Gauss–Newton
    converges.  Steps are judged by the cost itself, so no rounding of it can keep it from ending.

    Raises ElastocalError where the start has no prediction.
    """
    ending = objective.evaluate_last or objective.evaluate
    at = objective.evaluate(u)
    cost, damping, evaluations = objective.cost(u, at), 0.0, 1
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
        if last and damping == 0:
            kept = trial_cost <= cost * (1 + ROUNDING)
            at, u = (trial, u + step) if kept else (at, u)
            return Descent(u, at, True, SETTLED, evaluations)
        if cost - trial_cost > 1e-4 * promised:
            u, at, cost = u + step, trial, trial_cost
            damping = damping / 10 if damping > 1e-9 * _steepest(at) else 0.0
        elif np.abs(step).max(initial=0.0) <= ROUNDING:
            return Descent(u, at, True, NEGLIGIBLE, evaluations)
        else:
            damping = max(10 * damping, FIRST_DAMPING * _steepest(at))
    return Descent(u, at, False, EXHAUSTED, evaluations)


def _steepest(at: Evaluation) -> float:
    """The largest squared column of B."""
    return float((at.triangle.R**2).sum(axis=0).max(initial=0.0))
