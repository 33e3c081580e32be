"""Parameters with a prior beside parameters without one: sizes by restricted likelihood, posterior.

    e = B_f α + B_s b + ε,   ε ~ N(0, σ²),   b ~ N(0, Λ),   Λ = diag(λ_g s²)

with whitened rows; α are the ordinary parameters, b the shrunk ones as deviations from nominal, s
their standard deviations as declared and λ_g one scale for each group.  With [B_f B_s e] = QR the
rows are needed no more: R_ss, below what the ordinary parameters take, holds all that decides σ²
and λ (Patterson and Thompson 1971; Harville 1977).  Of the shrunk columns the products R_ssᵀR_ss
suffice: their prior keeps every matrix well conditioned.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import linalg, optimize

from elastocal.identification.weighted_problem import RFactor
from elastocal.units import Array, BoolArray, IntArray

# Scales λ beyond these are no longer told apart: nothing is left of the group, or of its prior.
LEAST, MOST = 1e-6, 1e6
SMALL = 0.05
DEPENDENT = 1e-11  # singular value of unit columns, of the largest
# Of log λ above 0: a function may be smaller than stated at no price, but ten times the size costs
# what a likelihood ratio of 1e8 gains.  Data that hardly show a function know no upper limit.
PRICE = 0.75
# Noise as shares of the variance that ordinary parameters leave, from which the search starts.
SHARES = (1.0, 0.1, 0.01, 0.001)
STEPS = 60
TOLERANCE = 2e-4  # of the log-likelihood per row, relative


@dataclass(frozen=True)
class Scales:
    """λ (groups,), σ² of a whitened row, and by how much (groups,) the restricted log-likelihood
    falls where a group is left out."""

    scale: Array
    variance: float
    gain: Array


@dataclass(frozen=True)
class Sums:
    """Sums over whitened rows: the R factor of [B_f e], `cross` B_fᵀB_s, `gram` B_sᵀB_s and
    `right` B_sᵀe."""

    own: RFactor
    cross: Array
    gram: Array
    right: Array

    @classmethod
    def of(cls, B: Array, e: Array, ordinary: int) -> Sums:
        """Of the rows [B_f B_s] and e."""
        Bf, Bs = B[:, :ordinary], np.ascontiguousarray(B[:, ordinary:])
        return cls(RFactor.of(Bf, e), Bf.T @ Bs, Bs.T @ Bs, Bs.T @ e)

    def merged(self, other: Sums) -> Sums:
        """Of the rows of both."""
        return Sums(
            self.own.merged(other.own), self.cross + other.cross, self.gram + other.gram,
            self.right + other.right,
        )  # fmt: skip


class Standardised(NamedTuple):
    """Coefficients with a prior, in units of their prior deviations √v: L of A = LLᵀ = 1 + √v M √v
    and A b = √v z, of the sums M = CᵀC and z = Cᵀe over whitened columns and rows.

    Their likelihood, integrated out, is that of e without them but for −2ℓ = log|A| − `explained`.
    """

    L: Array
    b: Array
    explained: float

    @classmethod
    def of(cls, M: Array, z: Array, root: Array) -> Standardised:
        """Of prior deviations `root` (k,)."""
        A = M * root
        A *= root[:, None]
        A[np.diag_indices_from(A)] += 1.0
        # Symmetric, and LAPACK's own way round: nothing is copied.
        L = linalg.cholesky(A.T, lower=True, overwrite_a=True, check_finite=False)
        right = root * z
        b = linalg.cho_solve((L, True), right, check_finite=False)
        return cls(L, b, float(b @ right))

    @property
    def log_det(self) -> float:
        return 2 * float(np.log(np.diag(self.L)).sum())

    @property
    def covariance(self) -> Array:
        """A⁻¹ (k, k), its lower triangle."""
        return np.asarray(linalg.lapack.dpotri(self.L, lower=1)[0])


class _Terms(NamedTuple):
    """−2ℓ, its slope in log T (groups,), q, and |b|²/T (groups,) in it."""

    value: float
    slope: Array
    q: float
    squares: Array


@dataclass(frozen=True)
class LinearRows:
    """Rows linearised: [B_f B_s e] with all free ordinary columns and e at nominal functions.

    B_f = Q R, `across` QᵀB_s and `z` Qᵀe; `gram` (shrunk, shrunk), `right` (shrunk,) and `total`
    are the products of B_s and e with Q projected out.  `std` (shrunk,) are the prior's standard
    deviations as declared, `group` (shrunk,) the numbers of the groups.
    """

    R: Array
    across: Array
    z: Array
    gram: Array
    right: Array
    total: float
    rows: int
    std: Array
    group: IntArray

    @classmethod
    def summed(cls, sums: Sums, away: Array, std: Array, group: IntArray) -> LinearRows:
        """From sums over the rows, the functions `away` (shrunk,) from nominal."""
        R = sums.own.R
        # Directions in which the ordinary columns hold nothing but rounding take nothing.
        norms = np.linalg.norm(R, axis=0)
        norms[norms == 0] = 1.0
        U, size, Vt = linalg.svd(R / norms)
        known = size > DEPENDENT * size.max(initial=0.0)
        turned = Vt[known] @ (sums.cross / norms[:, None]) / size[known, None]
        across = U[:, known] @ turned
        gram = sums.gram - turned.T @ turned
        z = sums.own.projected
        right = sums.right - across.T @ z
        total = sums.own.rest**2 + 2 * float(right @ away) + float(away @ (gram @ away))
        return cls(
            R, across, z + across @ away, gram, right + gram @ away, max(total, 0.0),
            sums.own.rows, std, group,
        )  # fmt: skip

    def only(self, kept: IntArray) -> ShrunkProblem:
        """With the ordinary columns `kept` alone: what the others took is the functions' again."""
        k = len(kept)
        Q, R = linalg.qr(self.R[:, kept])
        across, z = Q.T @ self.across, Q.T @ self.z
        free, left = across[k:], z[k:]
        return ShrunkProblem(
            R[:k], across[:k], z[:k], self.gram + free.T @ free, self.right + free.T @ left,
            self.total + float(left @ left), self.rows, self.std, self.group,
        )  # fmt: skip


