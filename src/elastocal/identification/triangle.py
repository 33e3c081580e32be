"""A least-squares problem of any length as a triangle: what is left of B and e after QR.

    [B e] = Q [R z; 0 ρ],   |e − B x|² = |z − R x|² + ρ²

R (p, p), z = Qᵀe (p,) and ρ decide everything that a fit asks of the rows: steps, rank, covariance,
sum of squares.  Triangles of parts of the rows are merged by the QR of one on top of the other
(TSQR; Demmel, Grigori, Hoemmen and Langou 2012, SIAM J. Sci. Comput. 34), which is backward
stable like a QR of all rows at once: the condition number enters once, not squared as in BᵀB.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Array = NDArray[np.float64]

# Numbers of [B e] formed and factorised at once where there are more rows: 2 MB, and in these the
# rows of a leaf, 16 for every column.  A leaf stays in the second level of cache, where LAPACK's
# panels, which go over all rows column by column, take half the time (docs/performance.md).
BLOCK = 2**18
LEAF, SMALLEST_LEAF = 16, 512


@dataclass(frozen=True)
class Triangle:
    """`augmented` (p + 1, p + 1) upper triangular: the R factor of [B e]; `rows` of B."""

    augmented: Array
    rows: int

    @classmethod
    def of(cls, B: Array, e: Array) -> Triangle:
        """The triangle of the whitened B (rows, p) and residual e (rows,)."""
        step = _leaf(B.shape[1] + 1, BLOCK)
        if len(e) <= step:
            return cls(_factor(np.column_stack([B, e])), len(e))
        blocks = (slice(first, first + step) for first in range(0, len(e), step))
        leaves = [_leaves(np.column_stack([B[block], e[block]])) for block in blocks]
        return cls(_factor(np.vstack(leaves)), len(e))

    def merged(self, other: Triangle) -> Triangle:
        """The triangle of the rows of both."""
        stacked = np.vstack([self.augmented, other.augmented])
        return Triangle(_factor(stacked), self.rows + other.rows)

    def of_columns(self, chosen: NDArray[np.integer]) -> Triangle:
        """The triangle of the columns `chosen` of B and the same e."""
        return Triangle(_factor(self.augmented[:, [*chosen, self.columns]]), self.rows)

    @property
    def columns(self) -> int:
        return self.augmented.shape[1] - 1

    @property
    def R(self) -> Array:
        """(p, p) with RᵀR = BᵀB."""
        return self.augmented[:-1, :-1]

    @property
    def projected(self) -> Array:
        """z = Qᵀe (p,), so that Rᵀz = Bᵀe."""
        return self.augmented[:-1, -1]

    @property
    def rest(self) -> float:
        """ρ: length of the part of e outside the span of B."""
        return float(abs(self.augmented[-1, -1]))

    @property
    def rss(self) -> float:
        """|e|²."""
        return float(self.augmented[:, -1] @ self.augmented[:, -1])

    def scaled(self, scale: Array) -> Triangle:
        """The triangle of B with its columns multiplied by `scale` (p,)."""
        return Triangle(self.augmented * np.append(scale, 1.0), self.rows)

    def step(self, scale: Array) -> Array:
        """Minimiser (p,) of |e − B x|², of least length in x/scale where several are.

        `scale` (p,) are typical sizes; the rank is judged with columns multiplied by them.
        """
        cond = max(self.rows, self.columns) * np.finfo(float).eps
        return scale * linalg.lstsq(self.R * scale, self.projected, cond=cond)[0]

    def cofactor(self, scale: Array) -> Array:
        """(BᵀB)⁻¹ (p, p) of a B with full column rank."""
        inverse = linalg.solve_triangular(self.R * scale, np.eye(self.columns))
        return (inverse @ inverse.T) * np.outer(scale, scale)


def merge(triangles: Iterable[Triangle]) -> Triangle:
    """The triangle of all rows, merged in the order given."""
    return reduce(Triangle.merged, triangles)


def _leaf(k: int, numbers: int = 0) -> int:
    """Rows of a leaf of `k` columns, or of as many leaves as `numbers` take."""
    rows = max(LEAF * k, SMALLEST_LEAF)
    return max(numbers // (rows * k), 1) * rows


def _leaves(rows: Array) -> Array:
    """The R factors of the leaves of `rows` (n, k) on top of each other."""
    k = rows.shape[1]
    leaf = _leaf(k)
    whole = len(rows) // leaf * leaf
    if not whole:
        return rows
    triangles = np.asarray(np.linalg.qr(rows[:whole].reshape(-1, leaf, k), mode="r"))
    return np.vstack([triangles.reshape(-1, k), rows[whole:]])


def _factor(rows: Array) -> Array:
    """R factor (k, k) of `rows` (n, k), filled up with zeros where n < k."""
    k = rows.shape[1]
    while rows.size > BLOCK and len(rows) >= 2 * _leaf(k):
        rows = _leaves(rows)
    # Not scipy's qr, whose R has all n rows: kept in a triangle it would hold a part of the table.
    R = np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)
    return R if len(R) == k else np.vstack([R, np.zeros((k - len(R), k))])
