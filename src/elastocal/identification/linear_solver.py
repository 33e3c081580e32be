"""Weighted linear least squares: the steps and the final solve of every fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from elastocal.errors import InputError
from elastocal.units import Array

# Check of the arrays that enter a weighted linear least-squares problem.


def checked_problem(
    B: ArrayLike, y: ArrayLike, weights: ArrayLike | None, scale: ArrayLike | None
) -> tuple[Array, Array, Array, Array | None]:
    """All four as finite float arrays of matching shapes, or an InputError that names one."""
    B = _finite("B", B)
    if B.ndim != 2 or 0 in B.shape:
        raise InputError(f"B must have shape (rows, parameters), none zero; got {B.shape}")
    m, p = B.shape
    y = _finite("y", y)
    if y.shape != (m,):
        raise InputError(f"y must have shape ({m},), as B has {m} rows; got {y.shape}")
    weights = np.ones(m) if weights is None else _positive("weights", weights, m, "rows")
    return B, y, weights, None if scale is None else _positive("scale", scale, p, "columns")


def _positive(name: str, values: ArrayLike, size: int, like: str) -> Array:
    array = _finite(name, values)
    if array.shape != (size,):
        shape = f"({size},), as B has {size} {like}"
        raise InputError(f"{name} must have shape {shape}; got {array.shape}")
    bad = np.flatnonzero(array <= 0)
    if bad.size:
        raise InputError(f"{name} must be positive; {name}[{bad[0]}] is {array[bad[0]]}")
    return array


def _finite(name: str, values: ArrayLike) -> Array:
    try:
        if np.iscomplexobj(values):
            raise TypeError("found complex ones")
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be an array of real numbers: {error}") from None
    bad = np.argwhere(~np.isfinite(array))
    if bad.size:
        at = tuple(int(i) for i in bad[0])
        raise InputError(f"{name} must be finite; {name}{list(at)} is {array[at]}")
    return array


# Weighted linear least squares: the step and the final solve of every identification.
#
#     minimise  sum_i (w_i (B x - y)_i)^2       (Klimchik et al. 2013, eqs. 9 and 10, W = diag(w))
#
# With A = W B S, b = W y and S = diag(column scales), Householder QR with column pivoting,
# A P = Q R, decides the rank.  Columns beyond it are dropped and reported; nothing is hidden in a
# pseudo-inverse.  With V = S P R^-1, V V^T = (B^T W^2 B)^-1, two steps of iterative refinement
#
#     r = b - W B x,    x <- x + V Q^T r
#
# take back what the first solve lost (Björck 1967, BIT 7).  Of x stay about 16 digits less those
# of the condition number, and less those of its square times the residual over the signal.

EPS = float(np.finfo(np.float64).eps)
REFINEMENTS = 2
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class LinearSolution:
    """Minimiser of sum_i (w_i (B x - y)_i)^2 over the kept columns of B."""

    x: Array  # (p,) parameters; 0 for dropped columns
    residual: Array  # (m,) y - B x, unweighted
    kept: Indices  # (rank,) ascending indices of the columns that were solved for
    dropped: Indices  # (p - rank,) columns that depend on kept ones; the caller decides
    cofactor: Array  # (rank, rank) (B^T W^2 B)^-1 of the kept columns
    rss: float  # weighted sum of squares, sum (w_i r_i)^2
    dof: int  # m - rank

    def covariance(self) -> Array:
        """Covariance (p, p): rss / dof * cofactor, NaN in rows and columns of dropped ones, and
        throughout where no degree of freedom is left."""
        variance = self.rss / self.dof if self.dof > 0 else np.nan
        covariance = np.full((self.x.size, self.x.size), np.nan)
        covariance[np.ix_(self.kept, self.kept)] = variance * self.cofactor
        return covariance


def solve_weighted(
    B: ArrayLike,
    y: ArrayLike,
    weights: ArrayLike | None = None,
    *,
    scale: ArrayLike | None = None,
) -> LinearSolution:
    """Solve min sum_i (w_i (B x - y)_i)^2 by pivoted QR and two refinements.

    B: (m, p), y: (m,), weights: (m,) positive, default 1.
    scale: (p,) typical sizes of the parameters; columns are multiplied by them before the rank
    is judged.  By default every weighted column is scaled to unit length.  A column is dropped
    where its pivot |R_kk| is at most max(m, p) * 2.2e-16 of |R_00|.
    """
    B, y, weights, scale = checked_problem(B, y, weights, scale)
    m, p = B.shape
    # Columns and weights of at most 1, so that no unit overflows: a power of two rounds nothing.
    heaviest = np.ldexp(1.0, np.frexp(np.max(weights))[1])
    exponent = np.frexp(np.max(np.abs(B), axis=0))[1]
    w = weights / heaviest
    A, b = w[:, None] * np.ldexp(B, -exponent), w * y
    norms = np.linalg.norm(A, axis=0)
    unit = 1 / np.where(norms > 0, norms, 1.0) if scale is None else np.ldexp(scale, exponent)
    Q, R, pivots = linalg.qr(A * unit, mode="economic", pivoting=True)
    sizes = np.abs(np.diag(R))
    rank = int(np.count_nonzero(sizes > max(m, p) * EPS * np.max(sizes, initial=0.0)))
    order = np.argsort(pivots[:rank])
    kept = np.asarray(pivots[:rank][order], dtype=np.intp)
    V = unit[kept, None] * linalg.solve_triangular(R[:rank, :rank], np.eye(rank))[order]
    z, r = np.zeros(rank), b
    for _ in range(1 + REFINEMENTS):
        z = z + V @ (Q[:, :rank].T @ r)
        r = b - A[:, kept] @ z
    x = np.zeros(p)
    x[kept] = np.ldexp(z, -exponent[kept])
    cofactor = V @ V.T / heaviest**2
    return LinearSolution(
        x=x,
        residual=r / w,
        kept=kept,
        dropped=np.setdiff1d(np.arange(p), kept),
        cofactor=np.ldexp(np.ldexp(cofactor, -exponent[kept]), -exponent[kept, None]),
        rss=float(r @ r) * heaviest**2,
        dof=m - kept.size,
    )


# Plain least squares, where the working precision will do.


def least_norm(A: Array, b: Array, cond: float | None = None, check_finite: bool = True) -> Array:
    """x (k, …) of least norm among those that minimise |A x − b|, by singular values; those below
    `cond` of the largest count as zero, by default what the rounding of so many rows makes.

    By LAPACK's divide and conquer.  That may fail to converge on finite numbers (a matrix of
    condition 3e6 did, by AVX-512 kernels, where it does not a rounding away); the slower
    iteration then converges.
    """
    if cond is None:
        cond = np.finfo(np.float64).eps * max(A.shape)
    try:
        return np.asarray(linalg.lstsq(A, b, cond=cond, check_finite=check_finite)[0])
    except linalg.LinAlgError:
        return np.asarray(linalg.lstsq(A, b, cond=cond, lapack_driver="gelss")[0])
