"""The information of the parameters of interest, the nuisance parameters marginalised."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from elastocal.design.criteria.base import Array, IntArray
from elastocal.design.criteria.factor import Factor, factorise
from elastocal.errors import require


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

    def factor(self, M: Array) -> Factor:
        """L L' = M in that order; its last k rows and columns give those of M_I."""
        order = self.ordered(M.shape[-1])
        return factorise(M[..., order[:, None], order])

    def information(self, factor: Factor) -> Array:
        """M_I = (V_II)⁻¹ = M_II − M_IN M_NN⁻¹ M_NI (..., k, k): the Schur complement L_II L_IIᵀ."""
        L = factor.L[..., -self.count :, -self.count :]
        return np.asarray(L @ L.swapaxes(-1, -2))

    def projection(self, factor: Factor) -> Array:
        """E (..., k, p), columns in M's own order, with M_I = E M Eᵀ and ∂M_I = E ∂M Eᵀ.

        E = L_II (last k rows of L⁻¹) = [−M_IN M_NN⁻¹, 1].
        """
        k = self.count
        E = np.empty((*factor.L.shape[:-2], k, factor.L.shape[-1]))
        E[..., self.ordered(E.shape[-1])] = factor.L[..., -k:, -k:] @ factor.inverse[..., -k:, :]
        return E
