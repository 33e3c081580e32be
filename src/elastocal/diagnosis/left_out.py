"""Errors on configurations, or blocks of time, left out of the fit, in closed form."""

from __future__ import annotations

import numpy as np

from elastocal.diagnosis.baseline import Blocks
from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import ModelSet
from elastocal.diagnosis.noise_floor import NoiseValues, NoisyData, Projection, project
from elastocal.units import Array, IntArray

TENTHS = 10  # blocks of time that are left out in turn


def left_out_residual(at: Projection, together: IntArray | None = None) -> Array:
    """r_c − X_c β̂₋c = P_cc⁻¹ u_c (C, m): each configuration under the fit to the others.

    `together` (C,) numbers the group that each is left out with; by itself where None.  For a
    group, with V and H of its configurations,

        P⁻¹u = V u + V H (I − HᵀVH)⁻¹ HᵀV u.
    """
    if together is None:
        return np.asarray(np.linalg.solve(at.P, at.u[..., None])[..., 0])
    Vu, VH = (np.linalg.solve(at.inverse, b) for b in (at.u[..., None], at.H))
    out = Vu[..., 0]
    for g in np.unique(together):
        own = together == g
        H = at.H[own]
        inner = np.eye(H.shape[2]) - np.einsum("cmp,cmq->pq", H, VH[own])
        z = np.linalg.solve(inner, np.einsum("cmp,cm->p", H, Vu[own, :, 0]))
        out[own] += VH[own] @ z
    return np.asarray(out)


def blocks_of_time(blocks: Blocks, time: Array) -> IntArray:
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


def left_out_together(dataset: DiagnosisData, chosen: ModelSet) -> IntArray | None:
    time, cell = dataset.table.time, dataset.base.model.cell
    known = [item.what for item in chosen.items if isinstance(item.what, Hypothesis)]
    if time is None or not any("time" in what.effect.needed(cell) for what in known):
        return None
    return blocks_of_time(dataset.blocks, time[dataset.lead])


def left_out_square(data: NoisyData, noise: NoiseValues, together: IntArray | None = None) -> float:
    """Mean square (m²) of the 3-D error of a reading whose configuration was left out."""
    squares, count = squared_lengths(data, left_out_residual(project(data, noise), together))
    return float(squares.sum() / count.sum())
