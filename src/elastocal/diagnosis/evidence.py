"""Marginal likelihood of a group of columns in closed form.

With columns C scaled to their typical sizes, γ ~ N(0, s² I) and everything else integrated out,

    log ev(s) = −½ log|I + s²A| + ½ s² bᵀ(I + s²A)⁻¹ b,   A = CᵀPC,   b = CᵀPr,

over the model without the group; s is mixed over SCALES with equal weights (a size prior with
heavier tails than one Gaussian).  In the eigenvectors U of A, with β = Uᵀb:

    log ev(s) = ½ Σ_k [s²β_k² / (1 + s²λ_k) − log(1 + s²λ_k)].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SCALES = np.array([0.3, 1.0, 3.0])
# A size that nobody has stated is known to an order of magnitude at best.
UNSIZED_SCALES = np.array([0.1, 0.3, 1.0, 3.0, 10.0])


@dataclass(frozen=True)
class Spectrum:
    """V groups of K columns: eigenvalues `lam` (V, K) of A, `beta` (V, K) = Uᵀb, and `parts`
    (C, V, K): what each configuration's residual brings to β when its sign is its own."""

    lam: Array
    beta: Array
    parts: Array

    @classmethod
    def joined(cls, pieces: list[Spectrum]) -> Spectrum:
        """The groups of several spectra as one."""
        if len(pieces) == 1:
            return pieces[0]
        return cls(
            np.concatenate([s.lam for s in pieces]), np.concatenate([s.beta for s in pieces]),
            np.concatenate([s.parts for s in pieces], axis=1),
        )  # fmt: skip

    @property
    def distance(self) -> Array:
        """d (V,): what the group's typical size moves the data, √tr A, in standard deviations."""
        return np.sqrt(self.lam.sum(axis=1))

    def explained(self, scale: float) -> Array:
        """What each group takes off eᵀPe, its coefficients γ charged with |γ|²/scale² (V,)."""
        squared = scale**2
        return np.asarray((squared * self.beta**2 / (1 + squared * self.lam)).sum(axis=1))

    def evidence(self, scales: Array = SCALES) -> Array:
        """Log evidence (V,) over the model without the group."""
        return evidence_of(self.lam, self.beta, scales)

    def flipped(self, signs: Array, scales: Array = SCALES) -> Array:
        """Log evidence (F, V) with every configuration's residual times its sign (F, C)."""
        C, V, K = self.parts.shape
        beta = (signs @ self.parts.reshape(C, -1)).reshape(-1, V, K)
        return evidence_of(self.lam, beta, scales)


def exceedance(flipped: Array, observed: float) -> float:
    """p-value of `observed` among what the flips (F,) yield, itself counted as one of them."""
    return (1 + int((flipped >= observed).sum())) / (1 + len(flipped))


def evidence_of(lam: Array, beta: Array, scales: Array) -> Array:
    """Log evidence (…,) from eigenvalues (…, K) and β (…, K)."""
    squared = beta**2
    each = []
    for s in scales:
        log_det = np.log1p(s**2 * lam).sum(axis=-1)
        shrunk = s**2 / (1 + s**2 * lam)
        each.append(0.5 * ((squared * shrunk).sum(axis=-1) - log_det))
    stacked = np.stack(each)
    top = stacked.max(axis=0)
    return np.asarray(top + np.log(np.exp(stacked - top).mean(axis=0)))


def spectrum(A: Array, b: Array, parts: Array) -> Spectrum:
    """Of Gram matrices A (V, K, K), b (V, K) and the configurations' parts (C, V, K)."""
    lam, U = np.linalg.eigh(A)
    parts = np.einsum("vkl,cvk->cvl", U, parts, optimize=True)
    beta = np.einsum("vkl,vk->vl", U, b)
    # Rounding leaves a tiny β along directions that P removes altogether.
    gone = lam <= 1e-9 * np.abs(lam).max(axis=1, keepdims=True, initial=1e-300)
    return Spectrum(
        np.where(gone, 0.0, lam), np.where(gone, 0.0, beta), np.where(gone[None], 0.0, parts)
    )
