"""Linear least squares under constraints: the minimum, its prices, and how far a value can go.

After the equalities and the free minimum are taken out, x = centre + T u with the sum of squares
rest + |u|², so that the constrained minimum is the point of a convex set nearest to u = 0.  A cone
program (cvxpy with Clarabel) finds which constraints are active there.  Under bounds alone the
point itself then comes from their equations, good to rounding; beside a matrix inequality it is the
program's, good to some 1e-8 of a standard deviation.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, Literal, NoReturn

import numpy as np
import scipy
from scipy import linalg

from elastocal.errors import ElastocalError, InputError, InsufficientDataError
from elastocal.identification.knowledge import ROUND_OFF, ActiveConstraint, Matrix, System
from elastocal.identification.weighted_problem import least_norm
from elastocal.text import listed
from elastocal.units import Array, BoolArray

# Linear equalities, by the space that they leave.

RANK = 1e-10  # of unit rows or columns: what is smaller is taken for round-off


def equality_space(A: Array, b: Array) -> tuple[Array, Array, float]:
    """All x with A x = b (k, p), or the least-squares ones where the rows contradict each other:
    the shortest (p,), an orthonormal basis (p, q) of the way to the others, and the largest
    |A x − b| left, of unit rows."""
    norms = np.linalg.norm(A, axis=1)
    unit = np.where(norms > 0, norms, 1.0)
    # With a row of zeros, which leaves every way open: LAPACK takes no matrix without rows.
    rows, values = np.vstack([A / unit[:, None], np.zeros(A.shape[1])]), np.append(b / unit, 0.0)
    origin = least_norm(rows, values, cond=RANK)
    return origin, linalg.null_space(rows, RANK), float(np.abs(rows @ origin - values).max())


# The answer.

ON_BOUND = 1e-7  # in standard deviations: what is closer to a bound lies on it


# The point u (q,) of a region nearest to 0, u = Σ prices · rows + Σ ⟨prices, slopes⟩, the prices of
# the rows (k,) and of each matrix (n, n), half of what they are for |u|².
Nearest = tuple[Array, Array, tuple[Array, ...]]


@dataclass(frozen=True)
class Minimum:
    """Minimiser x (p,) of |t − J x|² under constraints, the objective there, what is active.

    `nearest` is the same point in the coordinates of `Reduced`.
    """

    x: Array
    objective: float
    active: tuple[ActiveConstraint, ...]
    nearest: Nearest


CONTRADICTION = 1e-9  # what equalities may miss each other by, of the size of x
UNDETERMINED = 1e-11  # singular value of unit columns, of the largest
STEEPEST = 1e7  # deviations from the free minimum: across them an interval has no width left


class Reduced:
    """|t − J x|² = constant + |u|² on x = unit · (centre + T u), all x that the equalities allow,
    where rows u ≥ least and every matrix ⪰ 0.

    `unit` (p,) makes the columns of J unit length, so that slacks and tolerances do not depend on
    a parameter's physical unit; `limits` are the constraints on x/unit − centre.  The rows (k, q)
    are the finite bounds, lower ones first, of unit length: `sides` (k,) is 1 for a lower bound and
    −1 for an upper one of parameter `of_row` (k,), `lengths` (k,) what a row was divided by.

    Raises InputError where equalities contradict each other, which it names, and
    InsufficientDataError where they and J (rows, p) leave a direction undetermined.
    """

    def __init__(self, J: Array, t: Array, system: System) -> None:
        self.J, self.t, self.system = J, t, system
        norms = np.linalg.norm(J, axis=0)
        self.unit = unit = 1 / np.where(norms > 0, norms, 1.0)
        zero = np.zeros(len(unit))
        limits = system.moved(zero, unit)
        origin, basis, gap = equality_space(limits.A, limits.b)
        if gap > CONTRADICTION * max(1.0, float(np.max(np.abs(origin), initial=0.0))):
            raise_conflict(limits)
        self.centre, self.T = centre, T = _free_minimum(J * unit, t, origin, basis, system.names)
        # About the free minimum numbers are as small as the constraints allow.
        self.limits = limits = limits.moved(centre, zero + 1)
        below, above = (np.flatnonzero(np.isfinite(b)) for b in (limits.lower, limits.upper))
        of, sides = np.append(below, above), np.repeat([1.0, -1.0], [len(below), len(above)])
        rows, least = sides[:, None] * T[of], np.append(limits.lower[below], -limits.upper[above])
        lengths = np.linalg.norm(rows, axis=1)
        # What the equalities pin does not move; a bound on it holds, or nothing can meet it.
        moves = lengths > RANK * np.max(np.linalg.norm(T, axis=1), initial=0.0)
        if np.max(least[~moves], initial=0.0) > RANK:
            raise_conflict(limits)
        self.matrices = tuple(
            replace(m, slopes=np.tensordot(T.T, m.slopes, axes=1)).balanced()
            for m in limits.matrices
        )
        self.lengths, self.of_row, self.sides = lengths[moves], of[moves], sides[moves]
        self.rows, self.least = rows[moves] / self.lengths[:, None], least[moves] / self.lengths

    def minimum(self, stated: System | None = None) -> Minimum:
        """The minimum under all constraints; `active` in the terms of `stated`, if given, where x
        is a step and `stated` the constraints on the parameters themselves.

        Raises InputError where constraints contradict each other, which it names.
        """
        found = self._nearest()
        if found is None:
            raise_conflict(self.limits)
        u, prices, _ = found
        x = self.unit * (self.centre + self.T @ u)
        held, above = self.of_row[prices > 0], self.sides[prices > 0] > 0
        x[held] = np.where(above, self.system.lower[held], self.system.upper[held])
        left = self.t - self.J @ x
        return Minimum(x, float(left @ left), self._named(stated or self.system, found), found)

    def _holds(self, u: Array) -> bool:
        for matrix in self.matrices:
            values = np.linalg.eigvalsh(matrix.at(u))
            if values[0] < -ROUND_OFF * max(np.abs(values).max(), 0.0):
                return False
        return bool((self.rows @ u >= self.least).all())

    def _nearest(self) -> Nearest | None:
        """None where nothing satisfies all constraints."""
        if self._holds(u := np.zeros(self.T.shape[1])):
            nothing = tuple(np.zeros_like(m.constant) for m in self.matrices)
            return u, np.zeros(len(self.least)), nothing
        found = self._cone_program()
        if found is None or any(N.shape[1] for N in self._nulls(found)):
            return found
        held = found[1] > 0
        u, prices = equality_space(self.rows[held], self.least[held])[0], np.zeros(len(held))
        if held.any():  # scipy's nnls of no column at all ends the process
            prices[held] = scipy.optimize.nnls(self.rows[held].T, u)[0]
        return u, prices, tuple(np.zeros_like(Z) for Z in found[2])

    def _cone_program(self) -> Nearest | None:
        """The nearest point to a solver's accuracy, in units of the least that it can be away.

        An eigenvalue of M changes by at most |u| √(Σ ‖slopes_i‖²).
        """
        import cvxpy as cp

        parts = [float(m.shortfall(np.zeros(len(m.slopes))) / np.linalg.norm(m.slopes))
                 for m in self.matrices if m.slopes.any()]  # fmt: skip
        size = max(float(np.max(self.least, initial=0.0)), *parts, 0.0) or 1.0
        v = cp.Variable(self.T.shape[1])
        wanted = [self.rows @ v >= self.least / size] if len(self.rows) else []
        matrices = [
            _value(cp, replace(m, constant=m.constant / size), v) >> 0 for m in self.matrices
        ]
        status = _solve(cp.Problem(cp.Minimize(cp.sum_squares(v)), [*wanted, *matrices]))
        if "infeasible" in status:
            return None
        if v.value is None:
            raise _stopped(status)
        u, prices = size * np.asarray(v.value), np.zeros(len(self.rows))
        if wanted:
            # Active are those with slack < price (strict complementarity).
            price, slack = size * wanted[0].dual_value / 2, self.rows @ u - self.least
            prices = np.where(slack < price, price, 0.0)
        duals = tuple(size * (c.dual_value + c.dual_value.T) / 4 for c in matrices)
        return u, prices, duals

    def _touched(self, found: Nearest) -> BoolArray:
        slack = (self.rows @ found[0] - self.least) * self.lengths
        return np.asarray((found[1] > 0) | (slack <= ON_BOUND))

    def _nulls(self, found: Nearest) -> list[Array]:
        """A null-space basis (n, ·) of each matrix at the point.

        M and its price Z share eigenvectors and M Z = 0, so that the negative eigenvalues of M − Z
        are those of −Z, and belong to the null space.
        """
        out = []
        for matrix, Z in zip(self.matrices, found[2], strict=True):
            values, vectors = np.linalg.eigh(matrix.at(found[0]) - Z)
            out.append(vectors[:, values <= ON_BOUND])
        return out

    def face(self, at: Minimum) -> Array:
        """Orthonormal directions (q, ·) in which the constraints that the point lies on let u go:
        of a matrix those with Nᵀ dM N = 0."""
        found = at.nearest
        rows = [self.rows[self._touched(found)]]
        for matrix, N in zip(self.matrices, self._nulls(found), strict=True):
            i, j = np.tril_indices(N.shape[1])
            rows.append((N.T @ matrix.slopes @ N)[:, i, j].T)
        stacked = np.vstack(rows)
        return equality_space(stacked, np.zeros(len(stacked)))[1]

    def _named(self, stated: System, found: Nearest) -> tuple[ActiveConstraint, ...]:
        """Equalities, then bounds, then matrices on which u lies, prices in the units of x."""
        limits, each = self.limits, self.sides * found[1] / self.lengths
        # What they leave of the gradient of half the objective is the equalities'.
        J, z = self.J * self.unit, self.T @ found[0]
        pull = J.T @ (self.J @ (self.unit * (self.centre + z)) - self.t)
        np.subtract.at(pull, self.of_row, each)
        for own, in_u, Z in zip(limits.matrices, self.matrices, found[2], strict=True):
            both = in_u.balance / own.balance
            pull -= np.tensordot(own.slopes, np.outer(both, both) * Z, axes=2)
        shares = least_norm(limits.A.T, pull) if len(limits.b) else np.zeros(0)
        noise = ROUND_OFF * float(np.linalg.norm(self.t))  # J has columns of unit length
        shares[np.abs(shares) * np.linalg.norm(limits.A, axis=1) <= noise] = 0.0
        active = [
            ActiveConstraint(label, "equality", _names(stated, row), float(b), 2 * float(price))
            for row, label, b, price in zip(
                stated.A, stated.equality_labels, stated.b, shares, strict=True
            )
        ]
        for k in np.flatnonzero(self._touched(found)):
            i, low = self.of_row[k], self.sides[k] > 0
            name, value = stated.names[i], float((stated.lower if low else stated.upper)[i])
            label = f"{name} {'>=' if low else '<='} {value:.6g}"
            price = 2 * float(each[k] / self.unit[i])
            kind: Literal["lower", "upper"] = "lower" if low else "upper"
            active.append(ActiveConstraint(label, kind, (name,), value, price))
        for in_x, matrix, N, Z in zip(
            limits.matrices, self.matrices, self._nulls(found), found[2], strict=True
        ):
            if N.shape[1]:
                names = _names(stated, np.abs(in_x.slopes).sum(axis=(1, 2)))
                price = 2 * float(matrix.balance**2 @ np.diag(Z))
                active.append(ActiveConstraint(matrix.label, "semidefinite", names, 0.0, price))
        return tuple(active)

    def farthest(self, index: int, found: Minimum, rise: float, side: int) -> Array:
        """x (p,) with the least (side −1) or largest (1) x[index] where the objective is at most
        `rise` above its minimum `found`.

        These are the ends of the profile interval {v: S(v) − Ŝ ≤ rise}, S(v) the least objective
        with the parameter at v.
        """
        c, s, u = side * self.T[index], float(np.sqrt(rise)), found.nearest[0]
        length = float(np.linalg.norm(c))
        if s == 0 or length <= RANK * float(np.max(np.linalg.norm(self.T, axis=1), initial=0.0)):
            return found.x  # equalities leave a single value
        v = c / length
        if u.any() or not self._holds(s * v):
            v = self._cone_end(v, u, s)
        x = self.unit * (self.centre + self.T @ (u + s * v))
        bound = (self.system.lower if side < 0 else self.system.upper)[index]
        near = ON_BOUND * self.unit[index] * length * s
        if side * (bound - x[index]) <= near:
            x[index] = bound
        return x if side * (x[index] - found.x[index]) > 0 else found.x

    def _cone_end(self, direction: Array, u: Array, s: float) -> Array:
        """v farthest in the direction, where u + s v is allowed and |u + s v|² ≤ |u|² + s²."""
        import cvxpy as cp

        v = cp.Variable(len(u))
        # A minimum far from the free one leaves next to nothing of the side where u·v < 0.
        steep = float(np.linalg.norm(u)) > STEEPEST * s
        wanted = [cp.sum_squares(v) + (0.0 if steep else 2 / s) * u @ v <= 1]
        wanted += [u / np.linalg.norm(u) @ v <= 0] if steep else []
        for m in self.matrices:  # u itself is allowed, whatever its rounding says
            about = m.at(u) + m.shortfall(u) * np.eye(len(m.balance))
            scaled = replace(m, constant=about, slopes=m.slopes * s).balanced(True)
            wanted.append(_value(cp, scaled, v) >> 0)
        if len(self.rows):
            wanted.append(self.rows @ v >= np.minimum((self.least - self.rows @ u) / s, 0.0))
        status = _solve(cp.Problem(cp.Maximize(direction @ v), wanted))
        if v.value is None:
            raise _stopped(status)
        return np.asarray(v.value)


def minimise(J: Array, t: Array, system: System) -> Minimum:
    """Minimise |t − J x|² over the system's x; errors as in `Reduced`."""
    return Reduced(J, t, system).minimum()


