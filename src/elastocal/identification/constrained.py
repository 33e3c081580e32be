"""Fits under constraints and with a prior, linear and nonlinear: minimum, conflicts, columns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NoReturn

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.errors import ElastocalError, InputError, InsufficientDataError, option, require
from elastocal.identification.constrained_solver import (
    Active,
    Affine,
    ConstrainedObjective,
    Kkt,
    LossName,
    ResidualLoss,
    active_at,
    active_from_duals,
    equality_space,
    kkt,
    least_excess,
    loss_of,
    polished,
    solve_conic,
    tangent_rows,
)
from elastocal.identification.knowledge import (
    ROUND_OFF,
    Bounds,
    Constraints,
    GaussianPrior,
    Matrix,
    System,
    share_of_prior,
)
from elastocal.identification.least_squares import FitProblem
from elastocal.identification.linear_solver import least_norm
from elastocal.identification.solve import WORTH_A_COLUMN, Solution
from elastocal.model.manipulator import Regression
from elastocal.text import listed, quoted
from elastocal.units import Array, IntArray

# Which constraints contradict each other.

MATTERS = 1e-6  # of the largest multiplier


def raise_conflict(system: System) -> NoReturn:
    """Raise InputError that names the constraints which no x satisfies together.

    Every constraint is relaxed by one t, in the units of `system`, and t made as small as can be.
    The constraints with a multiplier are a proof of the contradiction (Farkas); the others could
    be dropped and it would remain.
    """
    found = least_excess(system)
    largest = max(found.values(), default=0.0)
    guilty = [f"'{k}'" for k, v in found.items() if v > MATTERS * largest] or [
        f"'{label}'" for label in found
    ]
    raise InputError(
        f"the constraints contradict each other: no values satisfy {listed(guilty)} together; "
        "relax or drop one of them"
    )


# The minimum of an objective under constraints: scaled, solved, polished, named.

CONTRADICTION = 1e-9  # what equalities may miss each other by, of the size of x
CERTIFIED = 1e-6  # KKT residual above which the point is no minimum
UNDETERMINED = 1e-11  # singular value of unit columns, of the largest


@dataclass(frozen=True)
class ActiveConstraint:
    """A constraint that holds with equality at the solution.

    `value` is the bound or the equality's right-hand side (0 for a matrix), in the parameter's
    unit; `multiplier` the shadow price ∂(minimum of the objective)/∂value: ≥ 0 at a lower bound,
    ≤ 0 at an upper one; for a matrix tr Z, the price of M ⪰ t·I per unit of t.
    """

    label: str
    kind: Literal["lower", "upper", "equality", "semidefinite"]
    names: tuple[str, ...]
    value: float
    multiplier: float


@dataclass(frozen=True)
class Minimum:
    """Minimiser x (p,), residual y − B x (rows,) and objective there, and their optimality.

    `cofactor` (p, p) is the inverse of half the objective's Hessian within the face of the active
    constraints, zero across it: (BᵀB + PᵀP)⁻¹ for squares and no active constraint.  Times the
    variance of a whitened row it is the (posterior) covariance with the active constraints taken
    as equalities; for Huber's loss it is no covariance.  `prior_share` (p,) says what share of each
    estimate's information is the prior's (0 without prior, NaN where constraints fix the value).
    `kkt` is the relative KKT residual, about 1e-12 at a minimum.
    """

    x: Array
    residual: Array
    objective: float
    active: tuple[ActiveConstraint, ...]
    cofactor: Array
    prior_share: Array
    kkt: float


def minimise(
    objective: ConstrainedObjective, system: System, stated: System | None = None
) -> Minimum:
    """Minimise the objective over the system's x; `active` in the terms of `stated`, if given,
    where x is a step and `stated` the constraints on the parameters themselves.

    Inequalities and Huber's loss are solved by an interior-point method (Clarabel), and Newton
    steps on the active face end it, so that the result is good to rounding and not to a solver's
    tolerance.

    Raises InputError where constraints contradict each other, which it names, and
    InsufficientDataError where data, prior and equalities leave a direction undetermined.
    """
    # Columns of unit length: x is then in units of the standard deviation a parameter would have
    # alone, whatever its physical unit, and so are slacks and tolerances.
    unit = 1 / objective.norms
    zero = np.zeros(len(unit))
    scaled, limits = objective.moved(zero, unit), system.moved(zero, unit)
    space = equality_space(limits.A, limits.b)
    if space.gap > CONTRADICTION * max(1.0, float(np.max(np.abs(space.origin)))):
        raise_conflict(limits)
    centre, R = _least_squares(scaled, space, system.names)
    data = float(np.linalg.norm(scaled.y) + np.linalg.norm(scaled.target))
    # About the unconstrained minimum numbers are as small as the constraints allow.
    scaled, limits = scaled.moved(centre, zero + 1), limits.moved(centre, zero + 1)
    start, active = _constrained_start(scaled, limits, space.basis, R)
    z, active, at = polished(scaled, limits, active, start, data)
    if not at.residual <= CERTIFIED:
        raise ElastocalError(
            f"no certified minimum: the KKT residual is {at.residual:.1e}; state values that the "
            "constraints pin from two sides as equalities, and check the units of the bounds"
        )
    x = unit * (centre + z)
    x[active.lower], x[active.upper] = system.lower[active.lower], system.upper[active.upper]
    cofactor = _cofactor(scaled, limits, active, z) * np.outer(unit, unit)
    return Minimum(
        x, objective.y - objective.B @ x, objective.value(x),
        _named(stated or system, limits, active, at, z, unit), cofactor,
        share_of_prior(cofactor, objective.P), at.residual,
    )  # fmt: skip


def _least_squares(
    objective: ConstrainedObjective, space: Affine, names: tuple[str, ...]
) -> tuple[Array, Array]:
    """Least-squares x (p,) in the space, and R (q, q) with RᵀR = basisᵀ(BᵀB + PᵀP) basis."""
    J = np.vstack([objective.B, objective.P])
    t = np.concatenate([objective.y, objective.target]) - J @ space.origin
    if not space.basis.shape[1]:
        return space.origin, np.zeros((0, 0))
    Q, R = linalg.qr(J @ space.basis, mode="economic")
    singular, right = linalg.svd(R)[1:]
    tiny = UNDETERMINED * float(np.max(singular, initial=0.0))
    loose = right[int((singular > tiny).sum()) :]
    if len(loose):
        moved = np.abs(loose @ space.basis.T).max(axis=0)
        free = [n for n, m in zip(names, moved, strict=True) if m > 1e-3 * moved.max()]
        raise InsufficientDataError(
            f"data, prior and equalities do not determine {listed(free)}: values can change "
            "together without moving a reading; hold some of them, or state a prior"
        )
    return space.origin + space.basis @ linalg.solve_triangular(R, Q.T @ t), R


def _constrained_start(
    objective: ConstrainedObjective, system: System, basis: Array, R: Array
) -> tuple[Array, Active]:
    """A minimum to a solver's accuracy, and what is active; 0 is the free one of squares."""
    x, threshold = np.zeros(len(system.names)), objective.loss.threshold
    outside, size = (system.lower > 0) | (system.upper < 0), system.distance(x)
    active = Active(outside, outside, tuple(np.zeros((len(m.balance), 0)) for m in system.matrices))
    T = linalg.solve_triangular(R, basis.T, trans="T").T

    def solved(size: float, loss: ResidualLoss) -> tuple[Array, Active]:
        point = solve_conic(replace(objective, loss=loss), system, T, size)
        if point is None:
            raise_conflict(system)
        return point.x, active_from_duals(system, point)

    if outside.any() or not all(_semidefinite(m, x) for m in system.matrices):
        x, active = solved(size, ResidualLoss())
    # Where no reading is beyond Huber's threshold, his loss is squares.
    if np.max(objective.loss.lengths(objective.y - objective.B @ x), initial=0.0) <= threshold:
        return x, active
    return solved(max(size, threshold), objective.loss)


