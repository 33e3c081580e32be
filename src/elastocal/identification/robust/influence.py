"""Influence in closed form: what the estimate would be without a row, marker, configuration.

With whitened B = QR, whitened least-squares residual e, and group g of m_g rows,

    x̂ − x̂₍₋g₎ = R⁻¹ (I − Q_gᵀQ_g)⁻¹ Q_gᵀ e_g,        held-out residual  (I − Q_g Q_gᵀ)⁻¹ e_g,
    Δ_g = e_gᵀ (I − Q_g Q_gᵀ)⁻¹ e_g                  (what leaving g out takes off the rss)

exactly for a linear model (Cook and Weisberg 1982, chapter 3; Belsley, Kuh and Welsch 1980).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from elastocal.errors import require
from elastocal.identification.robust.design import design

Array = NDArray[np.float64]

ALONE = 1e-9  # smallest eigenvalue of I − H_gg below which a group alone determines something


@dataclass(frozen=True)
class Influence:
    """One entry per group, in ascending order of `label` (G,).

    `rows` (G,) rows of the group; `shift` (G, p) = x̂ − x̂₍₋g₎ in the parameters' units; `dfbetas`
    (G, p) = shift over its standard deviation √(s₍₋g₎² (BᵀB)⁻¹_jj); `cook` (G,) =
    shiftᵀ BᵀB shift/(p s²); `covratio` (G,) = det cov(x̂₍₋g₎)/det cov(x̂), above 1 where the group
    helps; `F` and `p_value` (G,) = (Δ_g/m_g)/s₍₋g₎² against F(m_g, rows − m_g − p), the externally
    studentised held-out residual; `held_out` (rows,).  A group that alone determines a parameter
    has no held-out fit: its held-out residual is infinite and its other entries NaN.
    """

    label: NDArray[np.int64]
    rows: NDArray[np.int64]
    shift: Array
    dfbetas: Array
    cook: Array
    covratio: Array
    F: Array
    p_value: Array
    held_out: Array


def influence(
    B: ArrayLike, y: ArrayLike, group: ArrayLike | None = None, *, size: int = 1
) -> Influence:
    """Leave-one-group-out influence on the least-squares fit of y (n·size,) on B (n·size, p).

    `group` (n,) integer label of each observation of `size` rows: its marker, configuration or
    any other; by default every observation by itself.  B and y are whitened.

    Raises InputError for wrong shapes or dependent columns.
    """
    problem = design(B, y, size)
    n, p, m = problem.n, problem.p, len(problem.y)
    labels = np.arange(n) if group is None else np.asarray(group)
    require(
        labels.shape == (n,) and np.issubdtype(labels.dtype, np.integer),
        f"group must hold one integer label per observation, ({n},); found {labels.dtype} "
        f"{labels.shape}",
    )
    names, code, count = np.unique(labels, return_inverse=True, return_counts=True)
    e = problem.residual(problem.Q.T @ problem.y)
    rows_of = np.argsort(np.repeat(code, size), kind="stable")
    starts = np.cumsum(count * size) - count * size
    G = len(names)
    moved, drop, logdet = np.full((G, p), np.nan), np.full(G, np.nan), np.full(G, np.nan)
    held = np.full(m, np.inf)
    for length in np.unique(count) * size:
        chosen = np.flatnonzero(count * size == length)
        rows = rows_of[starts[chosen][:, None] + np.arange(length)]
        found = _leave_out(problem.Q[rows], e[rows])
        moved[chosen], drop[chosen], logdet[chosen] = found[:3]
        held[rows] = found[3]
    return _summary(problem.parameters(moved.T).T, problem.cofactor, moved, drop, logdet, held,
                    names, count * size, float(e @ e))  # fmt: skip


def _leave_out(Q: Array, e: Array) -> tuple[Array, Array, Array, Array]:
    """Shift in z (k, p), Δ (k,), log det(I − H) (k,), held-out residual (k, m) of k equal groups.

    Works with I − QᵀQ (p × p) for large groups and I − QQᵀ (m × m) for small ones; both have the
    same determinant.
    """
    _, m, p = Q.shape
    QT = Q.transpose(0, 2, 1)
    wide = m > p
    gap = np.eye(p) - QT @ Q if wide else np.eye(m) - Q @ QT
    alone = np.linalg.eigvalsh(gap)[:, 0] < ALONE
    gap[alone] = np.eye(gap.shape[1])
    if wide:
        shift = np.asarray(np.linalg.solve(gap, QT @ e[..., None]))[..., 0]
        held = np.asarray(e + np.einsum("gij,gj->gi", Q, shift))
    else:
        held = np.asarray(np.linalg.solve(gap, e[..., None]))[..., 0]
        shift = np.einsum("gij,gi->gj", Q, held)
    drop = np.asarray((e * held).sum(axis=1))
    logdet = np.asarray(np.linalg.slogdet(gap)[1])
    shift[alone], drop[alone], logdet[alone], held[alone] = np.nan, np.nan, np.nan, np.inf
    return shift, drop, logdet, held


def _summary(
    shift: Array,
    cofactor: Array,
    moved: Array,
    drop: Array,
    logdet: Array,
    held: Array,
    names: NDArray[np.int64],
    rows: NDArray[np.int64],
    rss: float,
) -> Influence:
    m, p = int(rows.sum()), len(cofactor)
    s2 = rss / (m - p)
    dof = m - p - rows
    possible = np.where(dof > 0, dof, np.nan)
    without = np.maximum(rss - drop, 0.0) / possible
    with np.errstate(divide="ignore", invalid="ignore"):
        F = drop / rows / without
        dfbetas = shift / np.sqrt(without[:, None] * np.diag(cofactor))
        cook = (moved**2).sum(axis=1) / (p * s2)
        covratio = np.exp(p * np.log(without / s2) - logdet)
    return Influence(
        names, rows, shift, dfbetas, cook, covratio, F, stats.f.sf(F, rows, possible), held
    )
