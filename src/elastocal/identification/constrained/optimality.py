"""Active constraints, their multipliers, the KKT residual, and Newton steps on the active face.

With f the objective, M_l the matrices and N_l a basis of the null space of M_l(x), the point x is
the minimum where all constraints hold and

    ∇f/2 = Aᵀλ + Σ_lower λ_i e_i − Σ_upper λ_i e_i + Σ_l [⟨Z_l, slopes_i⟩]_i,   Z_l = N_l Λ_l N_lᵀ,

with λ ≥ 0 for bounds and Λ_l ⪰ 0 (Boyd and Vandenberghe 2004, section 5.9).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.identification.constrained.objective import Objective
from elastocal.identification.constrained.polyhedral import equality_space
from elastocal.identification.constrained.system import System

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROUNDING = 1e-8  # of the data: their rounding, 1e-16, stays a small residual of that
ON_BOUND = 1e-7  # in units of x: what is closer to a bound lies on it


@dataclass(frozen=True)
class Active:
    """Bounds that hold x back (p,), and a null-space basis (n, k) of each matrix, k may be 0."""

    lower: Mask
    upper: Mask
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


def active_from_duals(
    system: System, x: Array, lower: Array, upper: Array, duals: tuple[Array, ...]
) -> Active:
    """Which constraints are active, by strict complementarity: slack < multiplier.

    M(x) and its multiplier Z share eigenvectors and M Z = 0, so the negative eigenvalues of
    M − Z are those of −Z, and belong to the null space.
    """
    nulls = []
    for matrix, Z in zip(system.matrices, duals, strict=True):
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


def kkt(objective: Objective, system: System, active: Active, x: Array, data: float = 0.0) -> Kkt:
    """Multipliers that come closest to stationarity with these constraints active.

    `data` is the length of the data that were subtracted from y beforehand, with their rounding.
    """
    rows, _ = tangent_rows(system, active, x)
    gradient = objective.half_gradient(x)
    multipliers = np.linalg.lstsq(rows.T, gradient, rcond=None)[0]
    left = gradient - rows.T @ multipliers
    cuts = np.cumsum([len(system.b), int(active.lower.sum()), int(active.upper.sum())])
    equalities, lower, upper, rest = np.split(multipliers, cuts)
    bounds = np.zeros(len(x))
    bounds[active.lower] += lower
    bounds[active.upper] += upper
    matrices, wrong = [], [np.max(-lower, initial=0.0), np.max(upper, initial=0.0)]
    for N in active.nulls:
        i, j, factor = _triangle(N.shape[1])
        inner = np.zeros((N.shape[1], N.shape[1]))
        inner[i, j] = inner[j, i] = rest[: len(i)] / factor
        rest = rest[len(i) :]
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
    objective: Objective, system: System, active: Active, x: Array, data: float
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
    objective: Objective, system: System, active: Active, x: Array, at: Kkt
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
    i, j = np.triu_indices(k)
    return i, j, np.where(i == j, 1.0, np.sqrt(2.0))
