"""A fit of the nonlinear model under constraints and with a prior, and its profile."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from elastocal.identification.constrained import Minimum, Reduced, minimise
from elastocal.identification.knowledge import (
    Constraints,
    GaussianPrior,
    System,
    share_of_prior,
)
from elastocal.identification.least_squares import FitProblem
from elastocal.identification.weighted_problem import Evaluation, evaluate, residual_at
from elastocal.units import Array, IntArray

# Constrained fit of the nonlinear model: Gauss–Newton on the exact B, steps halved.

# Predicted fall of the objective, relative to it, below which the step is the last one.
TOLERANCE = 1e-10  # a solver's, where a matrix is active
LEAST = 1e-12  # in typical sizes of the parameters: a step that moves nothing
HALVINGS = 20


@dataclass(frozen=True)
class KnowledgeProblem:
    """|W (y − h(X))|² + |target − P X|² over X[columns] under `system`, the others held.

    P (k, columns) and target (k,) are the prior's rows in units of the noise `sigma` of a whitened
    row; `system` holds the constraints on the columns.
    """

    problem: FitProblem
    P: Array
    target: Array
    system: System
    sigma: float

    @classmethod
    def of(
        cls, problem: FitProblem, constraints: Constraints, prior: GaussianPrior | None,
        sigma: float,
    ) -> KnowledgeProblem:  # fmt: skip
        """Raises InputError where a held parameter alone breaks a constraint."""
        columns, names = problem.columns, problem.model.names
        P, target = np.zeros((0, len(columns))), np.zeros(0)
        if prior is not None:
            P, target = prior.rows(names)
            held = np.setdiff1d(np.arange(len(problem.x)), columns)
            target = sigma * (target - P[:, held] @ problem.x[held])
            P = sigma * P[:, columns]
        system = constraints.resolve(names).restricted(columns, problem.x)
        return cls(problem, P, target, system, sigma)

    def moved(self, x: Array, step: Array) -> Array:
        """x (parameters,) with `step` (columns,) added."""
        trial = x.astype(float)
        trial[self.problem.columns] += step
        return trial

    def limits(self, x: Array) -> System:
        """The constraints on a step from x."""
        return self.system.moved(x[self.problem.columns], np.ones(len(self.problem.columns)))

    def linearised(self, x: Array) -> tuple[Evaluation, Array, Array]:
        """The readings at x, and J and t with the objective |t − J step|²: their R factor and the
        prior's rows."""
        problem = self.problem
        at = evaluate(problem.model, problem.parts, x, problem.columns)
        rows, lack = at.r_factor.augmented, self.target - self.P @ x[problem.columns]
        return at, np.vstack([rows[:, :-1], self.P]), np.concatenate([rows[:, -1], lack])

    def value(self, x: Array) -> float:
        """The objective at x; infinite where a pose has no equilibrium."""
        problem = self.problem
        e = problem.weights.apply(residual_at(problem.model, problem.parts, x))
        lack = self.target - self.P @ x[problem.columns]
        value = float(e @ e + lack @ lack)
        return value if np.isfinite(value) else np.inf


# What equalities leave of a parameter that they fix, of unit columns.
PINNED = 1e-12


@dataclass(frozen=True)
class ConstrainedFit:
    """The minimum x (parameters,), the readings `at` it, and the model linearised there.

    `reduced` is the linear problem of the step δ (columns,) from x, |e − B δ|² + |lack − P δ|² with
    the whitened B and residual e, and `best` its minimum, δ = 0 to rounding.
    """

    posed: KnowledgeProblem
    x: Array
    at: Evaluation
    reduced: Reduced
    best: Minimum
    converged: bool
    reason: str
    steps: int

    @property
    def columns(self) -> IntArray:
        return self.posed.problem.columns

    @property
    def names(self) -> tuple[str, ...]:
        return self.posed.system.names

    @property
    def objective(self) -> float:
        return float(self.reduced.t @ self.reduced.t)

    @cached_property
    def face(self) -> Array:
        """Directions (columns, q), orthonormal by J, in which active constraints let x move."""
        return self.reduced.unit[:, None] * self.reduced.T @ self.reduced.face(self.best)

    @cached_property
    def cofactor(self) -> Array:
        """(NᵀBᵀB N + NᵀPᵀP N)⁻¹ in the directions N that the equalities leave."""
        return self._pinned(self.reduced.unit[:, None] * self.reduced.T)

    @cached_property
    def on_face(self) -> Array:
        """The same with every active constraint taken for an equality."""
        return self._pinned(self.face)

    @property
    def covariance(self) -> Array:
        """Posterior covariance (columns, columns), equalities exact, inequalities left out."""
        return self.posed.sigma**2 * self.cofactor

    @property
    def prior_share(self) -> Array:
        """Share (columns,) of each estimate's information that is the prior's; NaN where fixed."""
        return share_of_prior(self.cofactor, self.posed.P)

    @property
    def effective(self) -> float:
        """How many parameters' worth the readings determine: tr(cofactor BᵀB) on the face."""
        return self.face.shape[1] - float(((self.posed.P @ self.face) ** 2).sum())

    def _pinned(self, half: Array) -> Array:
        fixed = np.linalg.norm(half, axis=1) <= PINNED * self.reduced.unit
        half = np.where(fixed[:, None], 0.0, half)
        return np.asarray(half @ half.T)


