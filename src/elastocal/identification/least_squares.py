"""Nonlinear weighted least squares on the exact B, with what else is known of the parameters:

    |W (y − h(X))|² + |target − P X|²   over X[columns],   lower ≤ X ≤ upper,  A X = b,  M(X) ⪰ 0

A weak tie to the start, the prior of random coefficients and stated knowledge are all of them rows
P; every fit is the same descent by Levenberg and Marquardt on R factors.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import ElastocalError
from elastocal.identification.constrained import Minimum, Reduced, minimise
from elastocal.identification.knowledge import (
    Constraints,
    GaussianPrior,
    System,
    share_of_prior,
)
from elastocal.identification.weighted_problem import (
    Evaluation,
    Partition,
    RFactor,
    Weights,
    evaluate,
    is_large,
    least_norm,
    partition,
)
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.units import Array, IntArray

SETTLED = "the sum of squares no longer fell"
NEGLIGIBLE = "the steps became negligible"
EXHAUSTED = "the step limit was reached; the start may be far off or the data ill-conditioned"

LEAST_DAMPING = 1e-18  # of the largest squared column, once a full step has failed
SHORTER = 0.3
ROUNDING = 1e-12  # relative: what separates two evaluations at the minimum


# What a step promises of the cost where a descent ends.  The last step is taken: at a million rows
# it is a tenth of a standard deviation, and what it leaves behind is smaller by orders.
TOLERANCE = 1e-8


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
        columns = max(int((~self.model.shrunk).sum()), len(self.free))
        return partition(self.observations, self.weights, columns)

    @property
    def large(self) -> bool:
        return is_large(self.observations, int((~self.model.shrunk).sum()))


@dataclass(frozen=True)
class Fit:
    """Values x (parameters,), raw and whitened residual (rows,), R factor of whitened B and it.

    `columns` (fitted,) index the parameters, `sizes` (parameters,) their typical sizes.
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

    @cached_property
    def B(self) -> Array:
        """B (rows, fitted) at x, raw.  Formed on demand: of a large table, use `r_factor`."""
        observed = self.problem.observations
        return self.problem.model.regressor(observed.table, self.x, self.columns, observed).B

    def cofactor(self) -> Array:
        """(BᵀW²B)⁻¹ (fitted, fitted): covariance at unit variance (eq. 7 and 13)."""
        return self.r_factor.cofactor(self.sizes[self.columns])


@dataclass(frozen=True)
class PriorRows:
    """What a fit knows of its columns besides the readings: P (k, columns) and target (k,) with
    |target − P X|² beside whitened rows, and constraints on them."""

    P: Array
    target: Array
    system: System | None = None

    @classmethod
    def near(cls, centre: Array, width: Array) -> PriorRows:
        """X ~ N(centre, width²) in units of the noise, (columns,) each."""
        return cls(np.diag(1 / width), centre / width)

    @classmethod
    def stated(
        cls, names: tuple[str, ...], columns: IntArray, x: Array, constraints: Constraints,
        prior: GaussianPrior | None, sigma: float,
    ) -> PriorRows:  # fmt: skip
        """Constraints and prior on the `columns`, the others held at x (parameters,), beside rows
        of noise `sigma`.  Raises InputError where a held parameter alone breaks a constraint."""
        P, target = np.zeros((0, len(columns))), np.zeros(0)
        if prior is not None:
            P, target = prior.rows(names)
            held = np.setdiff1d(np.arange(len(x)), columns)
            P, target = sigma * P[:, columns], sigma * (target - P[:, held] @ x[held])
        return cls(P, target, constraints.resolve(names).restricted(columns, x))


