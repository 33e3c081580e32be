"""Least squares under constraints: cone programs, exact faces, and proof of optimality."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from elastocal.errors import ElastocalError, require
from elastocal.identification.knowledge import Matrix, System
from elastocal.identification.linear_solver import least_norm
from elastocal.identification.robust import huber
from elastocal.units import Array, BoolArray

# Linear equalities, by the space that they leave.

RANK = 1e-10  # of unit rows or columns: what is smaller is taken for round-off


@dataclass(frozen=True)
class Affine:
    """{origin + basis w}: all x with A x = b; `gap` is the largest |A x − b| left, unit rows."""

    origin: Array  # (p,) the shortest such x
    basis: Array  # (p, q) orthonormal
    gap: float


def equality_space(A: Array, b: Array) -> Affine:
    """All solutions of A x = b (k, p); least-squares ones where the rows contradict each other."""
    p = A.shape[1]
    norms = np.linalg.norm(A, axis=1)
    rows = A[norms > 0] / norms[norms > 0, None]
    values = b[norms > 0] / norms[norms > 0]
    if not len(rows):
        return Affine(np.zeros(p), np.eye(p), float(np.max(np.abs(b), initial=0.0)))
    Q, R, _ = linalg.qr(rows.T, pivoting=True)
    sizes = np.abs(np.diag(R))
    rank = int(np.count_nonzero(sizes > RANK * sizes[0]))
    origin = Q[:, :rank] @ least_norm(rows @ Q[:, :rank], values)
    gap = float(np.max(np.abs(rows @ origin - values)))
    return Affine(origin, Q[:, rank:], max(gap, float(np.max(np.abs(b[norms == 0]), initial=0.0))))


# What a constrained fit minimises: squares or Huber losses of the data, and a prior.

LossName = Literal["squares", "huber"]


@dataclass(frozen=True)
class ResidualLoss:
    """Σ ρ(|r_i|) over observations r_i of `size` whitened rows (Huber 1964, by length).

    ρ(d) = d² for d ≤ threshold and 2·threshold·d − threshold² beyond; squares where the
    threshold is infinite.
    """

    threshold: float = np.inf
    size: int = 1

    @property
    def quadratic(self) -> bool:
        return np.isinf(self.threshold)

    def value(self, r: Array) -> float:
        """Σ ρ of the residual r (rows,)."""
        if self.quadratic:
            return float(r @ r)
        d, k = self.lengths(r), self.threshold
        return float(np.where(d <= k, d**2, 2 * k * d - k**2).sum())

    def weights(self, r: Array) -> Array:
        """ρ'(d)/(2d) = min(1, threshold/d) per observation, repeated for its rows (rows,)."""
        if self.quadratic:
            return np.ones(len(r))
        d = np.maximum(self.lengths(r), self.threshold)
        return np.repeat(self.threshold / d, self.size)

    def root(self, J: Array, r: Array) -> Array:
        """K (rows, p) with KᵀK = half the Hessian of Σ ρ(r − J s) at s = 0.

        Beyond the threshold the loss is linear along r_i and bends across it only:
        (threshold/d) (I − u uᵀ), u = r_i/d.
        """
        if self.quadratic:
            return J
        d = self.lengths(r)
        far = d > self.threshold
        u = r.reshape(-1, self.size)[far] / d[far, None]
        K = J.reshape(len(d), self.size, -1).copy()
        across = K[far] - u[:, :, None] * np.einsum("ns,nsp->np", u, K[far])[:, None, :]
        K[far] = np.sqrt(self.threshold / d[far])[:, None, None] * across
        return K.reshape(J.shape)

    def lengths(self, r: Array) -> Array:
        """|r_i| (observations,)."""
        return np.linalg.norm(r.reshape(-1, self.size), axis=1)


def loss_of(name: LossName, size: int = 1, sigma: float = 1.0) -> ResidualLoss:
    """The loss by name; Huber's threshold gives 95 % efficiency at normal rows of std `sigma`."""
    require(name in ("squares", "huber"), f"loss is 'squares' or 'huber', found {name!r}")
    require(size >= 1, f"an observation has at least one row, found size = {size}")
    return (
        ResidualLoss(size=size) if name == "squares" else ResidualLoss(huber(size).c * sigma, size)
    )