def constrained_fit(posed: KnowledgeProblem, max_steps: int = 60) -> ConstrainedFit:
    """Minimise the objective under its constraints.

    Each step goes to the minimum of the linearised model under the constraints, which are convex
    and kept as they are; it is halved until the true objective falls too.  Every iterate satisfies
    the constraints; at the limit no step improves the linearised model, which is the condition of
    Karush, Kuhn and Tucker of the nonlinear problem.

    Raises InputError as `minimise` does; ElastocalError where the start has poses without
    equilibrium.
    """
    problem = posed.problem
    size = problem.sizes[problem.columns]
    nearest = minimise(np.diag(1 / size), np.zeros(len(size)), posed.limits(problem.x)).x
    x = posed.moved(problem.x, nearest)
    at, J, t = posed.linearised(x)
    value, steps, converged = float(t @ t), 0, False
    while steps < max_steps and not converged:
        steps += 1
        found = minimise(J, t, posed.limits(x))
        length = float(np.max(np.abs(found.x) / size, initial=0.0))
        converged = value - found.objective <= TOLERANCE * value or length <= LEAST
        # The last step cannot be judged by a fall that drowns in round-off.
        enough = value * (1 + TOLERANCE) if converged else value
        shares = (0.5**k for k in range(1 if converged else HALVINGS))
        trials = (posed.moved(x, share * found.x) for share in shares)
        better = next((trial for trial in trials if posed.value(trial) <= enough), None)
        if better is None:
            converged = True
            break
        x = better
        at, J, t = posed.linearised(x)
        value = float(t @ t)
    reason = (
        "no step within the constraints improves the fit" if converged
        else "the step limit was reached; the start may be far off"
    )  # fmt: skip
    reduced = Reduced.of(J, t, posed.limits(x))
    best = reduced.minimum(posed.system)
    return ConstrainedFit(posed, x, at, reduced, best, converged, reason, steps)


# Ends of profile intervals: how far a parameter can move before the fit becomes too bad.
#
# With S(v) the least objective where the parameter is held at v and the others are refitted, and Ŝ
# its minimum, the interval is {v: S(v) − Ŝ ≤ rise} (Bates and Watts 1988, chapter 6): in a linear
# model the t interval, and the same under any transformation of the parameter.

PRECISION = 1e-7  # of an interval: a step that short is the last
MOST_STEPS = 40
ASTRAY = 0.5  # of the rise: how far the nonlinear objective may lie beyond it on the way
ENDLESS = 1000.0  # times as far as in the linear model: there is no end


def profile_end(found: ConstrainedFit, index: int, rise: float, side: int) -> float:
    """The least (side −1) or largest (1) value of the fitted parameter no. `index` with the
    nonlinear objective at most `rise` above its minimum; infinite where there is no end.

    Each step goes to that end of the model linearised where the last one ended, and is halved
    until the objective there is near what is allowed.  An end may also be where poses have no
    equilibrium any more.  Steps that do not settle lead to none.
    """
    posed, limit, x, c = found.posed, found.objective + rise, found.x, found.columns[index]
    far = ENDLESS * abs(float(found.reduced.farthest(index, found.best, rise, side)[index]))
    for _ in range(MOST_STEPS):
        _, J, t = posed.linearised(x)
        reduced = Reduced.of(J, t, posed.limits(x))
        best = reduced.minimum()
        step = reduced.farthest(index, best, max(limit - best.objective, 0.0), side)
        while not posed.value(posed.moved(x, step)) <= limit + ASTRAY * rise:
            step = step / 2
        x = posed.moved(x, step)
        if np.linalg.norm(J @ step) <= PRECISION * np.sqrt(rise):
            return float(x[c])
        if abs(x[c] - found.x[c]) > far:
            break
    return side * np.inf
