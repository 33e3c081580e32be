"""Is a reading explained by the others?  Deletion residuals under an estimated noise model.

With P = V⁻¹ − V⁻¹BΦBᵀV⁻¹, the error of predicting reading i from all others, its configuration's
shared deviation included, is d_i = P_ii⁻¹ (P e)_i with covariance P_ii⁻¹ (Haslett and Hayes 1998,
J. R. Stat. Soc. B 60, 201): one evaluation judges every reading of the fit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from elastocal.identification.variance.choose import NoiseFit
from elastocal.identification.variance.likelihood import Whitened
from elastocal.identification.variance.readings import Labels, Readings
from elastocal.identification.variance.reml import Reml
from elastocal.identification.variance.structure import STRUCTURES, polar

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def beyond_noise(found: NoiseFit, readings: Readings, good: Mask, level: float) -> Mask:
    """Readings (N,) that the noise does not explain, at `level` for the whole table (Bonferroni).

    `found` was estimated from the `good` readings (N,); they and the others are judged by the
    error of predicting them from good readings that are not they.  Each component of it, in
    units of its own deviation, is compared with t on the degrees of freedom behind that.
    """
    own, dof = own_noise(found.fit, readings)
    t = np.zeros(readings.e.shape)
    t[good] = _fitted(found, readings.take(good), own[good])
    if not good.all():
        t[~good] = _not_fitted(found, readings.take(~good), own[~good])
    # A fitted reading has a part in the variance it is measured with: leave it out there as well.
    squared = np.minimum(t**2, dof * (1 - 1e-12))
    outside = np.maximum(dof - 1, 1.0)
    deleted = np.sqrt(squared * outside / (dof - squared))
    size = np.where(good[:, None], deleted, np.abs(t))
    p = 2 * stats.t.sf(size, np.where(good[:, None], outside, dof))
    return np.asarray(p.min(axis=1) < level / readings.e.size)


def own_noise(fit: Reml, readings: Readings) -> tuple[Array, Array]:
    """Covariance (N, size, size) of single readings, and degrees of freedom (N, size) behind it.

    A reading of a group that has none in the fit gets the mean of all variances.
    """
    name = fit.structure.name
    whole = (
        polar(readings, "angular" in fit.structure.names)
        if name == "polar"
        else STRUCTURES[name](readings)
    )
    place = {name: k for k, name in enumerate(fit.structure.names)}
    known = np.array([place.get(name, -1) for name in whole.names])
    own = fit.own
    theta = np.where(known >= 0, own[known], own.mean())
    W = fit.covariance[: len(own), : len(own)]
    spread = np.where(known >= 0, np.diag(W)[known], np.diag(W).max())
    cell = readings.cell
    index, matrix = whole.index[cell], whole.matrix[cell]
    if name == "stated":
        matrix = np.asarray(readings.stated)[:, None]
    covariance = np.einsum("nl,nlij->nij", theta[index], matrix)
    parts = np.diagonal(matrix, axis1=2, axis2=3)  # (N, L, size)
    variance = np.einsum("nl,nla->na", spread[index], parts**2)
    diagonal = np.diagonal(covariance, axis1=1, axis2=2)
    return covariance, np.maximum(2 * diagonal**2 / np.maximum(variance, 1e-300), 2.0)


def _fitted(found: NoiseFit, inside: Readings, own: Array) -> Array:
    """Deletion residuals (N, size) of the readings of the fit, each over its deviation."""
    fit = found.fit
    cells, cell = fit.structure.cells, inside.cell
    n_cells, size = len(cells), inside.size
    mean_P, mean_Pe = np.zeros((n_cells, size, size)), np.zeros((n_cells, size))
    for w in fit.state.whitened:
        back = w.inverse.transpose(0, 2, 1)
        VB, Pe = back @ w.B, (back @ _residual(fit, w)[:, :, None])[..., 0]
        for j in range(w.stack.cells.shape[1]):
            rows = slice(j * size, (j + 1) * size)
            column = w.inverse[:, :, rows]
            P = column.transpose(0, 2, 1) @ column
            mean_P[w.stack.cells[:, j]] = P - VB[:, rows] @ fit.state.Phi @ VB[:, rows].transpose(
                0, 2, 1
            )
            mean_Pe[w.stack.cells[:, j]] = Pe[:, rows]
    precision = np.linalg.inv(own)
    unit = np.einsum("cl,clij->cij", fit.own[fit.structure.index], fit.structure.mean_matrix)
    share = precision @ unit[cell]  # of a reading in the mean of its cell, transposed
    P = precision - share @ precision + share @ mean_P[cell] @ share.transpose(0, 2, 1)
    deviation = (inside.e - cells.e[cell])[:, :, None]
    Pe = (precision @ deviation + share @ mean_Pe[cell][:, :, None])[..., 0]
    # A direction that this reading alone determines has no deletion residual.
    values, vectors = np.linalg.eigh(P)
    smallest = 1e-9 * np.linalg.eigvalsh(precision)[:, -1:]
    inverse = np.where(values > smallest, 1 / np.maximum(values, smallest), 0.0)
    spread = (vectors * inverse[:, None, :]) @ vectors.transpose(0, 2, 1)
    d = (spread @ Pe[:, :, None])[..., 0]
    deviation = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    return np.divide(d, deviation, out=np.zeros_like(d), where=deviation > 0)


def _not_fitted(found: NoiseFit, rest: Readings, own: Array) -> Array:
    """Prediction errors (N, size) of readings outside the fit, each over its deviation.

    With k the covariance of a reading with the fitted ones, d = e − BΔx − kᵀV⁻¹r varies by
    Σ − kᵀV⁻¹k + FΦ_AFᵀ, where F = B − kᵀV⁻¹B_fit.
    """
    fit = found.fit
    d, F = rest.e - rest.B @ found.x, rest.B.copy()
    spread = own.copy()
    for effect, variance in zip(fit.shared, fit.common, strict=True):
        spread += variance * np.diag(effect.axes)
    if fit.shared:
        for w in fit.state.whitened:
            here, u = _common(fit, w, rest)
            back = u.transpose(0, 2, 1)
            mates, z = w.B[here[1]], _residual(fit, w)[here[1]]
            d[here[0]] -= (back @ z[:, :, None])[..., 0]
            spread[here[0]] -= back @ u
            seen = (back @ mates).reshape(-1, rest.n_parameters)
            F[here[0]] -= np.linalg.solve(found.basis.T, seen.T).T.reshape(F[here[0]].shape)
    spread += F @ found.covariance.matrix @ F.transpose(0, 2, 1)
    return d / np.sqrt(np.diagonal(spread, axis1=1, axis2=2))


def _common(fit: Reml, w: Whitened, rest: Readings) -> tuple[tuple[Labels, Labels], Array]:
    """Which readings of `rest` have mates in which cluster of the stack, and R⁻¹k (n, rows, size).

    k is what a reading and its configuration's fitted cells vary by together.
    """
    cells, size = fit.structure.cells, rest.size
    cluster = {int(c): g for g, c in enumerate(cells.configuration[w.stack.cells[:, 0]])}
    mates = np.array([cluster.get(int(c), -1) for c in rest.configuration])
    here = np.flatnonzero(mates >= 0)
    members = w.stack.cells[mates[here]]  # (n, cells)
    common = np.zeros((len(here), members.shape[1], size))
    for effect, variance in zip(fit.shared, fit.common, strict=True):
        same = np.all(
            [getattr(cells, by)[members] == getattr(rest, by)[here, None] for by in effect.by],
            axis=0,
        )
        common += variance * same[:, :, None] * effect.axes
    k = (common[:, :, :, None] * np.eye(size)).reshape(len(here), members.shape[1] * size, size)
    return (here, mates[here]), w.inverse[mates[here]] @ k


def _residual(fit: Reml, w: Whitened) -> Array:
    """R⁻¹ (e − BΔx) (G, n) of a stack; x and B are in the fit's orthonormal basis."""
    return w.e - w.B @ fit.state.x