def _semidefinite(matrix: Matrix, x: Array) -> bool:
    values = np.linalg.eigvalsh(matrix.at(x))
    return bool(values[0] >= -ROUND_OFF * max(np.abs(values).max(), 0.0))


def _cofactor(objective: ConstrainedObjective, system: System, active: Active, x: Array) -> Array:
    basis = equality_space(*tangent_rows(system, active, x)).basis
    R = linalg.qr(objective.root(x) @ basis, mode="r")[0][: basis.shape[1]]
    try:
        half = linalg.solve_triangular(R, basis.T, trans="T") if R.size else np.zeros((0, len(x)))
    except (linalg.LinAlgError, ValueError):
        raise InputError(
            "Huber's loss sees too few readings within its threshold to curve in every "
            "direction: check sigma, which should be the noise of a whitened row"
        ) from None
    return half.T @ half


def _named(
    system: System, scaled: System, active: Active, at: Kkt, z: Array, unit: Array
) -> tuple[ActiveConstraint, ...]:
    """Equalities, then bounds, then matrices on which z lies, prices in the units of x."""
    touched = active_at(scaled, z)
    found = []
    for row, label, b, price in zip(
        system.A, system.equality_labels, system.b, at.equalities, strict=True
    ):
        names = tuple(system.names[i] for i in np.flatnonzero(row))
        found.append(ActiveConstraint(label, "equality", names, float(b), 2 * float(price)))
    sides = (
        ("lower", ">=", active.lower | touched.lower, system.lower),
        ("upper", "<=", active.upper | touched.upper, system.upper),
    )
    for kind, sign, chosen, bound in sides:
        for i in np.flatnonzero(chosen):
            name, value = system.names[i], float(bound[i])
            price = 2 * float(at.bounds[i] / unit[i]) if getattr(active, kind)[i] else 0.0
            label = f"{name} {sign} {value:.6g}"
            found.append(ActiveConstraint(label, kind, (name,), value, price))  # type: ignore[arg-type]
    for matrix, N, Z in zip(scaled.matrices, touched.nulls, at.matrices, strict=True):
        if N.shape[1]:
            names = tuple(n for n, s in zip(system.names, matrix.slopes, strict=True) if s.any())
            price = 2 * float(matrix.balance**2 @ np.diag(Z))
            found.append(ActiveConstraint(matrix.label, "semidefinite", names, 0.0, price))
    return tuple(found)