def _free_minimum(
    J: Array, t: Array, origin: Array, basis: Array, names: tuple[str, ...]
) -> tuple[Array, Array]:
    """Least-squares x (p,) among origin + basis · w, and T (p, q) with |J T u| = |u|."""
    if not basis.shape[1]:
        return origin, basis
    Q, R = linalg.qr(J @ basis, mode="economic")
    singular, right = linalg.svd(R)[1:]
    tiny = UNDETERMINED * float(np.max(singular, initial=0.0))
    loose = right[int((singular > tiny).sum()) :]
    if len(loose):
        moved = np.abs(loose @ basis.T).max(axis=0)
        free = [n for n, m in zip(names, moved, strict=True) if m > 1e-3 * moved.max()]
        raise InsufficientDataError(
            f"data, prior and equalities do not determine {listed(free)}: values can change "
            "together without moving a reading; hold some of them, or state a prior"
        )
    T = linalg.solve_triangular(R, basis.T, trans="T").T
    return origin + T @ (Q.T @ (t - J @ origin)), T


def _names(system: System, chosen: Array) -> tuple[str, ...]:
    return tuple(system.names[i] for i in np.flatnonzero(chosen))


# Which constraints contradict each other.

MATTERS = 1e-6  # of the largest multiplier


def raise_conflict(system: System) -> NoReturn:
    """Raise InputError that names the constraints which no x satisfies together.

    Every constraint is relaxed by one t ≥ 0, in the units of `system`, and t made as small as can
    be.  The constraints with a multiplier are a proof of the contradiction (Farkas); the others
    could be dropped and it would remain.
    """
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
        named.append((m.label, _value(cp, m, z) + t * np.eye(len(m.balance)) >> 0))
    _solve(cp.Problem(cp.Minimize(t), [constraint for _, constraint in named]))
    prices = [0.0 if c.dual_value is None else np.abs(c.dual_value).max() for _, c in named]
    matter = MATTERS * max(prices, default=0.0)
    labels = [f"'{label}'" for label, _ in named]
    guilty = [label for label, price in zip(labels, prices, strict=True) if price > matter]
    raise InputError(
        f"the constraints contradict each other: no values satisfy {listed(guilty or labels)} "
        "together; relax or drop one of them"
    )


