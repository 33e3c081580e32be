"""Linear algebra on many information matrices at once, and what one more pose changes in them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InsufficientDataError, require
from elastocal.units import Array, IntArray

# Matrices (..., S, p, p) that a batched evaluation holds at once, as numbers.
BATCH_NUMBERS = 2_000_000
# Numbers of a chunk of candidates, small enough for the cache of one core.
CHUNK_NUMBERS = 100_000
# tr(H⁻¹) of M scaled to unit diagonal, above which M is singular to rounding: a matrix of rank
# p − 1 formed in double precision shows 1/(p ε) ≈ 10¹⁴ or more.
SINGULAR = 1e13
# tr(H⁻¹) of M (see `factorise`) up to which the determinants of an update keep it.
WELL_CONDITIONED = 1e7
# Relative accuracy that an update of Φ must keep; otherwise Φ is formed anew.
ACCURACY = 1e-10


def candidate_sums(M: Array, blocks: Array) -> Iterator[tuple[slice, Array]]:
    """M_s + B_siᵀ B_si (n, S, p, p) for slices of candidates that fit into memory.

    M (S, p, p), blocks (S, N, r, p).
    """
    scenarios, n, _, p = blocks.shape
    size = max(BATCH_NUMBERS // (scenarios * p * p), 1)
    for start in range(0, n, size):
        part = slice(start, start + size)
        B = blocks[:, part]
        yield part, M + (B.swapaxes(-1, -2) @ B).swapaxes(0, 1)


@dataclass(frozen=True)
class InformationFactor:
    """M = L Lᵀ with L (..., p, p) lower triangular; `regular` (...) where M is positive definite.

    Elsewhere L is the identity, so that no NaN spreads and no solver raises.
    """

    L: Array
    inverse: Array
    condition: Array

    @cached_property
    def regular(self) -> NDArray[np.bool_]:
        return self.condition < SINGULAR

    def require_regular(self) -> None:
        """Raise InsufficientDataError where M (S, p, p) of some scenario is singular."""
        singular = np.flatnonzero(~self.regular)
        if len(singular):
            raise InsufficientDataError(
                f"the information matrix of scenario {singular[0] + 1} of {len(self.regular)} is "
                "singular: the weighted poses leave a combination of parameters unseen; weight "
                "more candidates, ask for more poses or add prior information"
            )


def factorise(M: Array) -> InformationFactor:
    """The factor of symmetric M (..., p, p).

    `condition` is tr(H⁻¹), the sum of the variance inflation factors, H being M scaled to unit
    diagonal; it does not depend on the units of the parameters; inf where M is not positive
    definite.
    """
    definite = np.ones(M.shape[:-2], dtype=bool)
    try:
        L = np.linalg.cholesky(M)
    except np.linalg.LinAlgError:
        L, definite = _one_by_one(M)
    inverse = np.asarray(np.linalg.inv(L))
    inflation = np.einsum("...ij,...jj->...", inverse**2, M)
    condition = np.where(definite, inflation, np.inf)
    return InformationFactor(np.asarray(L), inverse, condition)


def _one_by_one(M: Array) -> tuple[Array, NDArray[np.bool_]]:
    """numpy refuses a whole stack for one bad matrix; LAPACK itself says which one it is."""
    from scipy.linalg.lapack import dpotrf

    p = M.shape[-1]
    L = np.tile(np.eye(p), (*M.shape[:-2], 1, 1))
    definite = np.zeros(M.shape[:-2], dtype=bool)
    for index in np.ndindex(*M.shape[:-2]):
        lower, info = dpotrf(M[index], lower=1, clean=1)
        if info == 0:
            L[index], definite[index] = lower, True
    return L, definite


def trustworthy(factor: InformationFactor) -> bool:
    """Whether M is regular enough for its inverse to be updated rather than formed anew."""
    return bool((factor.condition < WELL_CONDITIONED).all())


def doubtful(before: Array, after: Array, condition: Array) -> Array:
    """Whether so much of Φ is taken away that the difference has lost its digits.

    `after` = before − removed, where both are known to about ε · `condition` relative to
    `before` (measured: a third of it at most).
    """
    return np.asarray(after * ACCURACY < before * condition * np.finfo(float).eps / 3)


def whitened_rows(factor: InformationFactor, blocks: Array) -> Iterator[tuple[slice, Array, Array]]:
    """W = B L⁻ᵀ (S, n, r, p) for slices of candidates, and I + W Wᵀ (S, n, r, r).

    With M = L Lᵀ: (M + BᵀB)⁻¹ = L⁻ᵀ [I − Wᵀ (I + W Wᵀ)⁻¹ W] L⁻¹ (Woodbury) and
    det(M + BᵀB) = det(M) det(I + W Wᵀ) (matrix determinant lemma).
    """
    scenarios, n, r, p = blocks.shape
    size = max(CHUNK_NUMBERS // (scenarios * r * p), 1)
    upper = factor.inverse.swapaxes(-1, -2)
    for start in range(0, n, size):
        part = slice(start, start + size)
        B = blocks[:, part]
        W = (B.reshape(scenarios, -1, p) @ upper).reshape(B.shape)
        yield part, W, np.eye(r) + W @ W.swapaxes(-1, -2)


@dataclass(frozen=True)
class Interest:
    """The parameters `interest` (k,) of p; all others are nuisance, estimated but not counted.

    Raises InputError for an empty, repeated or negative choice.
    """

    interest: IntArray

    def __post_init__(self) -> None:
        chosen = np.asarray(self.interest)
        require(
            chosen.ndim == 1 and len(chosen) > 0,
            "no parameter of interest is left: every parameter counts as nuisance; name "
            "parameters or effects in [design] interest",
        )
        require(
            len(np.unique(chosen)) == len(chosen) and int(chosen.min()) >= 0,
            f"parameters of interest are repeated or negative: {chosen.tolist()}",
        )

    @cached_property
    def count(self) -> int:
        return len(self.interest)

    def ordered(self, parameters: int) -> IntArray:
        """Indices (p,) of nuisance parameters first, then `interest`."""
        require(
            int(np.max(self.interest)) < parameters,
            f"parameter of interest {int(np.max(self.interest))} does not exist: there are "
            f"{parameters}",
        )
        return np.concatenate([np.setdiff1d(np.arange(parameters), self.interest), self.interest])

    def factor(self, M: Array) -> InformationFactor:
        """L L' = M in that order; its last k rows and columns give those of M_I."""
        order = self.ordered(M.shape[-1])
        return factorise(M[..., order[:, None], order])

    def information(self, factor: InformationFactor) -> Array:
        """M_I = (V_II)⁻¹ = M_II − M_IN M_NN⁻¹ M_NI (..., k, k): the Schur complement L_II L_IIᵀ."""
        L = factor.L[..., -self.count :, -self.count :]
        return np.asarray(L @ L.swapaxes(-1, -2))

    def projection(self, factor: InformationFactor) -> Array:
        """E (..., k, p), columns in M's own order, with M_I = E M Eᵀ and ∂M_I = E ∂M Eᵀ.

        E = L_II (last k rows of L⁻¹) = [−M_IN M_NN⁻¹, 1].
        """
        k = self.count
        E = np.empty((*factor.L.shape[:-2], k, factor.L.shape[-1]))
        E[..., self.ordered(E.shape[-1])] = factor.L[..., -k:, -k:] @ factor.inverse[..., -k:, :]
        return E


