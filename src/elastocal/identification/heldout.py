"""Held-out residuals: cross-validation over configurations in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.identification.chunked import in_order, regressor
from elastocal.identification.noise import Weights
from elastocal.identification.partition import Part, Partition, Span
from elastocal.identification.triangle import Triangle
from elastocal.manipulator.model import Model

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

ALONE = 1e-9  # share of a direction that the other configurations must see


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
    rows_of = np.repeat(configuration, size)
    return residual + _growth(B, Q, R, weights.apply(residual), rows_of)


def held_out_by_parts(
    model: Model, parts: Partition, x: Array, columns: IntArray, triangle: Triangle, step: Array
) -> Array:
    """Residual (rows,) of every configuration, the model linearised at x fitted to the others.

    `triangle` is that of the whitened B of `columns` and residual at x, `step` (columns,) the
    Gauss–Newton step to the linear model's minimum, zero where x is it.
    """
    held = np.empty(len(parts.seen.value))
    size, R = parts.seen.size, triangle.R

    def rows(span: Span) -> tuple[Part, Array, Array, Array, Array]:
        part = parts.part(span)
        at = regressor(model, part, x, columns)
        residual = at.residual - at.B @ step
        e = part.weights.apply(residual)
        WB = part.weights.apply(at.B)
        return part, at.B, linalg.solve_triangular(R, WB.T, trans="T").T, residual, e

    def group(spans: tuple[Span, ...]) -> None:
        if len(spans) == 1:
            part, B, Q, residual, e = rows(spans[0])
            rows_of = np.repeat(part.observations.configuration, size)
            held[part.rows] = residual + _growth(B, Q, R, e, rows_of)
            return
        shift: dict[int, list[Array]] = {}
        for span in spans:
            part, _, Q, _, e = rows(span)
            rows_of = np.repeat(part.observations.configuration, size)
            for c in np.unique(rows_of):
                Qc, ec = Q[rows_of == c], e[rows_of == c]
                total = shift.setdefault(int(c), [np.zeros((len(R),) * 2), np.zeros(len(R))])
                total[0] += Qc.T @ Qc
                total[1] += Qc.T @ ec
        codes = np.array(sorted(shift))
        moved, alone = _moved(*(np.stack([shift[c][k] for c in codes.tolist()]) for k in (0, 1)))
        shifts = linalg.solve_triangular(R, moved.T).T
        for span in spans:
            part, B, _, residual, _ = rows(span)
            which = np.searchsorted(codes, np.repeat(part.observations.configuration, size))
            grown = residual + np.einsum("rj,rj->r", B, shifts[which])
            held[part.rows] = np.where(alone[which], np.inf, grown)

    for _ in in_order(parts.groups, group):
        pass
    return held


def _growth(B: Array, Q: Array, R: Array, e: Array, configuration: IntArray) -> Array:
    """By how much (rows,) the residual grows where its configuration is left out."""
    growth = np.empty(len(e))
    order = np.argsort(configuration, kind="stable")
    _, starts, counts = np.unique(configuration[order], return_index=True, return_counts=True)
    for count in np.unique(counts):
        rows = order[starts[counts == count][:, None] + np.arange(count)]
        Qc, ec = Q[rows], e[rows]
        if count > Q.shape[1]:
            # (I − Q_cᵀQ_c)⁻¹ Q_cᵀ is the same map, by a matrix of the parameters' size.
            moved, alone = _moved(Qc.transpose(0, 2, 1) @ Qc, _times(Qc.transpose(0, 2, 1), ec))
        else:
            solved, alone = _moved(Qc @ Qc.transpose(0, 2, 1), ec)
            moved = _times(Qc.transpose(0, 2, 1), solved)
        shift = linalg.solve_triangular(R, moved.T).T
        growth[rows] = _times(B[rows], shift)
        growth[rows[alone]] = np.inf
    return growth


def _moved(share: Array, right: Array) -> tuple[Array, NDArray[np.bool_]]:
    """(I − share)⁻¹ right per configuration, and where it is alone in some direction.

    `share` (g, k, k) positive semidefinite, `right` (g, k); meaningless where alone.
    """
    gap = np.eye(share.shape[1]) - share
    alone = np.zeros(len(share), dtype=bool)
    # The largest eigenvalue is at most the trace: only configurations of weight need theirs.
    heavy = np.flatnonzero(np.trace(share, axis1=1, axis2=2) >= 0.5)
    alone[heavy] = np.linalg.eigvalsh(gap[heavy])[:, 0] < ALONE
    gap[alone] = np.eye(share.shape[1])
    moved = np.asarray(np.linalg.solve(gap, right[..., None])[..., 0], dtype=np.float64)
    return moved, alone


def _times(matrices: Array, vectors: Array) -> Array:
    return (matrices @ vectors[..., None])[..., 0]


def rms_3d(residual: Array, size: int) -> float:
    """Root mean square length in m of the position part of the residual (rows,)."""
    parts = residual.reshape(-1, size)[:, :3]
    return float(np.sqrt((parts**2).sum(axis=1).mean()))