@dataclass(frozen=True)
class ShrunkProblem(LinearRows):
    """`LinearRows` of the ordinary columns that are fitted."""

    @property
    def ordinary(self) -> int:
        return len(self.R)

    @property
    def n_groups(self) -> int:
        return int(self.group.max(initial=-1)) + 1

    @property
    def spare(self) -> int:
        """Rows less ordinary parameters."""
        return max(self.rows - self.ordinary, 1)

    def scales(self, start: Scales | None = None) -> Scales:
        """λ and σ² of the largest restricted likelihood, where λ above 1 has its PRICE; what is 0
        at the `start` stays so.

        −2ℓ = (rows − p_f) log q + log|A| + const with A = 1 + T½MT½, T = λ/σ², M = sB_sᵀB_s s and
        q the least |e|² + |b|²/T, of which σ² is the mean.
        """
        G = self.n_groups
        alive: BoolArray = np.ones(G, dtype=bool) if start is None else start.scale > 0
        whole = max(self.total / self.spare, 1e-300)
        limits = np.log(LEAST / whole), np.log(MOST / whole) - np.log(SHARES[-1])

        def criterion(free: Array) -> tuple[float, Array]:
            at = self._terms(np.exp(self._spread(free, alive)), slopes=True)
            # λ = T q/(rows − p_f), and q falls by |b|² as T grows: the price moves with both.
            over = np.maximum(free + np.log(at.q / self.spare), 0.0) / PRICE**2
            slope = at.slope[alive] + 2 * (over - over.sum() * at.squares[alive] / at.q)
            return at.value + PRICE**2 * float(over @ over), slope

        def least(free: Array) -> tuple[float, Array]:
            found = optimize.minimize(
                criterion, free, jac=True, method="L-BFGS-B", bounds=[limits] * len(free),
                options={"maxiter": STEPS, "ftol": TOLERANCE / self.rows, "maxls": 30},
            )  # fmt: skip
            return float(found.fun), np.asarray(found.x)

        ratio = np.zeros(G)
        if alive.any():
            none = np.zeros(int(alive.sum()))
            if start is None:
                guesses = [np.clip(none - np.log(whole * share), *limits) for share in SHARES]
                begin = min(guesses, key=lambda guess: criterion(guess)[0])
            else:
                # From nothing the likelihood shows no way back: what is small begins anew.
                known = np.where(start.scale[alive] < SMALL, 1.0, start.scale[alive])
                begin = np.clip(np.log(known / start.variance), *limits)
            value, free = least(begin)
            variance = self._terms(np.exp(self._spread(free, alive))).q / self.spare
            small = free < np.log(SMALL / variance)
            if start is None and small.any():
                again, other = least(np.where(small, -np.log(variance), free))
                if again < value:
                    free = other
            ratio[alive] = np.exp(free)
        at = self._terms(ratio)
        variance = at.q / self.spare
        gain = np.array([self._left_out(ratio, g) - at.value for g in range(G)]) / 2
        return Scales(ratio * variance, variance, gain)

    @staticmethod
    def _spread(free: Array, alive: BoolArray) -> Array:
        every = np.full(len(alive), -np.inf)
        every[alive] = free
        return every

    def _left_out(self, ratio: Array, g: int) -> float:
        return self._terms(np.where(np.arange(len(ratio)) == g, 0.0, ratio)).value

    def _terms(self, ratio: Array, slopes: bool = False) -> _Terms:
        """−2ℓ at T (groups,), with its slope in log T where that is asked for."""
        root = np.sqrt(ratio)[self.group] * self.std
        own, zero = np.flatnonzero(root > 0), np.zeros(self.n_groups)
        at = Standardised.of(self.gram[np.ix_(own, own)], self.right[own], root[own])
        q = max(self.total - at.explained, 1e-300)
        value = self.spare * float(np.log(q)) + at.log_det
        if not slopes or not len(own):
            return _Terms(value, zero, q, zero)
        squares, known = (
            np.asarray(np.bincount(self.group[own], each, self.n_groups), dtype=np.float64)
            for each in (at.b**2, 1 - np.diag(at.covariance))
        )
        return _Terms(value, known - self.spare / q * squares, q, squares)

    def posterior(self, scales: Scales) -> ShrunkPosterior:
        """The estimate and its covariance under these scales."""
        root = np.sqrt(scales.scale / scales.variance)[self.group] * self.std
        own = np.flatnonzero(root > 0)
        root, across = root[own], self.across[:, own]
        at = Standardised.of(self.gram[np.ix_(own, own)], self.right[own], root)
        b = root * at.b
        # UᵀU = B_sᵀB_s + σ²/Λ, ordinary columns projected out.
        U = at.L.T / root
        R = np.block([[self.R, across], [np.zeros((len(own), self.ordinary)), U]])
        return ShrunkPosterior(
            R, self.z, b, self.ordinary, own, 1 / root, scales.variance, self.rows
        )


