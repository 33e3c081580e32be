"""Parameters with a prior beside parameters without one: sizes by restricted likelihood, posterior.

    e = B_f α + B_s b + ε,   ε ~ N(0, σ²),   b ~ N(0, Λ),   Λ = diag(λ_g s²)

with whitened rows; α are the ordinary parameters, b the shrunk ones as deviations from nominal, s
their standard deviations as declared and λ_g one scale for each group.  With [B_f B_s e] = QR the
rows are needed no more: R_ss, below what the ordinary parameters take, holds all that decides σ²
and λ (Patterson and Thompson 1971; Harville 1977).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import linalg, optimize

from elastocal.identification.weighted_problem import RFactor
from elastocal.units import Array, IntArray

# Scales λ beyond these are no longer told apart: nothing is left of the group, or of its prior.
LEAST, MOST = 1e-6, 1e6
SMALL = 0.05
# Of log λ above 0: a function may be smaller than stated at no price, but ten times the size costs
# what a likelihood ratio of a hundred gains.  Data that hardly show a function know no upper limit.
PRICE = 1.5
# Noise as shares of the variance that ordinary parameters leave, from which the search starts.
SHARES = (1.0, 0.1, 0.01, 0.001)
STEPS = 60
TOLERANCE = 1e-8  # relative, of the likelihood


@dataclass(frozen=True)
class Scales:
    """λ (groups,), σ² of a whitened row, and by how much (groups,) the restricted log-likelihood
    falls where a group is left out."""

    scale: Array
    variance: float
    gain: Array


class _Terms(NamedTuple):
    """−2ℓ, its slope in log T (groups,), q, and |b|²/T (groups,) in it."""

    value: float
    slope: Array
    q: float
    squares: Array


@dataclass(frozen=True)
class ShrunkProblem:
    """The R factor of [B_f B_s e], the first `ordinary` columns those without a prior.

    e is the residual where the shrunk parameters are nominal.  `std` (shrunk,) are their standard
    deviations s, `group` (shrunk,) the numbers of their groups.
    """

    r_factor: RFactor
    ordinary: int
    std: Array
    group: IntArray

    @property
    def n_groups(self) -> int:
        return int(self.group.max(initial=-1)) + 1

    @property
    def spare(self) -> int:
        """Rows less ordinary parameters."""
        return max(self.r_factor.rows - self.ordinary, 1)

    @cached_property
    def _reduced(self) -> tuple[Array, Array, float]:
        """s BᵀB s and s Bᵀe of the shrunk columns, the ordinary ones projected out, and |e|²."""
        k = self.ordinary
        R = self.r_factor.R[k:, k:] * self.std
        z = self.r_factor.projected[k:]
        return R.T @ R, R.T @ z, float(z @ z) + self.r_factor.rest**2

    def scales(self, start: Scales | None = None) -> Scales:
        """λ and σ² of the largest restricted likelihood, where λ above 1 has its PRICE; what is 0
        at the `start` stays so.

        −2ℓ = (rows − p_f) log q + log|A| + const with A = 1 + T½MT½, T = λ/σ², M = sB_sᵀB_s s and
        q the least |e|² + |b|²/T, of which σ² is the mean.
        """
        G = self.n_groups
        alive = np.ones(G, dtype=bool) if start is None else start.scale > 0
        whole = max(self._reduced[2] / self.spare, 1e-300)
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
                options={"maxiter": STEPS, "ftol": TOLERANCE, "maxls": 30},
            )  # fmt: skip
            return float(found.fun), np.asarray(found.x)

        ratio = np.zeros(G)
        if alive.any():
            none = np.zeros(int(alive.sum()))
            guesses = [none - np.log(whole * share) for share in SHARES]
            if start is not None:
                known = np.maximum(start.scale[alive], LEAST)
                guesses.append(np.log(known / start.variance))
            guesses = [np.clip(guess, *limits) for guess in guesses]
            value, free = least(min(guesses, key=lambda guess: criterion(guess)[0]))
            # From nothing the likelihood shows no way back: those there start once more.
            variance = self._terms(np.exp(self._spread(free, alive))).q / self.spare
            small = free < np.log(SMALL / variance)
            if small.any():
                again, other = least(np.where(small, -np.log(variance), free))
                if again < value:
                    free = other
            ratio[alive] = np.exp(free)
        at = self._terms(ratio)
        variance = at.q / self.spare
        gain = np.array([self._left_out(ratio, g) - at.value for g in range(G)]) / 2
        return Scales(ratio * variance, variance, gain)

    @staticmethod
    def _spread(free: Array, alive: Array) -> Array:
        every = np.full(len(alive), -np.inf)
        every[alive] = free
        return every

    def _left_out(self, ratio: Array, g: int) -> float:
        return self._terms(np.where(np.arange(len(ratio)) == g, 0.0, ratio)).value

    def _terms(self, ratio: Array, slopes: bool = False) -> _Terms:
        """−2ℓ at T (groups,), with its slope in log T where that is asked for."""
        M, y, total = self._reduced
        root = np.sqrt(ratio)[self.group]
        own = np.flatnonzero(root > 0)
        root, zero = root[own], np.zeros(self.n_groups)
        if not len(own):
            q = max(total, 1e-300)
            return _Terms(self.spare * float(np.log(q)), zero, q, zero)
        A = M[np.ix_(own, own)] if len(own) < len(M) else M.copy()
        A *= root[:, None]
        A *= root
        A[np.diag_indices_from(A)] += 1.0
        L = linalg.cholesky(A, lower=True, overwrite_a=True, check_finite=False)
        right = root * y[own]
        b = linalg.cho_solve((L, True), right, check_finite=False)
        q = max(total - float(b @ right), 1e-300)
        value = self.spare * float(np.log(q)) + 2 * float(np.log(np.diag(L)).sum())
        if not slopes:
            return _Terms(value, zero, q, zero)
        inverse, _ = linalg.lapack.dpotri(L, lower=1, overwrite_c=1)
        squares = np.bincount(self.group[own], b**2, self.n_groups)
        known = np.bincount(self.group[own], 1 - np.diag(inverse), self.n_groups)
        return _Terms(value, known - self.spare / q * squares, q, squares)

    def posterior(self, scales: Scales) -> ShrunkPosterior:
        """The estimate and its covariance under these scales."""
        k = self.ordinary
        std = np.sqrt(scales.scale / scales.variance)[self.group] * self.std
        own = np.flatnonzero(std > 0)
        chosen = np.concatenate([np.arange(k), k + own])
        # Prior rows weigh as readings do: their deviations in units of σ.
        rows = np.zeros((len(own), len(chosen) + 1))
        rows[np.arange(len(own)), k + np.arange(len(own))] = 1 / std[own]
        short = RFactor(
            np.vstack([self.r_factor.augmented[:, [*chosen, self.r_factor.columns]], rows]),
            self.r_factor.rows,
        )
        whole = short.of_columns(np.arange(len(chosen)))
        return ShrunkPosterior(whole, k, own, 1 / std[own], scales.variance)

    def marginal(self, scales: Scales) -> RFactor:
        """The R factor of the ordinary columns with the shrunk ones taken for noise:
        RᵀR/σ² = B_fᵀ(σ² + B_sΛB_sᵀ)⁻¹B_f."""
        after = self.posterior(scales)
        k, p = after.ordinary, after.r_factor.columns
        turned = after.r_factor.of_columns(np.r_[k:p, 0:k]).augmented
        return RFactor(turned[p - k :, p - k :], self.r_factor.rows)


@dataclass(frozen=True)
class ShrunkPosterior:
    """The R factor of readings and prior together, ordinary columns first, in units of σ.

    `own` index the shrunk parameters that take part, `prior` (own,) are the rows that the prior
    added: σ over their standard deviations.
    """

    r_factor: RFactor
    ordinary: int
    own: IntArray
    prior: Array
    variance: float

    @cached_property
    def step(self) -> Array:
        """α, then b of those that take part."""
        return np.asarray(linalg.solve_triangular(self.r_factor.R, self.r_factor.projected))

    @cached_property
    def _half(self) -> Array:
        """R⁻¹, upper triangular."""
        return np.asarray(linalg.lapack.dtrtri(self.r_factor.R)[0])

    @cached_property
    def cofactor(self) -> Array:
        """Covariance over σ²."""
        return self._half @ self._half.T

    @cached_property
    def prior_share(self) -> Array:
        """Share of each estimate's information that is the prior's, 0 to 1."""
        passed = self.cofactor[self.ordinary :] * self.prior[:, None]
        return (passed**2).sum(axis=0) / np.diag(self.cofactor)

    @cached_property
    def effective_of(self) -> Array:
        """How many parameters' worth of each shrunk one the readings determine, 0 to 1."""
        return 1 - self.prior**2 * np.diag(self.cofactor)[self.ordinary :]

    @property
    def effective(self) -> float:
        """The same of all parameters together: the trace of the hat matrix."""
        return self.ordinary + float(self.effective_of.sum())