@dataclass(frozen=True)
class ConstrainedObjective:
    """f(x) = Σ ρ(y − B x) + |target − P x|²: B (rows, p), y (rows,), P (k, p), target (k,)."""

    B: Array
    y: Array
    P: Array
    target: Array
    loss: ResidualLoss

    def moved(self, centre: Array, unit: Array) -> ConstrainedObjective:
        """f as a function of z, where x = centre + unit · z."""
        return replace(
            self,
            B=self.B * unit,
            y=self.y - self.B @ centre,
            P=self.P * unit,
            target=self.target - self.P @ centre,
        )

    def value(self, x: Array) -> float:
        lack = self.target - self.P @ x
        return self.loss.value(self.y - self.B @ x) + float(lack @ lack)

    def half_gradient(self, x: Array) -> Array:
        """∇f/2 (p,)."""
        r = self.y - self.B @ x
        return -(self.B.T @ (self.loss.weights(r) * r)) - self.P.T @ (self.target - self.P @ x)

    def root(self, x: Array) -> Array:
        """K (rows + k, p) with KᵀK = half the Hessian of f at x."""
        return np.vstack([self.loss.root(self.B, self.y - self.B @ x), self.P])

    @property
    def norms(self) -> Array:
        """Lengths (p,) of the columns of B and P together; 1 for an empty column."""
        norms = np.sqrt((self.B**2).sum(axis=0) + (self.P**2).sum(axis=0))
        return np.where(norms > 0, norms, 1.0)


# Active constraints, their multipliers, the KKT residual, and Newton steps on the active face.
#
# With f the objective, M_l the matrices and N_l a basis of the null space of M_l(x), the point x is
# the minimum where all constraints hold and
#
#     ∇f/2 = Aᵀλ + Σ_lower λ_i e_i − Σ_upper λ_i e_i + Σ_l [⟨Z_l, slopes_i⟩]_i,  Z_l = N_l Λ_l N_lᵀ,
#
# with λ ≥ 0 for bounds and Λ_l ⪰ 0 (Boyd and Vandenberghe 2004, section 5.9).

ROUNDING = 1e-8  # of the data: their rounding, 1e-16, stays a small residual of that
ON_BOUND = 1e-7  # in units of x: what is closer to a bound lies on it


@dataclass(frozen=True)
class Active:
    """Bounds that hold x back (p,), and a null-space basis (n, k) of each matrix, k may be 0."""

    lower: BoolArray
    upper: BoolArray
    nulls: tuple[Array, ...]


@dataclass(frozen=True)
class Kkt:
    """Multipliers of f/2 at a point: equalities, bounds (p,) with upper ones negative, matrices.

    `residual` is the largest of: stationarity relative to the size of the terms, a violated
    constraint relative to the size of x, a multiplier of the wrong sign relative to the terms.
    """

    equalities: Array
    bounds: Array
    matrices: tuple[Array, ...]
    residual: float


def active_from_duals(system: System, point: ConicPoint) -> Active:
    """Which constraints are active, by strict complementarity: slack < multiplier.

    M(x) and its multiplier Z share eigenvectors and M Z = 0, so the negative eigenvalues of
    M − Z are those of −Z, and belong to the null space.
    """
    x, lower, upper, nulls = point.x, point.lower, point.upper, []
    for matrix, Z in zip(system.matrices, point.matrices, strict=True):
        values, vectors = np.linalg.eigh(matrix.at(x) - (Z + Z.T) / 2)
        nulls.append(vectors[:, values < 0])
    return Active(
        (x - system.lower < lower) & (lower > 0), (system.upper - x < upper) & (upper > 0),
        tuple(nulls),
    )  # fmt: skip


