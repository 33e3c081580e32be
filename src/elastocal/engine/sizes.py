"""Coefficients with a prior of unknown size, of which nothing is left of the rows but products.

    e = C b + ε,   ε ~ N(0, a²),   b ~ N(0, diag v),   v_j = v_j(θ)

with whitened rows, M = CᵀC and z = Cᵀe (columns without a prior projected out of both, and counted
off the rows).  In units of √v, A = 1 + √v M √v / a² = LLᵀ is the posterior precision and
b = A⁻¹√v z / a² the mean; with b integrated out

    −2 ℓ = n log a² + |e|²/a² + log|A| − bᵀA b   (+ n log 2π)
    ∂(−2ℓ)/∂ log v_j = 1 − (A⁻¹)_jj − b_j².
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from elastocal.units import Array, IntArray

SMALL = 64  # triangles that LAPACK inverts


@dataclass(frozen=True)
class Products:
    """M = CᵀC (k, k), z = Cᵀe (k,), |e|² and the number of rows, less that of columns without a
    prior."""

    M: Array
    z: Array
    squares: float
    rows: int

    def at(self, variances: Array, factor: float = 0.0) -> Standardised:
        """The coefficients under prior variances v (k,) and noise of the deviation e^factor."""
        return Standardised.of(self.M, self.z, np.sqrt(variances), float(np.exp(factor)))

    def value(self, at: Standardised) -> float:
        """−2ℓ but for n log 2π."""
        a = at.noise
        return 2 * self.rows * float(np.log(a)) + self.squares / a**2 + at.log_det - at.explained

    def objective(
        self, variances: Array, grown: Array, factor: float
    ) -> tuple[float, Array, Array]:
        """−2ℓ, slope and average information in the factor and θ (1 + m,), which let the logarithms
        of the variances grow by `grown` (k, m).

        Of two parameters that let them grow by s and t the mean of observed and expected curvature
        (Gilmour, Thompson and Cullis 1995, Biometrics 51, 1440) is sᵀb(1 − A⁻¹)bt.
        """
        at = self.at(variances, factor)
        b, a2, inverse = at.b, at.noise**2, at.inverse
        left = np.einsum("ij,ij->j", inverse, inverse)  # posterior over prior variance
        beta = np.sqrt(variances) * b
        rss = (self.squares - 2 * float(beta @ self.z) + float(beta @ (self.M @ beta))) / a2
        slope = np.empty(1 + grown.shape[1])
        slope[0] = 2 * (self.rows - (len(left) - left.sum()) - rss)
        slope[1:] = ((1 - left) - b**2) @ grown
        moved = grown * b[:, None]
        half, of_noise = linalg.blas.dtrmm(1.0, inverse, moved, lower=1), 2 * (inverse @ b)
        information = np.empty((len(slope),) * 2)
        information[1:, 1:] = moved.T @ moved - half.T @ half
        information[0, 1:] = information[1:, 0] = of_noise @ half
        information[0, 0] = 4 * rss - float(of_noise @ of_noise)
        return self.value(at), slope, information


@dataclass(frozen=True)
class Standardised:
    """The coefficients in units of their prior deviations `root` (k,): L, b, and bᵀA b, under noise
    of a deviation."""

    L: Array
    b: Array
    explained: float
    root: Array
    noise: float

    @classmethod
    def of(cls, M: Array, z: Array, root: Array, noise: float = 1.0) -> Standardised:
        scaled = root / noise
        A = M * scaled
        A *= scaled[:, None]
        A[np.diag_indices_from(A)] += 1.0
        # Symmetric, and LAPACK's own way round: nothing is copied.
        L = linalg.cholesky(A.T, lower=True, overwrite_a=True, check_finite=False)
        right = scaled * z / noise
        b = linalg.cho_solve((L, True), right, check_finite=False)
        return cls(L, b, float(b @ right), root, noise)

    @property
    def log_det(self) -> float:
        return 2 * float(np.log(np.diag(self.L)).sum())

    @property
    def inverse(self) -> Array:
        """L⁻¹ (k, k)."""
        return inverse_triangle(self.L)

    @cached_property
    def covariance(self) -> Array:
        """A⁻¹ (k, k), its lower triangle."""
        return np.asarray(linalg.lapack.dpotri(self.L, lower=1)[0])

    def left_out(self, groups: Sequence[IntArray | slice]) -> Array:
        """By how much ℓ falls (G,) where one of these groups of coefficients is left out, all else
        as it is (Savage and Dickey): with S its block of A⁻¹, ½ (log|S| + bᵀS⁻¹b)."""
        inverse, out = self.covariance, np.zeros(len(groups))
        for k, own in enumerate(groups):
            index = np.arange(len(self.b))[own]
            S = inverse[np.ix_(index, index)]
            C = linalg.cholesky(np.tril(S) + np.tril(S, -1).T, lower=True)
            y = linalg.solve_triangular(C, self.b[index], lower=True)
            out[k] = 0.5 * float(y @ y + 2 * np.log(np.diag(C)).sum())
        return out


def beside(
    M: Array, z: Array, prior: Array, others: IntArray, groups: Sequence[slice]
) -> list[tuple[Array, Array]]:
    """Of each of these groups c of columns what the others x, of prior precisions Λ, leave of
    their normal matrix and right side:

    A = M_cc − M_cx (M_xx + Λ)⁻¹ M_xc and b = z_c − M_cx (M_xx + Λ)⁻¹ z_x.
    """
    L = M[np.ix_(others, others)]
    L[np.diag_indices_from(L)] += prior[others]
    L = linalg.cholesky(L, lower=True, overwrite_a=True, check_finite=False)
    right = np.column_stack([M[np.ix_(others, np.r_[(slice(0, 0), *groups)])], z[others]])
    half = linalg.solve_triangular(L, right, lower=True, check_finite=False)
    out, start = [], 0
    for c in groups:
        own = half[:, start : start + c.stop - c.start]
        out.append((M[c, c] - own.T @ own, z[c] - own.T @ half[:, -1]))
        start += own.shape[1]
    return out


def inverse_triangle(L: Array) -> Array:
    """L⁻¹ of a lower triangular L (p, p), by halves: BLAS's products of triangles are two to three
    times as fast as LAPACK's inverse."""
    if len(L) <= SMALL:
        return np.asarray(linalg.lapack.dtrtri(L, lower=1)[0])
    h, out, multiply = len(L) // 2, np.zeros(L.shape, order="F"), linalg.blas.dtrmm
    out[:h, :h] = upper = inverse_triangle(L[:h, :h])
    out[h:, h:] = lower = inverse_triangle(L[h:, h:])
    out[h:, :h] = multiply(-1.0, upper, multiply(1.0, lower, L[h:, :h], lower=1), side=1, lower=1)
    return out
