"""Plain least squares, where columns may depend on each other."""

from __future__ import annotations

import numpy as np
from scipy import linalg

from elastocal.units import Array


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
