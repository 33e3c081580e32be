"""Cholesky factors of many information matrices at once, with the singular ones marked."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf

from elastocal.design.criteria.base import Array
from elastocal.errors import InsufficientDataError

# tr(H⁻¹) of M scaled to unit diagonal, above which M is singular to rounding: a matrix of rank
# p − 1 formed in double precision shows 1/(p ε) ≈ 10¹⁴ or more.
SINGULAR = 1e13


@dataclass(frozen=True)
class Factor:
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


def factorise(M: Array) -> Factor:
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
    return Factor(np.asarray(L), inverse, condition)


def _one_by_one(M: Array) -> tuple[Array, NDArray[np.bool_]]:
    """numpy refuses a whole stack for one bad matrix; LAPACK itself says which one it is."""
    p = M.shape[-1]
    L = np.tile(np.eye(p), (*M.shape[:-2], 1, 1))
    definite = np.zeros(M.shape[:-2], dtype=bool)
    for index in np.ndindex(*M.shape[:-2]):
        lower, info = dpotrf(M[index], lower=1, clean=1)
        if info == 0:
            L[index], definite[index] = lower, True
    return L, definite