# Constrained fit of the nonlinear model: sequential convex programming on the exact B.

# Predicted fall of the objective, relative to it, below which the step is the last one.
TOLERANCE = 1e-12
FIRST_RADIUS, LEAST_RADIUS = 10.0, 1e-12  # in typical sizes of the parameters
POOR, GOOD = 0.25, 0.75  # actual over predicted fall (Conn, Gould and Toint 2000, section 6.1)


@dataclass(frozen=True)
class ConstrainedFit:
    """Values x (parameters,), raw and whitened residual (rows,), B (rows, columns), raw.

    `columns` are the fitted parameters; `cofactor` (columns, columns) and `prior_share`
    (columns,) as in `Minimum`, on the model linearised at x; multipliers of `active`
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

    Raises InputError as `minimise` does, and where a held parameter alone breaks a
    constraint; ElastocalError where the start has poses without equilibrium.
    """
    columns = problem.columns
    names = tuple(problem.model.names[c] for c in columns)
    system = fit_system(problem, constraints or Constraints())
    P, target = _prior_rows(problem, columns, prior, sigma)
    nonlinear = _Nonlinear(problem, P, target, loss_of(loss, problem.observations.size, sigma))
    size, zero = problem.sizes[columns], np.zeros(len(columns))
    x = nonlinear.moved(problem.x, _nearest(size, system.moved(problem.x[columns], zero + 1)))
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
    final = minimise(objective, limits, system)
    return ConstrainedFit(
        x, at.residual, objective.y, at.B, columns, names, value, final.active,
        final.cofactor, final.prior_share, _kkt(objective, limits), converged,
        reason, steps,
    )  # fmt: skip


def fit_system(problem: FitProblem, constraints: Constraints) -> System:
    """The constraints on the problem's columns, with the effects' own bounds where `bounded`."""
    columns = problem.columns
    own = [problem.model.parameters[c] for c in columns] if problem.bounded else []
    stated = constraints + Constraints(tuple(Bounds(p.name, p.lower, p.upper) for p in own))
    return stated.resolve(problem.model.names).restricted(columns, problem.x)


@dataclass(frozen=True)
class _Nonlinear:
    """The objective as a function of all parameters, and its linearisation in a step."""

    problem: FitProblem
    P: Array
    target: Array
    loss: ResidualLoss

    def moved(self, x: Array, step: Array) -> Array:
        """x (parameters,) with `step` (columns,) added."""
        trial = x.astype(float)
        trial[self.problem.columns] += step
        return trial

    def linearised(self, x: Array) -> tuple[Regression, ConstrainedObjective]:
        problem, apply = self.problem, self.problem.weights.apply
        observed, columns = problem.observations, problem.columns
        at = problem.model.regressor(observed.table, x, columns, observed)
        lack = self.target - self.P @ x[columns]
        return at, ConstrainedObjective(apply(at.B), apply(at.residual), self.P, lack, self.loss)

    def value(self, x: Array) -> float:
        """The objective at x; NaN where a pose has no equilibrium."""
        observed = self.problem.observations
        misfit = observed.value - self.problem.model.predict(observed.table, x, observed)
        lack = self.target - self.P @ x[self.problem.columns]
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
        P = np.vstack([P, np.diag(1 / problem.tie)])
        target = np.concatenate([target, problem.tied_to / problem.tie])
    return P, target


def _nearest(size: Array, system: System) -> Array:
    """The shortest step, in typical sizes, to where the constraints hold."""
    P, target = np.zeros((0, len(size))), np.zeros(0)
    distance = ConstrainedObjective(np.diag(1 / size), 0 * size, P, target, ResidualLoss())
    return minimise(distance, system).x


