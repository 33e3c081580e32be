"""Covariance and degrees of freedom of an estimate whose weights were estimated too.

Kenward and Roger 1997 (Biometrics 53, 983): with W = cov(θ̂), P_k = −BᵀV⁻¹V_kV⁻¹B and
Q_kl = BᵀV⁻¹V_kV⁻¹V_lV⁻¹B,

    Φ_A = Φ + 2 Φ [Σ_kl W_kl (Q_kl − P_k Φ P_l)] Φ

Φ alone is too small twice over: estimated weights cost accuracy, and Φ̂ does not see it.  (Their
term in ∂²V/∂θ² is zero, V being linear in θ.)  A combination c of the parameters has
Satterthwaite's degrees of freedom 2 (cᵀΦc)² / (gᵀWg), g_k = cᵀΦBᵀV⁻¹V_kV⁻¹BΦc, which is what
theirs are for one contrast.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.variance.reml import Reml

Array = NDArray[np.float64]


def kenward_roger(fit: Reml, combinations: Array | None = None) -> tuple[Array, Array]:
    """Adjusted covariance (k, k) of `combinations` (k, p) of Δx, default each parameter.

    And the degrees of freedom (k,) of each; infinite where no estimated variance matters.
    """
    Phi, C, W = fit.state.Phi, fit.slope.C, fit.covariance
    p = len(Phi)
    middle = np.zeros((p, p))
    for w in fit.state.whitened:
        index = w.stack.index
        G, L = index.shape
        AB = w.A @ w.B[:, None]  # (G, L, n, p)
        weight = W[index[:, :, None], index[:, None, :]]
        mixed = (weight @ AB.reshape(G, L, -1)).reshape(AB.shape)
        middle += np.tensordot(AB, mixed, ((0, 1, 2), (0, 1, 2)))
    mixed = (W @ C.reshape(len(W), -1)).reshape(C.shape)
    middle -= (C @ Phi @ mixed).sum(axis=0)
    # No less than zero but for rounding, which shows where variances differ by many powers of ten.
    values, vectors = np.linalg.eigh((middle + middle.T) / 2)
    more = Phi @ (vectors * np.sqrt(2 * np.maximum(values, 0.0)))
    adjusted = Phi + more @ more.T
    rows = np.eye(p) if combinations is None else combinations
    plain = rows @ Phi
    variance = (plain * rows).sum(axis=1)
    g = ((plain @ C) * plain).sum(axis=2)  # (K, k)
    spread = (g * (W @ g)).sum(axis=0)
    told = spread > 0
    dof = np.divide(2 * variance**2, spread, out=np.full(len(rows), np.inf), where=told)
    covariance = rows @ adjusted @ rows.T
    return (covariance + covariance.T) / 2, dof
