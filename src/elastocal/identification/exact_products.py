"""Matrix products in about twice the working precision, at the speed of BLAS.

A number is carried as an unevaluated sum hi + lo of two doubles.  Two classical error-free
transformations are enough for that: the sum of two doubles (Knuth) and the product of two
doubles (Dekker, Veltkamp splitting) each equal a rounded double plus a double error.

For whole matrices the entries are cut into slices of few bits (Ozaki, Ogita, Oishi, Rump 2012,
"Error-free transformations of matrix multiplication", Numerical Algorithms 59).  With

    2 * bits + log2(inner dimension) <= 53

the product of two slices is exact in ordinary double arithmetic, in whatever order BLAS sums.
Nothing here needs an extended `long double`, which several platforms do not have.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SLICES = 3
BLOCK = 2**14  # entries of a product at a time, so that temporaries stay in cache
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

    `times` and `transposed_times` return hi, lo of the product with an (unrounded) right hand
    side.  The error is below 2^-100 times (inner dimension) times the largest entries; it does
    not grow with cancellation.  Memory: five arrays of the size of the matrix.
    """

    def __init__(self, hi: Array, lo: Array):
        self.hi = hi
        self._bits = (53 - int(np.ceil(np.log2(max(*hi.shape, 2))))) // 2
        self._slices, rests = _cut(hi, lo, self._bits)
        self._rest = rests[-1]

    def times(self, right: Array, right_lo: Array | None = None) -> tuple[Array, Array]:
        """(hi + lo) @ right; right: (p,) or (p, q)."""
        exponent, right_slices, right_rests = self._cut_right(right, right_lo)
        shape = (self.hi.shape[0], *right.shape[1:])
        hi, lo = np.empty(shape), np.empty(shape)
        count = max(1, BLOCK * shape[0] // max(1, hi.size))
        for start in range(0, shape[0], count):
            rows = slice(start, start + count)
            left = [part[rows] for part in self._slices]
            hi[rows], lo[rows] = _multiply(left, self._rest[rows], right_slices, right_rests)
        return np.ldexp(hi, exponent), np.ldexp(lo, exponent)

    def transposed_times(self, right: Array, right_lo: Array | None = None) -> tuple[Array, Array]:
        """(hi + lo).T @ right; right: (m,) or (m, q)."""
        exponent, right_slices, right_rests = self._cut_right(right, right_lo)
        left = [part.T for part in self._slices]
        hi, lo = _multiply(left, self._rest.T, right_slices, right_rests)
        return np.ldexp(hi, exponent), np.ldexp(lo, exponent)

    def _cut_right(
        self, right: Array, right_lo: Array | None
    ) -> tuple[NDArray[np.int32], list[Array], list[Array]]:
        """Scale each column to at most 1 in size and cut it; the rests start with the whole."""
        exponent = power_of_two_above(np.max(np.abs(right), axis=0, initial=0.0))
        hi = np.ldexp(right, -exponent)
        lo = np.zeros_like(right) if right_lo is None else np.ldexp(right_lo, -exponent)
        slices, rests = _cut(hi, lo, self._bits)
        return exponent, slices, [hi, *rests]


def _multiply(
    slices: list[Array], rest: Array, right_slices: list[Array], right_rests: list[Array]
) -> tuple[Array, Array]:
    """Sum of all products of parts: the large ones without error, the small ones rounded."""
    hi = slices[0] @ right_slices[0]
    lo = rest @ right_rests[0]
    for i, left in enumerate(slices):
        for j in range(SLICES - i):
            if i + j > 0:
                hi, error = two_sum(hi, left @ right_slices[j])  # the product has no error
                lo += error
        lo += left @ right_rests[SLICES - i]
    return two_sum(hi, lo)