def _kkt(objective: ConstrainedObjective, limits: System) -> float:
    """KKT residual at the linearisation point itself."""
    zero, unit = np.zeros(len(limits.names)), 1 / objective.norms
    scaled, inside = objective.moved(zero, unit), limits.moved(zero, unit)
    return kkt(scaled, inside, active_at(inside, zero), zero).residual


# Which parameters a fit with constraints and a prior has, and its constraints on these alone.

# Share of a column that others must leave over: B is exact to 1e-15, but a base that is tilted by
# some µrad already tells its turn from that of joint 1.
TOLD_APART = 1e-6


def fitted_columns(
    solution: Solution, std: Array, constraints: Constraints, prior: GaussianPrior | None
) -> IntArray:
    """Indices of the parameters to fit under the constraints and the prior, ascending.

    These are the kept parameters of the solution (and those that bounds held); the free ones that
    the prior or an equality names, for that is knowledge of themselves; and, of the parameters
    that are known only together with one of these, as many as can now be told apart from it: with
    a prior on k, readings of k + d are knowledge of d.  Told apart is what readings, prior and
    equalities determine better than its typical size, as in the choice of the kept parameters.
    Bounds and matrices make nothing known: they act on the fitted parameters, with all others
    held where the fit held them.

    `std` (kept,) is that of the solution's estimates.  Raises InputError for a name that is no
    parameter, or a prior on a parameter that is held fixed; InsufficientDataError where an
    equality names a parameter that stays undetermined.
    """
    problem, reduction = solution.problem, solution.reduction
    names, free = problem.model.names, set(problem.free.tolist())
    constraints.resolve(names)
    tied = {name for e in constraints.equalities for name, factor in e.terms.items() if factor}
    priors = set() if prior is None else set(prior.names)
    if prior is not None:
        prior.rows(names)
    fixed = [quoted(n) for n in sorted(priors) if names.index(n) not in free]
    require(
        not fixed,
        f"a prior is stated for {listed(fixed)}, which is held fixed; drop the prior or the fixing",
    )
    named = {names.index(n) for n in tied | priors} & free
    columns = {*reduction.kept.tolist(), *reduction.at_bound.tolist(), *named}

    def told_apart(c: int) -> bool:
        return _told_apart(solution, [*sorted(columns - {c}), c], constraints, prior)

    new = {names.index(n) for n in tied - priors} & free - set(reduction.kept.tolist())
    unknown = [quoted(names[c]) for c in sorted(new) if not told_apart(c)]
    if unknown:
        raise InsufficientDataError(
            f"readings, prior and equalities do not determine {listed(unknown)}, which an equality "
            f"names; hold it ({option('fixed')}) or state a prior for it, or drop the equality"
        )
    partners: dict[int, None] = {}
    for k, c in enumerate(reduction.kept.tolist()):
        if c in named:
            partners |= dict.fromkeys(reduction.terms(k, solution.sizes, std[k]))
    for d in partners:
        if d not in columns and told_apart(d):
            columns.add(d)
    return np.array(sorted(columns), dtype=np.int64)


def _told_apart(
    solution: Solution, columns: list[int], constraints: Constraints, prior: GaussianPrior | None
) -> bool:
    """Whether readings, prior and equalities tell the last of the columns from the others."""
    problem, observed, e = solution.problem, solution.problem.observations, solution.fit.whitened
    chosen = np.array(columns)
    size, names = solution.sizes[chosen], problem.model.names
    at = problem.model.regressor(observed.table, solution.fit.x, chosen, observed)
    sigma = max(float(np.sqrt(e @ e / len(e))), 1e-12)
    J = problem.weights.apply(at.B) * size / sigma
    if prior is not None:
        J = np.vstack([J, prior.rows(names)[0][:, chosen] * size])
    A = constraints.resolve(names).A[:, chosen] * size
    A = A[A.any(axis=1)]
    # An equality is exact: it counts as much as the most that anything else tells.
    A *= np.linalg.norm(J, axis=0).max() / np.linalg.norm(A, axis=1)[:, None]
    J = np.vstack([J, A])
    lengths = np.linalg.norm(J, axis=0)
    J = J / np.where(lengths > 0, lengths, 1.0)
    left = J[:, -1] - J[:, :-1] @ least_norm(J[:, :-1], J[:, -1])
    off = float(np.linalg.norm(left))
    return off > TOLD_APART and off * lengths[-1] > WORTH_A_COLUMN


def own_bounds(solution: Solution) -> Constraints:
    """The bounds that the effects of a bounded problem state themselves."""
    if not solution.problem.bounded:
        return Constraints()
    parameters = solution.problem.model.parameters
    return Constraints(
        tuple(
            Bounds(p.name, p.lower, p.upper)
            for p in parameters
            if np.isfinite(p.lower) or np.isfinite(p.upper)
        )
    )
