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

import numpy as np
from scipy import linalg

from elastocal.engine.climb import climb
from elastocal.engine.sizes import Products, Standardised
from elastocal.identification.weighted_problem import RFactor
from elastocal.units import Array, IntArray

# Scales λ beyond these are no longer told apart: nothing is left of the group, or of its prior.
LEAST, MOST = 1e-3, 1e6
SMALL = 0.05
DEPENDENT = 1e-11  # singular value of unit columns, of the largest
# Of log λ above 0: a function may be smaller than stated at no price, but ten times the size costs
# what a likelihood ratio of 1e8 gains.  Data that hardly show a function know no upper limit.
PRICE = 0.75
# Noise as shares of the variance that ordinary parameters leave, from which the search starts.
SHARES = (1.0, 0.1, 0.01, 0.001)
STEPS, ENOUGH, LEVEL = 30, 0.02, 0.3  # of −2ℓ: what the last step may promise; its curvature


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
        at the `start` stays so."""
        alive = np.ones(self.n_groups, dtype=bool) if start is None else start.scale > 0
        own = np.flatnonzero(alive[self.group])
        group = np.unique(self.group[own], return_inverse=True)[1].ravel()
        products = Products(self.gram[np.ix_(own, own)], self.right[own], self.total, self.spare)
        grown = 2.0 * (group[:, None] == np.arange(int(alive.sum())))

        def objective(theta: Array) -> tuple[float, Array, Array]:
            """In log σ and the ½ log λ of the groups."""
            variances = np.exp(2 * theta[1:])[group] * self.std[own] ** 2
            value, slope, information = products.objective(variances, grown, float(theta[0]))
            over = np.maximum(2 * theta[1:], 0.0) / PRICE
            slope[1:] += 4 * over / PRICE
            # What is next to nothing has next to no curvature: no step may be taken for it.
            information[np.diag_indices_from(information)] += LEVEL
            at = 1 + np.flatnonzero(over > 0)
            information[at, at] += 8 / PRICE**2
            return value + float(over @ over), slope, information

        whole, n = max(self.total / self.spare, 1e-300), grown.shape[1]
        size = 0.5 * np.log([LEAST, MOST])
        noise = 0.5 * np.log(whole) + np.array([-20.0, 1.0])
        lower, upper = (np.concatenate([[noise[k]], np.full(n, size[k])]) for k in (0, 1))

        def found(theta: Array) -> Array:
            return climb(objective, np.clip(theta, lower, upper), lower, upper, ENOUGH, STEPS)[0]

        if start is None:
            levels = 0.5 * np.log(whole * np.array(SHARES))
            begun = [np.concatenate([[level], np.zeros(n)]) for level in levels]
            theta = found(min(begun, key=lambda one: objective(one)[0]))
            small = theta[1:] < 0.5 * np.log(SMALL)
            if small.any():
                again = found(np.where(np.concatenate([[False], small]), 0.0, theta))
                theta = min(theta, again, key=lambda one: objective(one)[0])
        else:
            # From nothing the likelihood shows no way back: what is small begins anew.
            known = np.where(start.scale[alive] < SMALL, 1.0, start.scale[alive])
            theta = found(0.5 * np.log(np.concatenate([[start.variance], known])))
        scale, gain = np.zeros(len(alive)), np.zeros(len(alive))
        scale[alive] = np.exp(2 * theta[1:])
        at = products.at(scale[self.group[own]] * self.std[own] ** 2, float(theta[0]))
        gain[alive] = at.left_out([np.flatnonzero(group == g) for g in range(n)])
        return Scales(scale, float(np.exp(2 * theta[0])), gain)

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