@dataclass(frozen=True)
class Objective:
    """|e(u)|² + |target − P u|² under the `limits` on u, where X[columns] = x[columns] + size · u
    and the other parameters are x (parameters,)."""

    problem: Problem
    columns: IntArray
    x: Array
    size: Array
    known: PriorRows

    @cached_property
    def P(self) -> Array:
        return self.known.P * self.size

    @cached_property
    def target(self) -> Array:
        return self.known.target - self.known.P @ self.x[self.columns]

    @cached_property
    def limits(self) -> System | None:
        system = self.known.system
        return None if system is None else system.moved(self.x[self.columns], self.size)

    def evaluate(self, u: Array) -> Evaluation:
        """e, and the R factor of it and of B per unit of u; ElastocalError where the model has no
        prediction."""
        problem = self.problem
        at = evaluate(problem.model, problem.parts, self.values(u), self.columns)
        if not np.isfinite(at.r_factor.rss):
            raise ElastocalError(
                f"{problem.observations.table.source}: the model predicts no finite numbers at the "
                "start values; look in the cell for a length, force or compliance far too large"
            )
        return replace(at, r_factor=at.r_factor.scaled(self.size))

    def values(self, u: Array) -> Array:
        """X (parameters,), what lies at its bound but for rounding on it."""
        values, system = moved(self.x, self.columns, self.size * u), self.known.system
        if system is not None:
            own = values[self.columns]
            for bound in (system.lower, system.upper):
                own = np.where(np.abs(own - bound) <= ROUNDING * self.size, bound, own)
            values[self.columns] = np.clip(own, system.lower, system.upper)
        return values

    def rows(self, u: Array, at: Evaluation) -> tuple[Array, Array]:
        """A and b of the linearised cost |b − A step|²."""
        rows = at.r_factor.augmented
        A, b = np.vstack([rows[:, :-1], self.P]), self.target - self.P @ u
        return A, np.concatenate([rows[:, -1], b])

    def cost(self, u: Array, at: Evaluation) -> float:
        return at.r_factor.rss + float(np.sum((self.target - self.P @ u) ** 2))

    def step(self, u: Array, at: Evaluation, damping: float) -> tuple[Array, float]:
        """Minimiser of the linearised cost + damping · |step|², and by how much the cost falls."""
        p, (A, b) = len(u), self.rows(u, at)
        damped, target = np.vstack([A, np.sqrt(damping) * np.eye(p)]), np.append(b, np.zeros(p))
        if self.limits is None:
            cond = max(at.r_factor.rows, p) * np.finfo(float).eps
            step = least_norm(damped, target, cond=cond)
        else:
            step = minimise(damped, target, self.limits.moved(u, np.ones(p))).x
        left = b - A @ step
        return step, float(b @ b - left @ left)

    def descend(self, u: Array, tolerance: float, most: int) -> tuple[Array, Evaluation, str, int]:
        """Full Gauss–Newton steps while they lower the cost, damped ones where they do not: where
        they end, why, and after how many evaluations.

        Ends where the linearised cost promises less than `tolerance` of itself: that last step is
        still taken, and leaves an error smaller than itself by the factor with which Gauss–Newton
        converges.  Steps are judged by the cost itself, so no rounding of it can keep it from
        ending.
        """
        at = self.evaluate(u)
        cost, damping, evaluations = self.cost(u, at), 0.0, 1
        failed = -1.0  # the damping that was too little a step ago
        while evaluations < most:
            step, promised = self.step(u, at, damping)
            last, small = promised <= tolerance * cost, np.abs(step).max(initial=0.0) <= ROUNDING
            if last and small:
                return u, at, NEGLIGIBLE, evaluations
            evaluations += 1
            try:
                trial = self.evaluate(u + step)
                trial_cost = self.cost(u + step, trial)
            except ElastocalError:
                trial, trial_cost = at, np.inf
            if last and (damping == 0 or failed >= 0):  # more than what is left is not to be had
                kept = trial_cost <= cost * (1 + ROUNDING)
                return (*((u + step, trial) if kept else (u, at)), SETTLED, evaluations)
            if cost - trial_cost > 1e-4 * promised:
                u, at, cost = u + step, trial, trial_cost
                less = damping / 10 if damping > LEAST_DAMPING * _steepest(at) else 0.0
                damping, failed = (damping, failed / 100) if less <= failed else (less, failed)
            elif small:
                return u, at, NEGLIGIBLE, evaluations
            else:
                failed, damping = damping, self._shortened(u, at, damping, step)
        return u, at, EXHAUSTED, evaluations

    def _shortened(self, u: Array, at: Evaluation, damping: float, step: Array) -> float:
        """The damping with which a step that failed has at most SHORTER of its length."""
        longest = SHORTER * float(np.linalg.norm(step))
        damping = max(10 * damping, LEAST_DAMPING * _steepest(at))
        while np.linalg.norm(self.step(u, at, damping)[0]) > longest:
            damping *= 10
        return damping


def _steepest(at: Evaluation) -> float:
    return float((at.r_factor.R**2).sum(axis=0).max(initial=0.0))


def moved(x: Array, columns: IntArray, step: Array) -> Array:
    out = x.astype(float)
    out[columns] += step
    return out


