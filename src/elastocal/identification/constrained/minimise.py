"""The minimum of an objective under constraints: scaled, solved, polished, named."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.errors import ElastocalError, InputError, InsufficientDataError
from elastocal.identification.constrained.conflict import raise_conflict
from elastocal.identification.constrained.conic import ConicPoint, solve_conic
from elastocal.identification.constrained.objective import Objective
from elastocal.identification.constrained.optimality import (
    Active,
    Kkt,
    active_at,
    active_from_duals,
    polished,
    tangent_rows,
)
from elastocal.identification.constrained.polyhedral import (
    Affine,
    bounded_least_squares,
    equality_space,
)
from elastocal.identification.constrained.system import ROUND_OFF, Matrix, System
from elastocal.text import listed

Array = NDArray[np.float64]

CONTRADICTION = 1e-9  # what equalities may miss each other by, of the size of x
CERTIFIED = 1e-6  # KKT residual above which the point is no minimum
FAR_OFF, MAX_RESCALINGS = 10.0, 3  # solve anew where x is that much longer than supposed
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
    """Minimiser x (p,), the objective there, active constraints, cofactor (p, p), KKT residual.

    `cofactor` is the inverse of half the objective's Hessian within the active face, zero across
    it: (BᵀB + PᵀP)⁻¹ for squares and no active constraint.
    """

    x: Array
    objective: float
    active: tuple[ActiveConstraint, ...]
    cofactor: Array
    kkt: float


def minimise(objective: Objective, system: System) -> Minimum:
    """Minimise the objective over the system's x; raises as `solve_constrained` does."""
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
    return Minimum(
        x,
        objective.value(x),
        _named(system, limits, active, at, z, unit),
        _cofactor(scaled, limits, active, z) * np.outer(unit, unit),
        at.residual,
    )


def _least_squares(
    objective: Objective, space: Affine, names: tuple[str, ...]
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
    objective: Objective, system: System, basis: Array, R: Array
) -> tuple[Array, Active]:
    """A minimum to a solver's accuracy, and its active constraints; 0 is the free minimum."""
    none = np.zeros(len(system.names), dtype=bool)
    no_nulls = tuple(np.zeros((len(m.balance), 0)) for m in system.matrices)
    found = bounded_least_squares(R, basis, system.lower, system.upper)
    if found is None:
        raise_conflict(system)
    x, at_lower, at_upper = found
    # Where no reading is beyond Huber's threshold, his loss is squares.
    longest = np.max(objective.loss.lengths(objective.y - objective.B @ x), initial=0.0)
    if longest <= objective.loss.threshold and all(_semidefinite(m, x) for m in system.matrices):
        return x, Active(at_lower, at_upper, no_nulls)
    size = system.distance(none.astype(float))
    if not objective.loss.quadratic:
        size = max(size, objective.loss.threshold)
    point = _conic_point(objective, system, basis, size)
    for _ in range(MAX_RESCALINGS):
        length = float(np.linalg.norm(point.x))
        if length <= FAR_OFF * size:
            break
        size = length
        point = _conic_point(objective, system, basis, size)
    return point.x, active_from_duals(system, point.x, point.lower, point.upper, point.matrices)


def _semidefinite(matrix: Matrix, x: Array) -> bool:
    values = np.linalg.eigvalsh(matrix.at(x))
    return bool(values[0] >= -ROUND_OFF * max(np.abs(values).max(), 0.0))


def _conic_point(objective: Objective, system: System, basis: Array, size: float) -> ConicPoint:
    point = solve_conic(objective, system, basis, size)
    if point is None:
        raise_conflict(system)
    return point


def _cofactor(objective: Objective, system: System, active: Active, x: Array) -> Array:
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