# Cone programs.

TOLERANCES = (1e-10, 1e-8, 1e-6)  # the next where the solver gives up


def _value(cp: ModuleType, matrix: Matrix, x: Any) -> Any:
    n = len(matrix.balance)
    slopes = matrix.slopes.reshape(len(matrix.slopes), n * n).T
    return matrix.constant + cp.reshape(slopes @ x, (n, n), order="C")


def _solve(problem: Any) -> str:
    import cvxpy as cp

    with warnings.catch_warnings():
        # Inaccurate solutions only say what is active; the point is judged by its KKT residual.
        warnings.simplefilter("ignore")
        if problem.is_lp():  # by the simplex method: at a vertex as few multipliers as can be
            problem.solve(solver="SCIPY", scipy_options={"method": "highs"})
            return str(problem.status)
        for tolerance in TOLERANCES:
            options = {f"tol_{name}": tolerance for name in ("gap_abs", "gap_rel", "feas")}
            try:
                problem.solve(solver="CLARABEL", **options)
            except cp.SolverError:
                continue
            return str(problem.status)
    return "solver_error"


def _stopped(status: str) -> ElastocalError:
    return ElastocalError(
        f"the cone solver stopped with '{status}'; the problem may be badly scaled: check the "
        "units of the bounds and of the prior"
    )
