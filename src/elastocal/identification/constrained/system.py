"""Constraints as numbers: bounds, linear equalities and matrix inequalities on a vector."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import require

Array = NDArray[np.float64]

# A constraint may be missed by this fraction of the numbers in it: round-off only.
ROUND_OFF = 1e-12


@dataclass(frozen=True)
class Matrix:
    """M(x) = constant + Σ x_i slopes_i ⪰ 0; constant (n, n), slopes (p, n, n), all symmetric.

    `balance` (n,) is d where the matrix stands for diag(d) M diag(d): a congruence changes no
    sign of an eigenvalue, and brings rows of different units to one size.
    """

    label: str
    constant: Array
    slopes: Array
    balance: Array

    def at(self, x: Array) -> Array:
        """M(x) (n, n)."""
        return self.constant + np.tensordot(x, self.slopes, axes=1)

    def balanced(self) -> Matrix:
        """The same inequality with diagonal entries that change by about 1 per unit of x."""
        largest = np.abs(np.diagonal(self.slopes, axis1=1, axis2=2)).max(axis=0, initial=0.0)
        d = 1 / np.sqrt(np.where(largest > 0, largest, 1.0))
        both = np.outer(d, d)
        return Matrix(self.label, self.constant * both, self.slopes * both, self.balance * d)

    def shortfall(self, x: Array) -> float:
        """How far the smallest eigenvalue of M(x) lies below zero; 0 where M(x) ⪰ 0."""
        return max(0.0, -float(np.linalg.eigvalsh(self.at(x))[0]))


@dataclass(frozen=True)
class System:
    """lower ≤ x ≤ upper, A x = b, and every matrix ⪰ 0, for x (p,) with `names`."""

    names: tuple[str, ...]
    lower: Array
    upper: Array
    A: Array
    b: Array
    equality_labels: tuple[str, ...]
    matrices: tuple[Matrix, ...]

    def moved(self, centre: Array, unit: Array) -> System:
        """The same constraints on z, where x = centre + unit · z (unit positive)."""
        matrices = tuple(
            Matrix(m.label, m.at(centre), m.slopes * unit[:, None, None], m.balance).balanced()
            for m in self.matrices
        )
        return replace(
            self,
            lower=(self.lower - centre) / unit,
            upper=(self.upper - centre) / unit,
            A=self.A * unit,
            b=self.b - self.A @ centre,
            matrices=matrices,
        )

    def boxed(self, half_width: Array) -> System:
        """With |x| ≤ half_width (p,) as well; what a step may do inside a trust region."""
        lower, upper = np.maximum(self.lower, -half_width), np.minimum(self.upper, half_width)
        return replace(self, lower=lower, upper=upper)

    def with_value(self, index: int, value: float) -> System:
        """With x[index] = value as a further equality, in place of its bounds."""
        row = np.zeros(len(self.names))
        row[index] = 1.0
        lower, upper = self.lower.copy(), self.upper.copy()
        lower[index], upper[index] = -np.inf, np.inf
        return replace(
            self,
            lower=lower,
            upper=upper,
            A=np.vstack([self.A, row]),
            b=np.append(self.b, value),
            equality_labels=(*self.equality_labels, f"{self.names[index]} = {value:.6g}"),
        )

    def violation(self, x: Array) -> float:
        """The largest amount by which x breaks a bound, an equality (unit rows) or a matrix."""
        norms = np.linalg.norm(self.A, axis=1)
        missed = np.abs(self.A @ x - self.b) / np.where(norms > 0, norms, 1.0)
        parts = (self.lower - x, x - self.upper, missed, [m.shortfall(x) for m in self.matrices])
        return float(max(0.0, *(np.max(part, initial=0.0) for part in parts)))

    def distance(self, x: Array) -> float:
        """A lower bound of the way |Δx| from x to where bounds and matrices hold."""
        parts = [self.lower - x, x - self.upper]
        # An eigenvalue of M changes by at most |Δx| √(Σ ‖slopes_i‖²).
        parts += [np.array([m.shortfall(x) / np.linalg.norm(m.slopes)]) for m in self.matrices]
        return float(max(0.0, *(np.max(part, initial=0.0) for part in parts)))

    def restricted(self, columns: NDArray[np.int64], x: Array) -> System:
        """The constraints on x[columns], all other parameters held at x (p,).

        Raises InputError where the held values alone break a constraint.
        """
        held = np.setdiff1d(np.arange(len(self.names)), columns)
        slack = ROUND_OFF * np.abs(x)
        outside = (x < self.lower - slack) | (x > self.upper + slack)
        for c in held[outside[held]]:
            require(
                False,
                f"{self.names[c]} is held at {x[c]:.6g}, outside its bounds "
                f"[{self.lower[c]:.6g}, {self.upper[c]:.6g}]; free it, move it or widen them",
            )
        b = self.b - self.A[:, held] @ x[held]
        size = np.abs(self.A[:, held]) @ np.abs(x[held]) + np.abs(self.b)
        free = (self.A[:, columns] != 0).any(axis=1)
        for k in np.flatnonzero(~free):
            require(
                bool(abs(b[k]) <= ROUND_OFF * size[k]),
                f"'{self.equality_labels[k]}' does not hold ({b[k]:+.3g} is missing), and every "
                "parameter in it is held; free one of them or drop the equality",
            )
        rest = np.where(np.isin(np.arange(len(x)), held), x, 0.0)
        matrices = []
        for m in self.matrices:
            constant, slopes = m.at(rest), m.slopes[columns]
            if slopes.any():
                matrices.append(replace(m, constant=constant, slopes=slopes))
                continue
            require(
                m.shortfall(rest) <= ROUND_OFF * float(np.abs(constant).max(initial=0.0)),
                f"'{m.label}' is not positive semidefinite, and every parameter in it is held; "
                "free one of them or drop the matrix",
            )
        return System(
            tuple(self.names[c] for c in columns),
            self.lower[columns],
            self.upper[columns],
            self.A[np.ix_(free, columns)],
            b[free],
            tuple(s for s, keep in zip(self.equality_labels, free, strict=True) if keep),
            tuple(matrices),
        )
