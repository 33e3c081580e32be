"""Orthogonal factors of B, in which every covariance estimator of this package works."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from elastocal.errors import InputError, InsufficientDataError
from elastocal.identification.linear_input import checked_problem

Array = NDArray[np.float64]
EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class Orthogonal:
    """Q (rows, p) with QᵀQ = I and V (p, p) with x̂ = V Qᵀy and V Vᵀ = (BᵀB)⁻¹.

    Any sandwich (BᵀB)⁻¹ BᵀΩB (BᵀB)⁻¹ is V (QᵀΩQ) Vᵀ: BᵀB, whose condition is that of B squared,
    is never formed.  Row j of V is the coefficient of parameter j on the columns of Q.
    """

    Q: Array
    V: Array

    def sandwich(self, meat: Array) -> Array:
        """V · meat · Vᵀ (p, p), symmetric to the last bit, of QᵀΩQ (p, p)."""
        matrix = self.V @ meat @ self.V.T
        return (matrix + matrix.T) / 2


def orthogonal(B: ArrayLike, y: ArrayLike) -> tuple[Orthogonal, Array]:
    """Factors of the whitened B (rows, p), and y or e (rows,) as a checked float array.

    Raises InputError where the arrays do not match, are not finite or the columns depend on each
    other, InsufficientDataError where there are no more rows than parameters.
    """
    B, y, _, _ = checked_problem(B, y, None, None)
    rows, p = B.shape
    if rows <= p:
        raise InsufficientDataError(
            f"{rows} rows leave no residual of {p} parameters to estimate a variance from;"
            " measure more configurations or fit fewer parameters"
        )
    lengths = np.linalg.norm(B, axis=0)
    lengths[lengths == 0] = 1.0
    Q, R, order = linalg.qr(B / lengths, mode="economic", pivoting=True)
    pivots = np.abs(np.diag(R))
    dependent = np.flatnonzero(pivots <= rows * EPS * pivots[0])
    if dependent.size:
        names = sorted(int(k) for k in order[dependent])
        raise InputError(f"columns {names} of B depend on the others; drop them first")
    V = np.empty((p, p))
    V[order] = linalg.solve_triangular(R, np.eye(p)) / lengths[order, None]
    return Orthogonal(Q, V), y
