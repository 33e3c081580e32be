"""The linear model of every robust fit: checked input and an orthonormal basis of B."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from elastocal.errors import InsufficientDataError, require
from elastocal.identification.linear_input import checked_problem

Array = NDArray[np.float64]

DEPENDENT = 1e-12  # share of its length off the columns before it, below which a column is none


@dataclass(frozen=True)
class Design:
    """y (rows,) ≈ B (rows, p) x in n observations of `size` consecutive whitened rows.

    B = Q R diag(norm) with orthonormal Q (rows, p).  Solvers work with z = R diag(norm) x, where
    |Q δz| = |δz|: the units of the parameters and their scaling cannot matter.
    """

    B: Array
    y: Array
    size: int
    Q: Array
    R: Array
    norm: Array

    @property
    def n(self) -> int:
        return len(self.y) // self.size

    @property
    def p(self) -> int:
        return self.Q.shape[1]

    @property
    def floor(self) -> float:
        """Smallest scale that rounding of y lets a residual have."""
        return float(np.finfo(float).eps * np.sqrt(np.mean(self.y**2)) + np.finfo(float).tiny)

    def parameters(self, z: Array) -> Array:
        """x (p,) or (p, k) of coordinates z."""
        return (linalg.solve_triangular(self.R, z, check_finite=False).T / self.norm).T

    def coordinates(self, x: Array) -> Array:
        """z (p,) of parameters x (p,)."""
        return self.R @ (self.norm * x)

    def residual(self, z: Array) -> Array:
        """y − Q z (rows,)."""
        return self.y - self.Q @ z

    @property
    def cofactor(self) -> Array:
        """(BᵀB)⁻¹ (p, p)."""
        inverse = self.parameters(np.eye(self.p))
        return inverse @ inverse.T

    def rows(self, weights: Array) -> Array:
        """Per-observation weights (n,) repeated for the rows (rows,)."""
        return np.repeat(weights, self.size)

    def weighted_step(self, weights: Array, r: Array) -> Array:
        """δz (p,) minimising Σ w_i |r_i − Q_i δz|².

        Raises InsufficientDataError where the observations that keep a weight do not determine
        every parameter.
        """
        QW = self.Q.T * self.rows(weights)
        gram = QW @ self.Q
        try:
            factor = linalg.cho_factor(gram, check_finite=False)
        except linalg.LinAlgError:
            raise InsufficientDataError(
                "the observations that the loss does not reject do not determine all parameters; "
                "measure more, or fit fewer parameters"
            ) from None
        return np.asarray(linalg.cho_solve(factor, QW @ r, check_finite=False))


def design(B: ArrayLike, y: ArrayLike, size: int) -> Design:
    """Check B (n·size, p) and y (n·size,), and factor B.

    Raises InputError for wrong shapes or values that are not finite, rows that are no multiple
    of `size`, no degree of freedom, or columns that depend on others.
    """
    B, y, _, _ = checked_problem(B, y, None, None)
    m, p = B.shape
    require(
        size >= 1 and m % size == 0,
        f"{m} rows cannot be split into observations of {size} rows; check size",
    )
    require(
        m > p,
        f"{m} rows leave no degree of freedom for {p} parameters; measure more or fit fewer",
    )
    norm = np.linalg.norm(B, axis=0)
    Q, R = linalg.qr(B / np.where(norm > 0, norm, 1.0), mode="economic")
    dependent = np.flatnonzero((np.abs(np.diag(R)) < DEPENDENT) | (norm == 0))
    require(
        not dependent.size,
        f"columns {dependent.tolist()} of B are zero or depend on the columns before them; "
        "drop them first",
    )
    return Design(B, y, size, Q, R, norm)


def lengths(residual: Array, size: int) -> Array:
    """|e_i| (n,) of each observation; for size 1 its absolute value."""
    return np.abs(residual) if size == 1 else np.linalg.norm(residual.reshape(-1, size), axis=1)