@dataclass(frozen=True)
class ShrunkPosterior:
    """The estimate under a prior: ordinary columns first, then the shrunk ones that take part.

    `R` (columns, columns) is upper triangular, RᵀR the normal matrix of readings and prior in
    units of σ; z (ordinary,) its right side and b (own,) the shrunk parameters' estimate, from
    nominal.  `own` index those that take part, `prior` (own,) is σ over their standard deviations.
    """

    R: Array
    z: Array
    b: Array
    ordinary: int
    own: IntArray
    prior: Array
    variance: float
    rows: int

    @cached_property
    def step(self) -> Array:
        """α and b (columns,).  Raises LinAlgError where ordinary columns depend on each other."""
        k = self.ordinary
        alpha = linalg.solve_triangular(self.R[:k, :k], self.z - self.R[:k, k:] @ self.b)
        return np.concatenate([alpha, self.b])

    @cached_property
    def marginal(self) -> RFactor:
        """R of the ordinary columns with the shrunk ones taken for noise,
        RᵀR/σ² = B_fᵀ(σ² + B_sΛB_sᵀ)⁻¹B_f; without a residual."""
        k = self.ordinary
        Y = linalg.solve_triangular(self.R[k:, k:], self.R[:k, k:].T, trans="T")
        L = linalg.cholesky(np.eye(k) + Y.T @ Y, lower=True)
        own = linalg.solve_triangular(L, self.R[:k, :k], lower=True)
        augmented = np.zeros((k + 1, k + 1))
        augmented[:k, :k] = linalg.qr(own, mode="r")[0]
        return RFactor(augmented, self.rows)

    @cached_property
    def cofactor(self) -> Array:
        """Covariance over σ²."""
        half, _ = linalg.lapack.dtrtri(self.R)
        return np.asarray(half @ half.T)

    @cached_property
    def prior_share(self) -> Array:
        """Share of each estimate's information that is the prior's, 0 to 1."""
        passed = self.cofactor[self.ordinary :] * self.prior[:, None]
        return np.asarray((passed**2).sum(axis=0) / np.diag(self.cofactor))

    @cached_property
    def effective_of(self) -> Array:
        """How many parameters' worth of each shrunk one the readings determine, 0 to 1."""
        return np.asarray(1 - self.prior**2 * np.diag(self.cofactor)[self.ordinary :])

    @property
    def effective(self) -> float:
        """The same of all parameters together: the trace of the hat matrix."""
        return self.ordinary + float(self.effective_of.sum())