@dataclass(frozen=True)
class Variances:
    """φ_st = tr(F_st M_s⁻¹ F_stᵀ), the summed variance of F_st x̂ under scenario s.

    F (S, T, q, p): T groups of q linear functions of the p parameters.
    """

    F: Array

    def of(self, M: Array) -> Array:
        """φ (..., S, T) at M (..., S, p, p); inf where M_s is singular."""
        factor = factorise(M)
        return np.where(factor.regular[..., None], self._grouped(self._roots(factor)), np.inf)

    def with_gains(self, M: Array) -> tuple[Array, Array]:
        """φ (S, T), and V_s F_sᵀ (S, p, T, q) whose products are the −∂φ/∂M; M (S, p, p).

        Raises InsufficientDataError where M_s is singular.
        """
        factor = factorise(M)
        factor.require_regular()
        Z = self._roots(factor)
        gains = factor.inverse.swapaxes(-1, -2) @ Z
        return self._grouped(Z), gains.reshape(self._columns.shape[:2] + self.F.shape[1:3])

    def after_adding(self, M: Array, blocks: Array) -> Array:
        """φ (N, S, T) at M_s + B_siᵀ B_si; M (S, p, p), blocks (S, N, r, p)."""
        factor = factorise(M)
        n = blocks.shape[1]
        if not trustworthy(factor):
            return self._anew(M, blocks)
        Z = self._roots(factor)
        before = self._grouped(Z)
        values = np.empty((n, *before.shape))
        for part, W, K in whitened_rows(factor, blocks):
            values[part] = before - self._removed(W, K, Z).swapaxes(0, 1)
        condition = factor.condition[:, None]
        unsure = np.flatnonzero(doubtful(before, values, condition).any(axis=(1, 2)))
        values[unsure] = self._anew(M, blocks[:, unsure])
        return values

    @cached_property
    def _columns(self) -> Array:
        """F_sᵀ (S, p, T q)."""
        S, T, q, p = self.F.shape
        return np.ascontiguousarray(self.F.reshape(S, T * q, p).swapaxes(-1, -2))

    def _roots(self, factor: InformationFactor) -> Array:
        """Z = L⁻¹ Fᵀ (..., S, p, T q), whose squares sum to φ."""
        return np.asarray(factor.inverse @ self._columns)

    def _grouped(self, Z: Array) -> Array:
        squares = (Z**2).sum(axis=-2)
        return np.asarray(squares.reshape(*squares.shape[:-1], *self.F.shape[1:3]).sum(axis=-1))

    def _removed(self, W: Array, K: Array, Z: Array) -> Array:
        """tr(Zᵀ Wᵀ K⁻¹ W Z) (S, n, T) by group, the variance that a pose takes away."""
        S, n, r, p = W.shape
        T, q = self.F.shape[1:3]
        X = (W.reshape(S, n * r, p) @ Z).reshape(S, n, r, T * q)
        if T == 1 and q > r:
            solved = np.linalg.solve(K, X @ X.swapaxes(-1, -2))
            return np.asarray(np.trace(solved, axis1=-2, axis2=-1)[..., None])
        products = (X * np.linalg.solve(K, X)).sum(axis=-2)
        return np.asarray(products.reshape(S, n, T, q).sum(axis=-1))

    def _anew(self, M: Array, blocks: Array) -> Array:
        values = np.empty((blocks.shape[1], *self.F.shape[:2]))
        for part, sums in candidate_sums(M, blocks):
            values[part] = self.of(sums)
        return values