def active_at(system: System, x: Array) -> Active:
    """Which constraints are active at x, by their slack."""
    nulls = []
    for matrix in system.matrices:
        values, vectors = np.linalg.eigh(matrix.at(x))
        nulls.append(vectors[:, values <= ON_BOUND])
    return Active(x - system.lower <= ON_BOUND, system.upper - x <= ON_BOUND, tuple(nulls))


def tangent_rows(system: System, active: Active, x: Array) -> tuple[Array, Array]:
    """Rows (k, p) and values (k,) of the equations that keep the active constraints active.

    Equalities, lower bounds, upper bounds, then N_lᵀ dM N_l = −N_lᵀ M(x) N_l by matrix (upper
    triangle, off-diagonal entries times √2, so that ⟨Λ, N_lᵀ dM N_l⟩ is a scalar product).
    """
    identity = np.eye(len(x))
    rows = [system.A, identity[active.lower], identity[active.upper]]
    values = [
        system.b - system.A @ x,
        (system.lower - x)[active.lower],
        (system.upper - x)[active.upper],
    ]
    for matrix, N in zip(system.matrices, active.nulls, strict=True):
        i, j, factor = _triangle(N.shape[1])
        rows.append(((N.T @ matrix.slopes @ N)[:, i, j] * factor).T)
        values.append(-(N.T @ matrix.at(x) @ N)[i, j] * factor)
    return np.vstack(rows), np.concatenate(values)


def kkt(
    objective: ConstrainedObjective, system: System, active: Active, x: Array, data: float = 0.0
) -> Kkt:
    """Multipliers that come closest to stationarity with these constraints active.

    `data` is the length of the data that were subtracted from y beforehand, with their rounding.
    """
    rows, _ = tangent_rows(system, active, x)
    gradient = objective.half_gradient(x)
    multipliers = least_norm(rows.T, gradient)
    left = gradient - rows.T @ multipliers
    cuts = np.cumsum([len(system.b), int(active.lower.sum()), int(active.upper.sum())])
    equalities, lower, upper, rest = np.split(multipliers, cuts)
    bounds = np.zeros(len(x))
    bounds[active.lower] += lower
    bounds[active.upper] += upper
    matrices: list[Array] = []
    wrong = [float(np.max(-lower, initial=0.0)), float(np.max(upper, initial=0.0))]
    inners = _matrices(rest, [N.shape[1] for N in active.nulls])
    for N, inner in zip(active.nulls, inners, strict=True):
        if inner.size:
            wrong.append(max(0.0, -float(np.linalg.eigvalsh(inner)[0])))
        matrices.append(N @ inner @ N.T)
    norms = objective.norms
    own = np.linalg.norm(objective.y) + np.linalg.norm(objective.target) + norms @ np.abs(x)
    terms = float(own) + ROUNDING * data
    residual = max(
        float(np.max(np.abs(left) / norms)) / (terms or 1.0),
        system.violation(x) / max(1.0, float(np.max(np.abs(x)))),
        float(max(wrong)) / (terms or 1.0),
    )
    return Kkt(equalities, bounds, tuple(matrices), residual)


def polished(
    objective: ConstrainedObjective, system: System, active: Active, x: Array, data: float
) -> tuple[Array, Active, Kkt]:
    """Newton's method on the active face, from x; the iterate with the smallest KKT residual.

    The face of a matrix of fixed rank is curved; with Z its multiplier and M⁺ the pseudo-inverse,
    moving along it adds 2⟨Z, dM M⁺ dM⟩ to the Hessian of f/2 (the sigma term of Shapiro 1997),
    which makes the steps quadratically convergent there too.
    """
    found = kkt(objective, system, active, x, data)
    best, fruitless = (x, active, found), 0
    # The first step may only move the multipliers to their new null space: two tries in vain.
    while fruitless < 2:
        step = _newton_step(objective, system, active, x, found)
        if step is None or not np.isfinite(step).all():
            break
        x = x + step
        active = _refreshed(system, active, x)
        found = kkt(objective, system, active, x, data)
        fruitless = 0 if found.residual < 0.5 * best[2].residual else fruitless + 1
        if found.residual < best[2].residual:
            best = (x, active, found)
    return best