def fit(
    problem: Problem, columns: IntArray, x: Array, sizes: Array, *, known: PriorRows | None = None,
    max_steps: int = 60, tolerance: float = TOLERANCE,
) -> Fit:  # fmt: skip
    """min over X[columns] of |W (y − h(X))|² (eq. 9, nonlinear) with what is `known` of them, the
    other parameters held at x, by Levenberg–Marquardt from there, derivatives exact.

    `sizes` (parameters,) scale the variables.

    On R factors, with the cost and the gradient of all rows, until a step promises less than
    `tolerance` of the cost.  Every step starts from the residual of the exact model, so that the
    rounding of one is taken back by the next.  Constraints are convex and kept in every step: where
    none improves the fit, the conditions of Karush, Kuhn and Tucker hold.

    Raises ElastocalError where the start has poses without equilibrium, InputError for constraints
    that contradict each other, InsufficientDataError where they leave something undetermined.
    """
    size, u = sizes[columns], np.zeros(len(columns))
    known = known or PriorRows(np.zeros((0, len(u))), np.zeros(0))
    objective = Objective(problem, columns, x, size, known)
    if objective.limits is not None:  # the nearest that is allowed
        u = minimise(np.eye(len(u)), u, objective.limits).x
    u, at, reason, evaluations = objective.descend(u, tolerance, max_steps)
    return Fit(
        objective.values(u), at.residual, problem.weights.apply(at.residual),
        at.r_factor.scaled(1 / size), reason != EXHAUSTED, reason, evaluations, problem, columns,
        sizes,
    )  # fmt: skip


# A fit with knowledge: where its constraints let it go, and how far.

PINNED = 1e-12  # of unit columns: what equalities leave of a parameter that they fix


@dataclass(frozen=True)
class KnownFit:
    """A fit at its minimum with what is known, beside rows of noise `sigma`: the linear problem of
    the step δ (columns,) from there, |e − B δ|² + |lack − P δ|², and its minimum δ = 0."""

    fit: Fit
    known: PriorRows
    sigma: float

    @cached_property
    def reduced(self) -> Reduced:
        assert self.known.system is not None
        x, rows = self.fit.x[self.fit.columns], self.fit.r_factor.augmented
        J, lack = np.vstack([rows[:, :-1], self.known.P]), self.known.target - self.known.P @ x
        limits = self.known.system.moved(x, np.ones(len(x)))
        return Reduced.of(J, np.concatenate([rows[:, -1], lack]), limits)

    @cached_property
    def best(self) -> Minimum:
        return self.reduced.minimum(self.known.system)

    @property
    def names(self) -> tuple[str, ...]:
        return self.reduced.system.names

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
        return self.sigma**2 * self.cofactor

    @property
    def prior_share(self) -> Array:
        """Share (columns,) of each estimate's information that is the prior's; NaN where fixed."""
        return share_of_prior(self.cofactor, self.known.P)

    @property
    def effective(self) -> float:
        """How many parameters' worth the readings determine: tr(cofactor BᵀB) on the face."""
        return self.face.shape[1] - float(((self.known.P @ self.face) ** 2).sum())

    def _pinned(self, half: Array) -> Array:
        fixed = np.linalg.norm(half, axis=1) <= PINNED * self.reduced.unit
        half = np.where(fixed[:, None], 0.0, half)
        return np.asarray(half @ half.T)


# Ends of profile intervals: how far a parameter can move before the fit becomes too bad.
#
# With S(v) the least objective where the parameter is held at v and the others are refitted, and Ŝ
# its minimum, the interval is {v: S(v) − Ŝ ≤ rise} (Bates and Watts 1988, chapter 6): in a linear
# model the t interval, and the same under any transformation of the parameter.

PRECISION = 1e-7  # of an interval: a step that short is the last
MOST_STEPS = 40
ASTRAY = 0.5  # of the rise: how far the nonlinear objective may lie beyond it on the way
ENDLESS = 1000.0  # times as far as in the linear model: there is no end


def profile_end(found: KnownFit, index: int, rise: float, side: int) -> float:
    """The least (side −1) or largest (1) value of the fitted parameter no. `index` with the
    nonlinear objective at most `rise` above its minimum; infinite where there is no end.

    Each step goes to that end of the model linearised where the last one ended, and is halved
    until the objective there is near what is allowed.  An end may also be where poses have no
    equilibrium any more.  Steps that do not settle lead to none.
    """
    fit, limit, size = found.fit, found.objective + rise, found.fit.sizes[found.fit.columns]
    objective = Objective(fit.problem, fit.columns, fit.x, size, found.known)
    assert objective.limits is not None
    far = ENDLESS * abs(float(found.reduced.farthest(index, found.best, rise, side)[index]))
    u = np.zeros(len(size))
    at = objective.evaluate(u)
    for _ in range(MOST_STEPS):
        A, b = objective.rows(u, at)
        reduced = Reduced.of(A, b, objective.limits.moved(u, np.ones(len(u))))
        best = reduced.minimum()
        step = reduced.farthest(index, best, max(limit - best.objective, 0.0), side)
        while True:
            try:
                at = objective.evaluate(u + step)
                if objective.cost(u + step, at) <= limit + ASTRAY * rise:
                    break
            except ElastocalError:
                pass  # no equilibrium so far out
            step = step / 2
        u = u + step
        if np.linalg.norm(A @ step) <= PRECISION * np.sqrt(rise):
            return float(objective.values(u)[fit.columns[index]])
        if abs(size[index] * u[index]) > far:
            break
    return side * np.inf
