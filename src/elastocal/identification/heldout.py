"""Held-out residuals: cross-validation over configurations in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.identification.noise import Weights

Array = NDArray[np.float64]


def held_out_residual(
    B: Array, residual: Array, weights: Weights, configuration: NDArray, size: int
) -> Array:
    """Residual (rows,) of every configuration under the fit to all the others.

    With whitened B = QR and whitened residual e, leaving configuration c out moves the estimate
    by x̂ − x̂₍₋c₎ = R⁻¹ Q_cᵀ (I − Q_c Q_cᵀ)⁻¹ e_c, exactly for a linear model (Allen 1974, PRESS,
    by groups); the residual of c then grows by B_c times that.  A configuration that alone
    determines a parameter has no held-out residual: its rows are infinite.

    B (rows, columns) and residual (rows,) raw; `configuration` (observations,), `size` rows each.
    """
    Q, R = linalg.qr(weights.apply(B), mode="economic")
    e = weights.apply(residual)
    rows_of = np.repeat(configuration, size)
    order = np.argsort(rows_of, kind="stable")
    _, starts, counts = np.unique(rows_of[order], return_index=True, return_counts=True)
    held = residual.copy()
    for count in np.unique(counts):
        groups = np.flatnonzero(counts == count)
        rows = order[starts[groups][:, None] + np.arange(count)]
        Qc, ec = Q[rows], e[rows]
        gap = np.eye(count) - Qc @ Qc.transpose(0, 2, 1)
        alone = np.linalg.eigvalsh(gap)[:, 0] < 1e-9
        gap[alone] = np.eye(count)
        moved = Qc.transpose(0, 2, 1) @ np.linalg.solve(gap, ec[..., None])
        shift = linalg.solve_triangular(R, moved[..., 0].T).T
        held[rows] += np.einsum("gij,gj->gi", B[rows], shift)
        held[rows[alone]] = np.inf
    return held


def rms_3d(residual: Array, size: int) -> float:
    """Root mean square length in m of the position part of the residual (rows,)."""
    parts = residual.reshape(-1, size)[:, :3]
    return float(np.sqrt((parts**2).sum(axis=1).mean()))