def _newton_step(
    objective: ConstrainedObjective, system: System, active: Active, x: Array, at: Kkt
) -> Array | None:
    space = equality_space(*tangent_rows(system, active, x))
    if not space.basis.shape[1]:
        return space.origin
    K = np.vstack([objective.root(x), *_curvature(system, active, at, x)])
    R = linalg.qr(K @ space.basis, mode="r")[0][: space.basis.shape[1]]
    diagonal = np.abs(np.diag(R))
    if len(R) < R.shape[1] or diagonal.min() <= 1e-12 * diagonal.max():
        return None
    slope = space.basis.T @ (K.T @ (K @ space.origin) + objective.half_gradient(x))
    w = linalg.solve_triangular(R, linalg.solve_triangular(R, slope, trans="T"))
    return space.origin - space.basis @ w


def _curvature(system: System, active: Active, at: Kkt, x: Array) -> list[Array]:
    """Rows whose squares add up to 2⟨Z, dM M⁺ dM⟩: vec(√2 Z^½ slopes_i M⁺^½) by matrix."""
    rows = []
    for matrix, N, Z in zip(system.matrices, active.nulls, at.matrices, strict=True):
        if not N.shape[1]:
            continue
        values, vectors = np.linalg.eigh(matrix.at(x))
        range_ = vectors[:, N.shape[1] :] / np.sqrt(
            np.maximum(values[N.shape[1] :], np.finfo(float).tiny)
        )
        z_values, z_vectors = np.linalg.eigh(Z)
        root = (z_vectors * np.sqrt(2 * np.maximum(z_values, 0.0))).T
        rows.append((root @ matrix.slopes @ range_).reshape(len(x), -1).T)
    return rows


def _refreshed(system: System, active: Active, x: Array) -> Active:
    """The same bounds and ranks, with the null spaces of the matrices at x."""
    nulls = [
        np.linalg.eigh(matrix.at(x))[1][:, : N.shape[1]]
        for matrix, N in zip(system.matrices, active.nulls, strict=True)
    ]
    return Active(active.lower, active.upper, tuple(nulls))


