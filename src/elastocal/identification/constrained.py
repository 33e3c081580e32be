"""Least squares with constraints and a prior: the minimum, its prices, how far a value can go.

After the equalities and the free minimum are taken out, x = centre + T u with the sum of squares
rest + |u|², so that the constrained minimum is the point of a convex set nearest to u = 0.  A cone
program (cvxpy with Clarabel) finds which constraints are active there.  Under bounds alone the
point itself then comes from their equations, good to rounding; beside a matrix inequality it is the
program's, good to some 1e-8 of a standard deviation.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType
from typing import Any, Literal, NoReturn

import numpy as np
import scipy
from scipy import linalg, special

from elastocal.errors import ElastocalError, InputError, InsufficientDataError, option, require
from elastocal.identification.knowledge import (
    ROUND_OFF,
    ActiveConstraint,
    Constraints,
    GaussianPrior,
    Matrix,
    System,
    share_of_prior,
)
from elastocal.identification.least_squares import (
    LEVEL,
    Covariance,
    Fit,
    Objective,
    PriorRows,
    t_quantile,
)
from elastocal.identification.least_squares import fit as least_squares
from elastocal.identification.options import FunctionPrior, MethodResult, Options
from elastocal.identification.residuals import held_out_by_parts
from elastocal.identification.solve import (
    WORTH_A_COLUMN,
    Reduction,
    Solution,
    reduce,
    residual_sigma,
)
from elastocal.identification.weighted_problem import RFactor, evaluate, least_norm
from elastocal.text import listed, quoted
from elastocal.units import Array, BoolArray, IntArray, Progress

# Linear equalities, by the space that they leave.

RANK = 1e-10  # of unit rows or columns: what is smaller is taken for round-off


def equality_space(A: Array, b: Array) -> tuple[Array, Array, float]:
    """All x with A x = b (k, p), or the least-squares ones where the rows contradict each other:
    the shortest (p,), an orthonormal basis (p, q) of the way to the others, and the largest
    |A x − b| left, of unit rows."""
    p = A.shape[1]
    norms = np.linalg.norm(A, axis=1)
    rows = A[norms > 0] / norms[norms > 0, None]
    values = b[norms > 0] / norms[norms > 0]
    if not len(rows):
        return np.zeros(p), np.eye(p), float(np.max(np.abs(b), initial=0.0))
    Q, R, _ = linalg.qr(rows.T, pivoting=True)
    sizes = np.abs(np.diag(R))
    rank = int(np.count_nonzero(sizes > RANK * sizes[0]))
    origin = Q[:, :rank] @ least_norm(rows @ Q[:, :rank], values)
    gap = float(np.max(np.abs(rows @ origin - values)))
    return origin, Q[:, rank:], max(gap, float(np.max(np.abs(b[norms == 0]), initial=0.0)))


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


@dataclass(frozen=True)
class Reduced:
    """|t − J x|² = constant + |u|² on x = unit · (centre + T u), all x that the equalities allow,
    where rows u ≥ least and every matrix ⪰ 0.

    `unit` (p,) makes the columns of J unit length, so that slacks and tolerances do not depend on
    a parameter's physical unit; `limits` are the constraints on x/unit − centre.  The rows (k, q)
    are the finite bounds, lower ones first, of unit length: `sides` (k,) is 1 for a lower bound and
    −1 for an upper one of parameter `of` (k,), `lengths` (k,) what a row was divided by.
    """

    J: Array
    t: Array
    system: System
    unit: Array
    centre: Array
    T: Array
    limits: System
    rows: Array
    least: Array
    of_row: IntArray
    sides: Array
    lengths: Array
    matrices: tuple[Matrix, ...]

    @classmethod
    def of(cls, J: Array, t: Array, system: System) -> Reduced:
        """Raises InputError where equalities contradict each other, which it names, and
        InsufficientDataError where they and J (rows, p) leave a direction undetermined."""
        norms = np.linalg.norm(J, axis=0)
        unit = 1 / np.where(norms > 0, norms, 1.0)
        zero = np.zeros(len(unit))
        limits = system.moved(zero, unit)
        origin, basis, gap = equality_space(limits.A, limits.b)
        if gap > CONTRADICTION * max(1.0, float(np.max(np.abs(origin), initial=0.0))):
            raise_conflict(limits)
        centre, T = _free_minimum(J * unit, t, origin, basis, system.names)
        # About the free minimum numbers are as small as the constraints allow.
        limits = limits.moved(centre, zero + 1)
        below, above = (np.flatnonzero(np.isfinite(b)) for b in (limits.lower, limits.upper))
        of, sides = np.append(below, above), np.repeat([1.0, -1.0], [len(below), len(above)])
        rows, least = sides[:, None] * T[of], np.append(limits.lower[below], -limits.upper[above])
        lengths = np.linalg.norm(rows, axis=1)
        # What the equalities pin does not move; a bound on it holds, or nothing can meet it.
        moves = lengths > RANK * np.max(np.linalg.norm(T, axis=1), initial=0.0)
        if np.max(least[~moves], initial=0.0) > RANK:
            raise_conflict(limits)
        matrices = tuple(
            replace(m, slopes=np.tensordot(T.T, m.slopes, axes=1)).balanced()
            for m in limits.matrices
        )
        rows, least, lengths = rows[moves], least[moves], lengths[moves]
        return cls(
            J, t, system, unit, centre, T, limits, rows / lengths[:, None], least / lengths,
            of[moves], sides[moves], lengths, matrices,
        )  # fmt: skip

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
    return Reduced.of(J, t, system).minimum()


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


# The fit of a method again, under constraints and with a prior.

# Which parameters a fit with constraints and a prior has.


def fitted_columns(
    solution: Solution, constraints: Constraints, prior: GaussianPrior | None, sigma: float
) -> IntArray:
    """Indices of the parameters to fit under the constraints and the prior, ascending.

    These are the kept parameters of the solution; the free ones that the prior or an equality
    names, for that is knowledge of themselves; and what else the choice of the kept parameters
    finds worth a column with the prior and the equalities as further rows: with a prior on k,
    readings of k + d are knowledge of d.  Bounds and matrices make nothing known: they act on the
    fitted parameters, with all others held where the fit held them.

    Raises InputError for a name that is no parameter, or a prior on a parameter that is held fixed;
    InsufficientDataError where an equality names a parameter that stays undetermined.
    """
    problem, kept, model = solution.problem, solution.reduction.kept, solution.problem.model
    names, free, A = model.names, problem.free, constraints.resolve(model.names).A
    P = np.zeros((0, len(names))) if prior is None else sigma * prior.rows(names)[0]
    known, tied = (np.flatnonzero(rows.any(axis=0)) for rows in (P, A))
    fixed = [quoted(names[c]) for c in np.setdiff1d(known, free)]
    require(
        not fixed,
        f"a prior is stated for {listed(fixed)}, which is held fixed; drop the prior or the fixing",
    )
    named = np.intersect1d(np.union1d(known, tied), free)
    R = evaluate(problem.model, problem.parts, solution.fit.x, free).r_factor.R
    # An equality is exact: it counts as much as the most that anything else tells.
    A = A[:, free][A[:, free].any(axis=1)]
    most = np.linalg.norm(np.vstack([R, P[:, free]]) * solution.sizes[free], axis=0).max()
    A = A * most / np.linalg.norm(A * solution.sizes[free], axis=1)[:, None]
    rank = np.where(np.isin(free, kept), 0, np.where(np.isin(free, named), 1, 2))
    rows = np.vstack([R, P[:, free], A])
    told = free[reduce(rows, solution.sizes[free], (), sigma, WORTH_A_COLUMN, rank).kept]
    unknown = [quoted(names[c]) for c in np.setdiff1d(np.intersect1d(tied, named), [*told, *known])]
    if unknown:
        raise InsufficientDataError(
            f"readings, prior and equalities do not determine {listed(unknown)}, which an equality "
            f"names; hold it ({option('fixed')}) or state a prior for it, or drop the equality"
        )
    return np.unique(np.concatenate([kept, named, told]))


# Intervals of a fit under constraints or with a prior.
#
# At a bound the estimate is not normal and the likelihood ratio not χ²: where the truth lies on one
# bound, it is the mixture ½χ²₀ + ½χ²₁ (Chernoff 1954; Self and Liang 1987), whose 95 % point is
# 2.71.  The intervals here keep the quantile of an interior truth, 3.84.  Away from bounds they are
# exact for a linear model with normal noise of known size; at and near one bound they are
# conservative (97.5 % for 95 %).  With the truth on two bounds at once the mixture depends on the
# angle α > 90° between the two whitened columns of B: they then hold 97.5 % − 14.65 % (α −
# 90°)/360°, which is 95 % at 150° and 93.8 % in the limit of 180°, two columns that nearly cancel.

ONE_SIDED = "one-sided at a bound, and wide rather than narrow near one"


def intervals_with_knowledge(
    found: KnownFit, of_readings: Array, kind: str, many: set[str]
) -> Covariance:
    """95 % intervals of the constrained fit's columns, and their covariance.

    auto: t intervals of the posterior covariance, cut off at bounds, where no inequality is
    active; else the profile {v: S(v) − Ŝ ≤ t² σ²} of the linearised model under the constraints,
    S(v) the least objective with the parameter at v.  profile: that of the nonlinear one.

    The covariance takes equalities for exact and leaves inequalities out: knowing more than it
    says, no estimate is farther off.  `of_readings` (columns,) are the method's degrees of freedom.
    Parameters that are `many`, those of smooth functions, have t intervals in any case.
    """
    known, x, matrix = found.known, found.fit.x[found.fit.columns], found.covariance
    assert known.system is not None
    # A posterior variance V moves with the noise's variance s² by the readings' share of it,
    # d log V = (1 − share) d log s²: by Satterthwaite it has dof/(1 − share)² where s² has dof.
    left = 1 - np.nan_to_num(found.prior_share, nan=1.0)
    full = np.full(len(left), np.inf)
    dof = np.divide(of_readings, left**2, out=full, where=left > 1e-6)
    inside = not any(a.kind != "equality" for a in found.best.active)
    plain = Covariance("t", matrix, dof, "").interval(x, LEVEL)
    if kind == "auto" and inside:
        name, text = ("t under constraints", "equalities taken for exact, bounds cut off")
        if len(known.P):
            name, text = ("posterior", "readings and prior together, the prior taken at its word")
        lower, upper = known.system.lower[:, None], known.system.upper[:, None]
        plain = np.clip(plain, lower, upper)
        return Covariance(name, matrix, dof, f"{text}; assumes normal noise", ends=plain)
    ends = np.repeat(x[:, None], 2, axis=1)
    of_functions = np.array([name in many for name in found.names])
    ends[of_functions] = plain[of_functions]
    # Prior and noise are widened alike, by t for the normal quantile, so that their ratio stays.
    rises = (found.sigma * t_quantile(LEVEL, np.maximum(dof, 1.0))) ** 2
    for k, name in enumerate(found.names):
        for end, side in enumerate((-1, 1)) if name not in many else ():
            rise = float(rises[k])
            if kind == "profile":
                ends[k, end] = profile_end(found, k, rise, side)
            else:
                ends[k, end] += found.reduced.farthest(k, found.best, rise, side)[k]
    model = "nonlinear" if kind == "profile" else "linearised"
    text = f"profile of the {model} fit under the constraints, {ONE_SIDED}; assumes normal noise"
    return Covariance("constrained profile", matrix, dof, text, ends=ends)


# The fit of a method, its knowledge added: one more step on the weights that the method ends with.

NO_PART = 1e-9  # factors below this share of a typical size are no combination
CONTRADICTED = 0.001  # false-alarm rate of a sentence that doubts what the user knows


def joined(stated: GaussianPrior | None, own: GaussianPrior | None) -> GaussianPrior | None:
    """Both priors; of a parameter that both name, the stated one."""
    if stated is None or own is None:
        return own if stated is None else stated
    rest = [k for k, name in enumerate(own.names) if name not in set(stated.names)]
    return GaussianPrior(
        (*stated.names, *(own.names[k] for k in rest)),
        np.concatenate([stated.mean, own.mean[rest]]),
        linalg.block_diag(stated.covariance, own.covariance[np.ix_(rest, rest)]),
    )


def fit_with_knowledge(
    before: MethodResult, options: Options, progress: Progress, own: FunctionPrior | None = None
) -> MethodResult:
    """Minimise |W (y − h(X))|² + σ² (X − m)ᵀ C⁻¹ (X − m) under `options.constraints`.

    W and the readings are those that the method ended with `before`, σ the noise of a whitened row
    under it.  `fitted_columns` says what is fitted, `intervals_with_knowledge` what the intervals
    are; t intervals have the method's own degrees of freedom.  `own` is the prior of smooth
    functions, which joins the stated one.

    Raises InputError for constraints that contradict each other or held values and names that are
    no parameters; InsufficientDataError where an equality names a parameter that readings, prior
    and equalities do not determine.
    """
    solution = before.solution
    problem, fit = solution.problem, solution.fit
    if own is not None:
        problem = replace(problem, free=np.union1d(problem.free, fit.columns))
        solution = replace(solution, problem=problem)
    constraints = options.constraints or Constraints()
    prior = joined(options.prior, None if own is None else own.prior)
    sigma = residual_sigma(fit, len(fit.columns)) if own is None else own.sigma
    columns = fitted_columns(solution, constraints, prior, sigma)
    stated = PriorRows.stated(problem.model.names, columns, fit.x, constraints, prior, sigma)
    progress("fitting under constraints" if prior is None else "fitting with the prior")
    found = KnownFit(
        least_squares(problem, columns, fit.x, solution.sizes, known=stated), stated, sigma
    )
    progress("intervals under constraints" if prior is None else "intervals with the prior")
    told = dict(zip(fit.columns.tolist(), before.spread.dof.tolist(), strict=True))
    spare = own.dof if own else min(told.values())
    dof = np.array([spare if own else told.get(c, spare) for c in columns.tolist()])
    many = set() if own is None else set(own.prior.names)
    spread = intervals_with_knowledge(found, dof, options.intervals, many)
    # Of smooth functions' parameters, which are many, nobody asks.
    shares = {} if prior is None else {
        name: float(share)
        for c, name, share in zip(columns, found.names, found.prior_share, strict=True)
        if np.isfinite(share) and not problem.model.shrunk[c]
    }  # fmt: skip
    fitted = _as_fit(found)
    # Linearised, with the active constraints kept active: directions of the face are orthonormal by
    # the rows of readings and prior together.
    heldout, leverage = held_out_by_parts(
        problem.model, problem.parts, found.fit.x, columns, found.face
    )
    known = replace(solution, fit=fitted, reduction=_reduction(solution, found), held=heldout)
    doubts = _contradiction(solution, before.spread, found, own)
    return replace(
        before, method="constrained", solution=known, spread=spread,
        active=found.best.active, prior_share=shares, effective=round(found.effective),
        leverage=leverage, warnings=(*before.warnings, *doubts),
        smooth=tuple(part.refitted(fitted.x, columns, spread.matrix) for part in before.smooth),
    )  # fmt: skip


def _contradiction(
    solution: Solution, before: Covariance, found: KnownFit, own: FunctionPrior | None
) -> tuple[str, ...]:
    """A sentence where the objective grew by more than noise explains (F-test).

    Rows of the prior and active constraints count as degrees of freedom, less the parameters they
    made estimable.  At active bounds the true distribution is smaller (χ̄²): the test is cautious.
    """
    rows = len(found.known.P) - (0 if own is None else len(own.prior.names))
    stated = rows + len(found.best.active) - (len(found.names) - len(solution.fit.columns))
    if stated < 1:
        return ()
    grown = found.objective - float(solution.fit.whitened @ solution.fit.whitened)
    dof = max(float(before.dof.min()), 1.0)
    if own is not None:
        grown, dof = grown - own.stands, own.dof
    F = max(grown, 0.0) / (stated * found.sigma**2)
    known = np.isinf(dof)
    p = float(special.chdtrc(stated, F * stated) if known else special.fdtrc(stated, dof, F))
    if p > CONTRADICTED:
        return ()
    what = [f"'{a.label}'" for a in found.best.active]
    what += ["the prior"] if rows else []
    return (
        f"The readings contradict {listed(what, 6)}: without, they are fitted better than noise "
        f"explains (F = {F:.1f} on {stated} and {dof:.0f} degrees of freedom, p = {p:.1g}). Check "
        "names, units and signs of what is stated, and whether the model lacks an effect.",
    )


def _as_fit(found: KnownFit) -> Fit:
    """As the fit of a method; its R factor has prior and equalities as further rows.

    Without them a parameter that no reading shows would leave it singular; equalities weigh as
    much as the readings of a parameter do.
    """
    reduced = found.reduced
    A = reduced.system.A * reduced.unit
    equalities = A / np.linalg.norm(A, axis=1)[:, None] / reduced.unit
    rows = np.vstack([reduced.J, equalities])
    return replace(found.fit, r_factor=RFactor.of(rows, np.append(reduced.t, np.zeros(len(A)))))


def _reduction(solution: Solution, found: KnownFit) -> Reduction:
    """What is fitted, what is held, and how a held parameter's error would move the estimates.

    A parameter that an active constraint holds back does not move: it stands for itself.
    """
    before, problem = solution.reduction, solution.problem
    columns, k = found.fit.columns, len(found.fit.columns)
    dropped = np.setdiff1d(before.dropped, columns)
    both = np.concatenate([columns, dropped])
    R = evaluate(problem.model, problem.parts, found.fit.x, both).r_factor.R
    mixing = found.on_face @ (R[:, :k].T @ R[:, k:])
    share = np.abs(mixing) * solution.sizes[dropped] / solution.sizes[columns][:, None]
    mixing[share < NO_PART] = 0.0
    return Reduction(columns, dropped, mixing, np.setdiff1d(before.invisible, columns))
