"""Least squares under bounds and linear equalities: exact, finite, without a cone solver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.optimize import nnls

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

RANK = 1e-10  # of unit rows or columns: what is smaller is taken for round-off
INFEASIBLE = 1e-7  # residual of the dual problem, 1/√(1 + |t|²) for a feasible one of size |t|


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
    origin = Q[:, :rank] @ np.linalg.lstsq(rows @ Q[:, :rank], values, rcond=None)[0]
    gap = float(np.max(np.abs(rows @ origin - values)))
    return Affine(origin, Q[:, rank:], max(gap, float(np.max(np.abs(b[norms == 0]), initial=0.0))))


def least_distance(G: Array, h: Array) -> tuple[Array, Array] | None:
    """(t, u) with t = argmin |t|² subject to G t ≥ h, and multipliers u ≥ 0, t = Gᵀu.

    G (k, q), h (k,).  None where no t satisfies the inequalities.  Lawson and Hanson 1974,
    problem LDP of chapter 23: with v = argmin |[Gᵀ; hᵀ] v − e_{q+1}|, v ≥ 0, and r that residual,
    t_j = −r_j/r_{q+1}; r = 0 exactly where the inequalities contradict each other (Farkas).
    """
    k, q = G.shape
    norms = np.linalg.norm(G, axis=1)
    largest = float(np.max(np.abs(G), initial=0.0))
    fixed = norms <= RANK * largest
    unit = np.where(fixed, 1.0, norms)
    need = h / unit
    if not k or np.max(need) <= 0:
        return np.zeros(q), np.zeros(k)
    # Farthest constraint at distance 1: then |t| ≥ 1 and 1/(1 + |t|²) loses no digits.
    eta = float(np.max(need))
    if fixed.any() and np.max(need[fixed]) > RANK:
        return None
    rows, need = G[~fixed] / unit[~fixed, None], need[~fixed] / eta
    v, length = nnls(np.vstack([rows.T, need]), np.append(np.zeros(q), 1.0))
    r_last = need @ v - 1.0
    if length <= INFEASIBLE or not r_last < 0:
        return None
    u = np.zeros(k)
    u[~fixed] = -v / r_last * eta / unit[~fixed]
    return G.T @ u, u


def bounded_least_squares(
    R: Array, basis: Array, lower: Array, upper: Array
) -> tuple[Array, Mask, Mask] | None:
    """x = basis w with least |R w|² and lower ≤ x ≤ upper, and which bounds hold it back.

    R (q, q) upper triangular and regular, basis (p, q), lower and upper (p,).  None where the
    bounds leave no x.
    """
    below, above = np.isfinite(lower), np.isfinite(upper)
    G = linalg.solve_triangular(R, np.vstack([basis[below], -basis[above]]).T, trans="T").T
    found = least_distance(G, np.concatenate([lower[below], -upper[above]]))
    if found is None:
        return None
    t, u = found
    at_lower, at_upper = np.zeros(len(lower), dtype=bool), np.zeros(len(lower), dtype=bool)
    at_lower[below], at_upper[above] = (u > 0)[: below.sum()], (u > 0)[below.sum() :]
    return basis @ linalg.solve_triangular(R, t), at_lower, at_upper
