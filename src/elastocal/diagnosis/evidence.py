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
FEW = 3  # columns of a group that is turned entry by entry


@dataclass(frozen=True)
class Spectrum:
    """V groups of K columns: eigenvalues `lam` (V, K) of A, `beta` (V, K) = Uᵀb, and `flips`
    (F, V, K): β of residuals whose configurations had their signs flipped, F = 0 unless asked
    for."""

    lam: Array
    beta: Array
    flips: Array

    @classmethod
    def joined(cls, pieces: list[Spectrum]) -> Spectrum:
        """The groups of several spectra as one."""
        if len(pieces) == 1:
            return pieces[0]
        return cls(
            np.concatenate([s.lam for s in pieces]), np.concatenate([s.beta for s in pieces]),
            np.concatenate([s.flips for s in pieces], axis=1),
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

    def flipped(self, scales: Array = SCALES) -> Array:
        """Log evidence (F, V) of the residuals with flipped signs."""
        return evidence_of(self.lam, self.flips, scales)


def exceedance(flipped: Array, observed: float) -> float:
    """p-value of `observed` among what the flips (F,) yield, itself counted as one of them."""
    return (1 + int((flipped >= observed).sum())) / (1 + len(flipped))


def evidence_of(lam: Array, beta: Array, scales: Array) -> Array:
    """Log evidence (…,) from eigenvalues (V, K) and β (…, V, K); mixed over `scales` (S,)."""
    squared = scales[:, None, None] ** 2
    log_det = np.log1p(squared * lam).sum(axis=-1)
    each = np.einsum("...vk,svk->s...v", beta**2, squared / (1 + squared * lam))
    each -= log_det.reshape(len(scales), *[1] * (beta.ndim - 2), -1)
    each *= 0.5
    top = each.max(axis=0)
    each -= top
    return np.asarray(top + np.log(np.exp(each, out=each).mean(axis=0)))


def log_sum(values: Array, axis: int = -1) -> Array:
    """log Σ exp of finite values along an axis."""
    top = values.max(axis=axis, keepdims=True)
    return np.asarray(np.log(np.exp(values - top).sum(axis=axis)) + top.squeeze(axis))


def spectrum(A: Array, b: Array, flips: Array) -> Spectrum:
    """Of Gram matrices A (V, K, K), b (V, K) and those of flipped residuals (F, V, K)."""
    lam, U = np.linalg.eigh(A)
    beta, flips = _turned(b[None], U)[0], _turned(flips, U)
    # Rounding leaves a tiny β along directions that P removes altogether.
    gone = lam <= 1e-9 * np.abs(lam).max(axis=1, keepdims=True, initial=1e-300)
    return Spectrum(*(np.where(gone, 0.0, each) for each in (lam, beta, flips)))


def _turned(b: Array, U: Array) -> Array:
    """Σ_k b_fvk U_vkl (F, V, K)."""
    if U.shape[1] > FEW:
        return np.asarray((b.transpose(1, 0, 2) @ U).transpose(1, 0, 2))
    # Thousands of tiny products: sums over their few entries are faster than a call for each.
    out = np.empty_like(b)
    for j in range(U.shape[1]):
        out[..., j] = sum(b[..., k] * U[:, k, j] for k in range(U.shape[1]))
    return out
