"""Constrained fit of the nonlinear model: sequential convex programming on the exact B."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.constrained.constraints import Bounds, Constraints
from elastocal.identification.constrained.minimise import ActiveConstraint, Minimum, minimise
from elastocal.identification.constrained.objective import Loss, LossName, Objective, loss_of
from elastocal.identification.constrained.optimality import active_at, kkt
from elastocal.identification.constrained.prior import GaussianPrior, share_of_prior
from elastocal.identification.constrained.system import System
from elastocal.identification.fit import FitProblem
from elastocal.manipulator.model import Regression

Array = NDArray[np.float64]

# Predicted fall of the objective, relative to it, below which the step is the last one.
TOLERANCE = 1e-12
FIRST_RADIUS, LEAST_RADIUS = 10.0, 1e-12  # in typical sizes of the parameters
POOR, GOOD = 0.25, 0.75  # actual over predicted fall (Conn, Gould and Toint 2000, section 6.1)


@dataclass(frozen=True)
class ConstrainedFit:
    """Values x (parameters,), raw and whitened residual (rows,), B (rows, columns), raw.

    `columns` are the fitted parameters; `cofactor` (columns, columns) and `prior_share`
    (columns,) as in `ConstrainedSolution`, on the model linearised at x; multipliers of `active`
    are in units of the objective per unit of the constraint.  `kkt` is the relative KKT residual
    of the nonlinear problem at x.
    """

    x: Array
    residual: Array
    whitened: Array
    B: Array
    columns: NDArray[np.int64]
    names: tuple[str, ...]
    objective: float
    active: tuple[ActiveConstraint, ...]
    cofactor: Array
    prior_share: Array
    kkt: float
    converged: bool
    reason: str
    steps: int


def constrained_fit(
    problem: FitProblem,
    constraints: Constraints | None = None,
    *,
    prior: GaussianPrior | None = None,
    loss: LossName = "squares",
    sigma: float = 1.0,
    max_steps: int = 60,
) -> ConstrainedFit:
    """Minimise Σ ρ(W (y − h(X))) + σ² (X − m)ᵀ C⁻¹ (X − m) over X[columns] under constraints.

    Each step minimises the objective of the linearised model under the constraints, which are
    convex and kept as they are, inside a box around X (trust region); it is taken where the true
    objective falls too.  Every iterate satisfies the constraints; at the limit no step improves
    the linearised model, which is the KKT condition of the nonlinear problem.  `sigma` is the
    standard deviation of a whitened row; Huber's loss is of each reading's length.  The problem's
    `bounded` and `tie` hold as in `fit`.

    Raises InputError as `solve_constrained` does, and where a held parameter alone breaks a
    constraint; ElastocalError where the start has poses without equilibrium.
    """
    columns = np.asarray(problem.columns, dtype=np.int64)
    names = tuple(problem.model.names[c] for c in columns)
    system = fit_system(problem, constraints or Constraints())
    P, target = _prior_rows(problem, columns, prior, sigma)
    nonlinear = _Nonlinear(
        problem, columns, P, target, loss_of(loss, problem.observations.size, sigma)
    )
    size, zero = problem.sizes[columns], np.zeros(len(columns))
    x = nonlinear.moved(problem.x, _nearest(zero, size, system.moved(problem.x[columns], zero + 1)))
    at, objective = nonlinear.linearised(x)
    value, radius = objective.value(zero), FIRST_RADIUS
    reason, converged, steps = "the step limit was reached; the start may be far off", False, 0
    while steps < max_steps and not converged:
        steps += 1
        found = minimise(objective, system.moved(x[columns], zero + 1).boxed(radius * size))
        length = float(np.max(np.abs(found.x) / size))
        trial = nonlinear.moved(x, found.x)
        reached, fall = nonlinear.value(trial), value - found.objective
        converged = fall <= TOLERANCE * value or length <= LEAST_RADIUS
        if converged:
            reason = "no step within the constraints improves the fit"
        gained = value - reached if np.isfinite(reached) else -np.inf
        if gained < POOR * fall:
            radius = POOR * length
        elif gained > GOOD * fall:
            radius = max(radius, 3 * length)
        # The last step cannot be judged by a fall that drowns in round-off.
        if gained > 0 or (converged and gained >= -TOLERANCE * value):
            x = trial
            at, objective = nonlinear.linearised(x)
            value = objective.value(zero)
    limits = system.moved(x[columns], zero + 1)
    final = minimise(objective, limits)
    return ConstrainedFit(
        x, at.residual, objective.y, at.B, columns, names, value, _in_place(final, system),
        final.cofactor, share_of_prior(final.cofactor, P), _kkt(objective, limits), converged,
        reason, steps,
    )  # fmt: skip


def fit_system(problem: FitProblem, constraints: Constraints) -> System:
    """The constraints on the problem's columns, with the effects' own bounds where `bounded`."""
    columns = np.asarray(problem.columns, dtype=np.int64)
    own = [problem.model.parameters[c] for c in columns] if problem.bounded else []
    stated = constraints + Constraints(tuple(Bounds(p.name, p.lower, p.upper) for p in own))
    return stated.resolve(problem.model.names).restricted(columns, problem.x)


@dataclass(frozen=True)
class _Nonlinear:
    """The objective as a function of all parameters, and its linearisation in a step."""

    problem: FitProblem
    columns: NDArray[np.int64]
    P: Array
    target: Array
    loss: Loss

    def moved(self, x: Array, step: Array) -> Array:
        """x (parameters,) with `step` (columns,) added."""
        trial = x.astype(float)
        trial[self.columns] += step
        return trial

    def linearised(self, x: Array) -> tuple[Regression, Objective]:
        seen, apply = self.problem.observations, self.problem.weights.apply
        at = self.problem.model.regressor(seen.table, x, self.columns, seen)
        lack = self.target - self.P @ x[self.columns]
        return at, Objective(apply(at.B), apply(at.residual), self.P, lack, self.loss)

    def value(self, x: Array) -> float:
        """The objective at x; NaN where a pose has no equilibrium."""
        seen = self.problem.observations
        misfit = seen.value - self.problem.model.predict(seen.table, x, seen)
        lack = self.target - self.P @ x[self.columns]
        return self.loss.value(self.problem.weights.apply(misfit)) + float(lack @ lack)


def _prior_rows(
    problem: FitProblem, columns: NDArray[np.int64], prior: GaussianPrior | None, sigma: float
) -> tuple[Array, Array]:
    """P (k, columns) and target (k,) of the prior, given the held parameters, and of the tie."""
    P, target = np.zeros((0, len(columns))), np.zeros(0)
    if prior is not None:
        P, target = prior.rows(problem.model.names)
        held = np.setdiff1d(np.arange(len(problem.x)), columns)
        target = sigma * (target - P[:, held] @ problem.x[held])
        P = sigma * P[:, columns]
    if problem.tie is not None:
        centre = (problem.x if problem.centre is None else problem.centre)[columns]
        P = np.vstack([P, np.diag(1 / problem.tie)])
        target = np.concatenate([target, centre / problem.tie])
    return P, target


def _nearest(x: Array, size: Array, system: System) -> Array:
    """The point nearest to x, in typical sizes, that satisfies the constraints."""
    none = np.zeros((0, len(x)))
    return minimise(Objective(np.diag(1 / size), x / size, none, none[:, 0], Loss()), system).x


def _in_place(found: Minimum, system: System) -> tuple[ActiveConstraint, ...]:
    """Active constraints of a step, told as constraints on the parameters."""
    lower, upper = (
        dict(zip(system.names, side, strict=True)) for side in (system.lower, system.upper)
    )
    equalities = dict(zip(system.equality_labels, system.b, strict=True))
    told = []
    for a in found.active:
        if a.kind == "equality":
            told.append(replace(a, value=float(equalities[a.label])))
        elif a.kind == "semidefinite":
            told.append(a)
        else:
            value = float((lower if a.kind == "lower" else upper)[a.names[0]])
            sign = ">=" if a.kind == "lower" else "<="
            told.append(replace(a, value=value, label=f"{a.names[0]} {sign} {value:.6g}"))
    return tuple(told)


def _kkt(objective: Objective, limits: System) -> float:
    """KKT residual at the linearisation point itself."""
    zero, unit = np.zeros(len(limits.names)), 1 / objective.norms
    scaled, inside = objective.moved(zero, unit), limits.moved(zero, unit)
    return kkt(scaled, inside, active_at(inside, zero), zero).residual