def _triangle(k: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """The upper triangle (i, j) column by column, and √2 off the diagonal."""
    j, i = np.tril_indices(k)
    return i, j, np.where(i == j, 1.0, np.sqrt(2.0))


def _matrices(entries: Array, sizes: list[int]) -> tuple[Array, ...]:
    """Symmetric matrices (k, k) of the `sizes`, from their triangles one after the other."""
    found = []
    for k in sizes:
        i, j, factor = _triangle(k)
        matrix = np.zeros((k, k))
        matrix[i, j] = matrix[j, i] = entries[: len(i)] / factor
        entries = entries[len(i) :]
        found.append(matrix)
    return tuple(found)


# Fits as conic programs, solved by Clarabel.
#
# With x = T u such that squares have the minimum |u|², and a constant, at u = 0, a fit of squares
# is the least |u|² under bounds and matrices.  For Huber's loss of r_i = y_i − B_i x it is
#
#     minimise  |e|² + 2 threshold Σ t_i,    |r_i − e_i| ≤ t_i,    e = target − P x beside these.

TOLERANCES = (1e-10, 1e-8, 1e-6)  # the next where the solver gives up
FAR_OFF, LONGER = 10.0, 1e2  # times the expected length: where x is longer; without an x
ATTEMPTS = 5
OPTIMAL = ("optimal", "optimal_inaccurate")


@dataclass(frozen=True)
class ConicPoint:
    """Minimiser x (p,) and multipliers: of the bounds (p,) each, and of each matrix (n, n)."""

    x: Array
    lower: Array
    upper: Array
    matrices: tuple[Array, ...]


def solve_conic(
    objective: ConstrainedObjective, system: System, T: Array, size: float
) -> ConicPoint | None:
    """Minimise the objective over x = T u under bounds and matrices; None where infeasible.

    `size` is the length of x to expect: the program is posed in x/size, objective by size², and
    solved again where x comes out far longer.  The equalities are to be met by every T u.
    """
    moves = np.linalg.norm(T, axis=1)
    fixed = moves <= RANK * np.max(moves, initial=0.0)
    if np.max(np.maximum(system.lower, -system.upper)[fixed], initial=0.0) > RANK:
        return None
    free = np.where(fixed, np.inf, 0.0)
    system = replace(system, lower=system.lower - free, upper=system.upper + free)
    for _ in range(ATTEMPTS):
        status, point = _posed(objective, system, T, size)
        if "PrimalInfeasible" in status:
            return None
        length = LONGER * size if point is None else float(np.linalg.norm(point.x))
        if point is not None and length <= FAR_OFF * size:
            break
        size = length
    if point is None:
        raise ElastocalError(
            f"the cone solver stopped with '{status}'; the problem may be badly scaled: check the "
            "units of the bounds and of the prior"
        )
    return point


def _posed(
    objective: ConstrainedObjective, system: System, T: Array, size: float
) -> tuple[str, ConicPoint | None]:
    """Status, and the minimiser where one was found, of the program in x/size."""
    import clarabel

    # No x of the length expected reaches a farther bound, whose size would cost digits.
    below, above = system.lower >= -FAR_OFF * size, system.upper <= FAR_OFF * size
    rows, limits = [-T[below], T[above]], [-system.lower[below], system.upper[above]]
    cones = [clarabel.NonnegativeConeT(int(below.sum() + above.sum()))]
    for m in system.matrices:
        i, j, factor = _triangle(len(m.balance))
        rows.append(-(m.slopes[:, i, j] * factor).T @ T)
        limits.append(m.constant[i, j] * factor)
        cones.append(clarabel.PSDTriangleConeT(len(m.balance)))
    A, b = sparse.csr_array(np.vstack(rows)), np.concatenate(limits) / size
    bends, cost = np.ones(T.shape[1]), np.zeros(T.shape[1])
    if not objective.loss.quadratic:
        J = np.vstack([objective.B, objective.P]) @ T
        d = np.concatenate([objective.y, objective.target]) / size
        loss, k, n = objective.loss, len(J), len(objective.y) // objective.loss.size
        bends = np.repeat([0.0, 1.0, 0.0], [T.shape[1], k, n])
        cost = np.repeat([0.0, 2 * loss.threshold / size], [T.shape[1] + k, n])
        of_t = sparse.hstack([sparse.csr_array((n, T.shape[1] + k)), -sparse.eye_array(n)])
        of_r = sparse.hstack([J, sparse.eye_array(k), sparse.csr_array((k, n))])
        # A reading's cone has its t_i, then its rows; those of the prior are equations.
        order = np.insert(np.arange(n, n + k), np.arange(n) * loss.size, np.arange(n))
        A = sparse.hstack([A, sparse.csr_array((len(b), k + n))])
        A = sparse.vstack([A, sparse.vstack([of_t, of_r]).tocsr()[order]])
        b = np.concatenate([b, np.append(np.zeros(n), d)[order]])
        cones += [clarabel.SecondOrderConeT(loss.size + 1)] * n
        cones += [clarabel.ZeroConeT(len(objective.P))]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    P = sparse.csc_matrix(sparse.diags_array(2 * bends))
    for tolerance in TOLERANCES:
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
        found = clarabel.DefaultSolver(P, cost, sparse.csc_matrix(A), b, cones, settings).solve()
        status = str(found.status)
        if status in ("Solved", "AlmostSolved"):
            break
        if "PrimalInfeasible" in status:
            return status, None
    else:
        return status, None
    u, z = np.array(found.x)[: T.shape[1]], size * np.array(found.z)
    lower, upper = np.zeros(len(T)), np.zeros(len(T))
    lower[below], upper[above], z = np.split(z, np.cumsum([below.sum(), above.sum()]))
    matrices = _matrices(z, [len(m.balance) for m in system.matrices])
    return status, ConicPoint(size * (T @ u), lower, upper, matrices)


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


def extent(system: System, index: int) -> tuple[float, float]:
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
