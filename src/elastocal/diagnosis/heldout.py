"""Errors on configurations, or blocks of time, left out of the fit, in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.blocks import Blocks
from elastocal.diagnosis.noise import NoiseValues, NoisyData, covariance
from elastocal.diagnosis.projection import Projection
from elastocal.identification.error_budget import resampled_rms

Array = NDArray[np.float64]

Labels = NDArray[np.int64]

TENTHS = 10  # blocks of time that are left out in turn


def left_out_residual(at: Projection, together: Labels | None = None) -> Array:
    """r_c − X_c β̂₋c = P_cc⁻¹ u_c (C, m): each configuration under the fit to the others.

    `together` (C,) numbers the group that each is left out with; by itself where None.  For a
    group, with V and H of its configurations,

        P⁻¹u = V u + V H (I − HᵀVH)⁻¹ HᵀV u.
    """
    if together is None:
        P = at.inverse - at.H @ at.H.transpose(0, 2, 1)
        return np.asarray(np.linalg.solve(P, at.u[..., None])[..., 0])
    Vu, VH = (np.linalg.solve(at.inverse, b) for b in (at.u[..., None], at.H))
    out = Vu[..., 0]
    for g in np.unique(together):
        own = together == g
        H = at.H[own]
        inner = np.eye(H.shape[2]) - np.einsum("cmp,cmq->pq", H, VH[own])
        z = np.linalg.solve(inner, np.einsum("cmp,cm->p", H, Vu[own, :, 0]))
        out[own] += VH[own] @ z
    return np.asarray(out)


def blocks_of_time(blocks: Blocks, time: Array) -> Labels:
    """Which tenth of the campaign (C,) each configuration was first measured in; `time` (N,)."""
    padded = np.append(time, np.inf)
    first = padded[blocks.member].min(axis=1)
    order = np.argsort(np.argsort(first, kind="stable"), kind="stable")
    return np.asarray(order * TENTHS // len(first))


def squared_lengths(data: NoisyData, packed: Array) -> tuple[Array, Array]:
    """Per configuration: Σ of squared 3-D lengths of `packed` (C, m), and the number of readings.

    Of a pose the position counts, of a distance its one component.
    """
    C, M = data.blocks.member.shape
    size = data.blocks.size
    used = ~data.left_out.reshape(C, M, size)[:, :, 0]
    part = packed.reshape(C, M, size)[:, :, : min(size, 3)]
    return ((part**2).sum(axis=2) * used).sum(axis=1), used.sum(axis=1)


def rms_with_interval(
    data: NoisyData, packed: Array, rng: np.random.Generator
) -> tuple[float, tuple[float, float]]:
    """3-D rms in m of residuals (C, m) and its 95 % interval by resampling configurations."""
    return resampled_rms(*squared_lengths(data, packed), rng)


def noise_rms(data: NoisyData, noise: NoiseValues) -> float:
    """3-D rms in m that the noise alone gives a reading."""
    V = covariance(data, noise)
    variance = np.diagonal(V, axis1=1, axis2=2) * ~data.left_out
    blocks: Blocks = data.blocks
    C, M = blocks.member.shape
    part = variance.reshape(C, M, blocks.size)[:, :, : min(blocks.size, 3)]
    used = ~data.left_out.reshape(C, M, blocks.size)[:, :, 0]
    return float(np.sqrt(part.sum() / used.sum()))
