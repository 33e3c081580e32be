"""Weighted linear least squares with certified digits: the steps and final solve of every fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from elastocal.errors import InputError
from elastocal.units import Array

# Matrix products in about twice the working precision, at the speed of BLAS.
#
# A number is carried as an unevaluated sum hi + lo of two doubles.  Two classical error-free
# transformations are enough for that: the sum of two doubles (Knuth) and the product of two
# doubles (Dekker, Veltkamp splitting) each equal a rounded double plus a double error.
#
# For whole matrices the entries are cut into slices of few bits (Ozaki, Ogita, Oishi, Rump 2012,
# "Error-free transformations of matrix multiplication", Numerical Algorithms 59).  With
#
#     2 * bits + log2(inner dimension) <= 53
#
# the product of two slices is exact in ordinary double arithmetic, in whatever order BLAS sums.
# Nothing here needs an extended `long double`, which several platforms do not have.

SLICES = 3
_VELTKAMP = 2.0**27 + 1.0


def two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """Return s = fl(a + b) and e with s + e = a + b exactly."""
    s = a + b
    t = s - a
    return s, (a - (s - t)) + (b - t)


def two_product(a: Array, b: Array) -> tuple[Array, Array]:
    """Return p = fl(a b) and e with p + e = a b exactly (no overflow: |a|, |b| < 2^500)."""
    p = a * b
    a_hi, a_lo = _halves(a)
    b_hi, b_lo = _halves(b)
    return p, ((a_hi * b_hi - p) + a_hi * b_lo + a_lo * b_hi) + a_lo * b_lo


def _halves(a: Array) -> tuple[Array, Array]:
    c = _VELTKAMP * a
    hi = c - (c - a)
    return hi, a - hi


def power_of_two_above(size: Array) -> NDArray[np.int32]:
    """Exponent e with size < 2^e (0 where size is 0): scaling by 2^-e is exact."""
    return np.asarray(np.frexp(size)[1], dtype=np.int32)


def _cut(hi: Array, lo: Array, bits: int) -> tuple[list[Array], list[Array]]:
    """Cut hi + lo, |hi| <= 1, into SLICES slices of `bits` bits.

    Returns the slices and, after each of them, what is left (rounded to one double).
    """
    slices, rests = [], []
    for k in range(1, SLICES + 1):
        grid = 1.5 * 2.0 ** (52 - bits * k)  # adding and removing it rounds to multiples of
        part = (hi + grid) - grid  #            2^(-bits k)
        hi, lo = two_sum(hi - part, lo)
        slices.append(part)
        rests.append(hi + lo)
    return slices, rests


class ExactMatrix:
    """A fixed matrix hi + lo: (m, p) with entries of at most 1 in size, sliced once, used often.

    Memory: five arrays of the size of the matrix.
    """

    def __init__(self, hi: Array, lo: Array):
        self.hi = hi
        self._bits = (53 - int(np.ceil(np.log2(max(*hi.shape, 2))))) // 2
        self._slices, rests = _cut(hi, lo, self._bits)
        self._rest = rests[-1]

    def times(
        self, right: Array, right_lo: Array | None = None, transposed: bool = False
    ) -> tuple[Array, Array]:
        """hi, lo of (hi + lo) @ (right + right_lo), (p,) or (p, q); with (hi + lo).T `transposed`.

        The error is below 2^-100 times (inner dimension) times the largest entries; it does not
        grow with cancellation: the large products of slices have none, the small ones are rounded.
        """
        left = [part.T if transposed else part for part in (*self._slices, self._rest)]
        exponent = power_of_two_above(np.max(np.abs(right), axis=0, initial=0.0))
        right = np.ldexp(right, -exponent)
        right_lo = np.zeros_like(right) if right_lo is None else np.ldexp(right_lo, -exponent)
        slices, rests = _cut(right, right_lo, self._bits)
        rests = [right, *rests]
        hi, lo = left[0] @ slices[0], left[-1] @ right
        for i in range(SLICES):
            for j in range(SLICES - i):
                if i + j > 0:
                    hi, error = two_sum(hi, left[i] @ slices[j])  # the product has no error
                    lo += error
            lo += left[i] @ rests[SLICES - i]
        hi, lo = two_sum(hi, lo)
        return np.ldexp(hi, exponent), np.ldexp(lo, exponent)


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
# The steps, with A = W B S, b = W y and S = diag(column scales):
#
# 1. Householder QR with column pivoting, A P = Q R, decides the rank.  Columns beyond it are
#    dropped and reported; nothing is hidden in a pseudo-inverse.
# 2. T = P R^-1 makes A T nearly orthonormal.  The product is formed in twice the working precision,
#    (A T)^T (A T) = L L^T is close to the identity, and V = T L^-T satisfies
#
#        V V^T = (A^T A)^-1
#
#    to working precision although R alone is only good to precision times condition number.
# 3. Iterative refinement of the augmented system (Björck 1967, BIT 7), here with the residual r
#    eliminated, x kept and both equations evaluated in twice the working precision:
#
#        r = b - A x,    x <- x + V V^T (A^T r)
#
#    The result is that of exact arithmetic on the given B, y, w, rounded, as long as
#    condition * 2e-16 stays below one.

EPS = float(np.finfo(np.float64).eps)
MAX_REFINEMENTS = 30
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
    """Solve min sum_i (w_i (B x - y)_i)^2 to nearly full double precision.

    B: (m, p), y: (m,), weights: (m,) positive, default 1.
    scale: (p,) typical sizes of the parameters; columns are multiplied by them before the rank
    is judged.  By default every weighted column is scaled to unit length.  A column is dropped
    where its pivot |R_kk| is at most max(m, p) * 2.2e-16 of |R_00|.
    """
    B, y, weights, scale = checked_problem(B, y, weights, scale)
    m, p = B.shape

    # Exact scaling by powers of two: all weights and columns at most 1, b at most 1.
    weight_exponent = math.frexp(np.max(weights))[1]
    w = np.ldexp(weights, -weight_exponent)
    exponent = power_of_two_above(np.max(np.abs(B), axis=0))
    hi, lo = two_product(w[:, None], np.ldexp(B, -exponent))
    more = power_of_two_above(np.max(np.abs(hi), axis=0))
    hi, lo, exponent = np.ldexp(hi, -more), np.ldexp(lo, -more), exponent + more
    y_exponent = math.frexp(np.max(np.abs(y)))[1]
    b_hi, b_lo = two_product(w, np.ldexp(y, -y_exponent))

    if scale is None:
        norms = np.linalg.norm(hi, axis=0)
        unit = 1.0 / np.where(norms > 0, norms, 1.0)
    else:
        unit = np.ldexp(scale, exponent)
    kept, A, V = _factor(hi, lo, unit)
    z, r = _refine(A, V, b_hi, b_lo)
    x = np.zeros(p)
    x[kept] = np.ldexp(z, y_exponent - exponent[kept])
    back = weight_exponent + exponent[kept]  # (B^T W^2 B)^-1 in the units of B and w
    rss = float(np.ldexp(r @ r, 2 * (y_exponent + weight_exponent)))
    return LinearSolution(
        x=x,
        residual=np.ldexp(r / w, y_exponent),
        kept=kept,
        dropped=np.setdiff1d(np.arange(p), kept),
        cofactor=np.ldexp(np.ldexp(V @ V.T, -back), -back[:, None]),
        rss=rss,
        dof=m - kept.size,
    )


def _factor(hi: Array, lo: Array, unit: Array) -> tuple[Indices, ExactMatrix, Array]:
    """Kept columns, the matrix A of these, V with V V^T = (A^T A)^-1."""
    R, pivots = linalg.qr(hi * unit, mode="r", pivoting=True)
    pivot_sizes = np.abs(np.diag(R))
    tolerance = max(hi.shape) * EPS * np.max(pivot_sizes, initial=0.0)
    rank = int(np.count_nonzero(pivot_sizes > tolerance))
    while True:
        order = np.argsort(pivots[:rank])
        kept = np.asarray(pivots[:rank][order], dtype=np.intp)
        A = ExactMatrix(hi[:, kept], lo[:, kept])
        if rank == 0:
            return kept, A, np.zeros((0, 0))
        inverse = linalg.solve_triangular(R[:rank, :rank], np.eye(rank))
        T = unit[kept, None] * inverse[order]
        nearly_orthonormal, _ = A.times(T)
        try:
            L = linalg.cholesky(nearly_orthonormal.T @ nearly_orthonormal, lower=True)
        except linalg.LinAlgError:  # the last pivot was rounding noise after all
            rank -= 1
            continue
        V = linalg.solve_triangular(L, T.T, lower=True).T
        return kept, A, V


def _refine(A: ExactMatrix, V: Array, b_hi: Array, b_lo: Array) -> tuple[Array, Array]:
    """Least-squares z of A z = b, and its residual r = b - A z.

    z itself is carried as hi + lo: its rounding alone would leave a gradient that the next step
    amplifies by the square of the condition number.
    """
    z_hi = np.zeros(V.shape[0])
    z_lo = np.zeros(V.shape[0])
    last = np.inf
    for _ in range(MAX_REFINEMENTS):
        fit_hi, fit_lo = A.times(z_hi, z_lo)
        r_hi, error = two_sum(b_hi, -fit_hi)
        r_hi, r_lo = two_sum(r_hi, error + (b_lo - fit_lo))
        gradient, _ = A.times(r_hi, r_lo, transposed=True)
        step = V @ (V.T @ gradient)
        size = float(np.max(np.abs(step), initial=0.0))
        negligible = EPS / 4 * np.abs(z_hi) + EPS**2 * np.max(np.abs(z_hi), initial=0.0)
        if np.all(np.abs(step) <= negligible) or not size < last / 2:
            break
        z_hi, z_lo = two_sum(z_hi, z_lo + step)
        last = size
    return z_hi, r_hi


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
