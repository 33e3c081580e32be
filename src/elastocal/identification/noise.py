"""Measurement noise: covariance of the observations and the weights W with W Σ = I.

Weights as in Klimchik et al. 2013, eq. (9) to (13), generalised from a diagonal Σ to blocks:
a polar tracker's errors are correlated in x, y, z, and deflections that share an unloaded
reading are correlated with each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from elastocal.cell import Tracker
from elastocal.errors import InputError, option
from elastocal.manipulator.observation import Observations
from elastocal.tracker_noise import available_noise, need, position_covariance

Array = NDArray[np.float64]
WeightKind = Literal["auto", "none", "rows", "axis", "polar", "covariance"]


@dataclass(frozen=True)
class Weights:
    """`whiten` (rows, rows) with whiten · Σ · whitenᵀ = I, or None for unit weights.

    `absolute` says whether Σ is stated in m² (then a whitened residual has expected size 1)
    or holds only up to a common factor, which the residual must tell.
    """

    kind: str
    whiten: sparse.csr_array | None
    absolute: bool
    description: str

    def apply(self, rows: Array) -> Array:
        """Whiten a vector (rows,) or matrix (rows, k)."""
        return rows if self.whiten is None else self.whiten @ rows


def weights_for(
    seen: Observations, tracker: Tracker, kind: WeightKind = "auto", covariance: Array | None = None
) -> Weights:
    """Weights for the observations; "auto" takes the table's sigmas, else the cell's, else none.

    "rows" uses the table's sigma columns (Cartesian or polar), "axis" the cell's `sigma_um`,
    "polar" the cell's range and transverse noise, "covariance" the matrix (rows, rows) given.
    Raises InputError where the noise that `kind` names is not there.
    """
    chosen = _available(seen, tracker) if kind == "auto" and covariance is None else kind
    if covariance is not None or chosen == "covariance":
        return _given(seen, covariance)
    if chosen == "none":
        return Weights("none", None, False, "unit weights (ordinary least squares)")
    blocks, text = stated_covariance(seen, tracker, chosen)
    kind_used = "axis" if seen.kind == "distance" else chosen
    if seen.kind != "deflection":  # every observation is a reading of its own
        return Weights(kind_used, block_diagonal(inverse_factor(blocks)), True, text)
    mix = sparse.kron(seen.combine, sparse.eye_array(seen.size), format="csr")
    covariance_rows = sparse.csr_array(mix @ block_diagonal(blocks) @ mix.T)
    return Weights(kind_used, whitener(covariance_rows), True, text)


def stated_covariance(seen: Observations, tracker: Tracker, kind: str) -> tuple[Array, str]:
    """Stated covariance (n_rows, size, size) of every table row, and where it comes from.

    Raises InputError where the cell or the table does not state what this needs.
    """
    if seen.kind == "distance":
        need(tracker.distance_sigma is not None, "distances need [tracker] distance_um")
        sigma = float(tracker.distance_sigma or 1.0)
        text = f"distance sigma {sigma * 1e6:.3g} µm from the cell"
        return np.full((len(seen.table), 1, 1), sigma**2), text
    blocks, text = position_covariance(seen.table, tracker, kind)
    if seen.kind == "pose":
        need(tracker.rotation_sigma is not None, "poses need [tracker] rotation_urad")
        full = np.zeros((len(seen.table), 6, 6))
        full[:, :3, :3] = blocks
        full[:, 3:, 3:] = np.eye(3) * float(tracker.rotation_sigma or 1.0) ** 2
        blocks = full
    return blocks, text


def scaled_by_component(seen: Observations, sigma: Array) -> Weights:
    """Weights from one sigma per component (size,), known up to a common factor.

    For full poses without stated noise: positions in m and rotations in rad need a relative
    weight, which is estimated from the residuals of a first fit.
    """
    diagonal = np.tile(1.0 / sigma, len(seen.lead))
    text = "position and rotation weighted by the spread of their residuals in a first fit"
    return Weights("component", sparse.csr_array(sparse.diags_array(diagonal)), False, text)


def _available(seen: Observations, tracker: Tracker) -> str:
    if seen.kind == "distance":
        return "none" if tracker.distance_sigma is None else "axis"
    if seen.kind == "pose" and tracker.rotation_sigma is None:
        return "none"
    return available_noise(seen.table, tracker)


def _given(seen: Observations, covariance: Array | None) -> Weights:
    need(covariance is not None, f"weights 'covariance' need a matrix ({option('covariance')})")
    matrix = np.asarray(covariance, dtype=float)
    n = len(seen.value)
    need(
        matrix.shape == (n, n),
        f"the covariance is {matrix.shape}, but there are {n} rows (observations × components)",
    )
    need(
        bool(np.isfinite(matrix).all()) and np.allclose(matrix, matrix.T, rtol=1e-9),
        "the covariance must be finite and symmetric",
    )
    return Weights("covariance", whitener(sparse.csr_array(matrix)), True, "given covariance")


def block_diagonal(blocks: Array) -> sparse.csr_array:
    """Blocks (n, d, d) along the diagonal; their zeros are not stored."""
    n, d, _ = blocks.shape
    block, i, j = np.nonzero(blocks)
    counts = np.bincount(block * d + i, minlength=n * d)
    indptr = np.concatenate([[0], np.cumsum(counts)])
    return sparse.csr_array((blocks[block, i, j], block * d + j, indptr), shape=(n * d, n * d))


def inverse_factor(blocks: Array) -> Array:
    """L⁻¹ of each block (n, d, d) = L Lᵀ."""
    try:
        factor = np.linalg.cholesky(blocks)
    except np.linalg.LinAlgError:
        raise InputError(
            "the noise covariance is not positive definite; check sigmas and covariance"
        ) from None
    return np.linalg.solve(factor, np.broadcast_to(np.eye(blocks.shape[1]), factor.shape))


def whitener(covariance: sparse.csr_array) -> sparse.csr_array:
    """L⁻¹ of the Cholesky factor, block by block over groups of correlated rows."""
    count, label = sparse.csgraph.connected_components(covariance, directed=False)
    order = np.argsort(label, kind="stable")
    sizes = np.bincount(label, minlength=count)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    rows, columns, values = [], [], []
    for size in np.unique(sizes):
        groups = np.flatnonzero(sizes == size)
        members = order[starts[groups][:, None] + np.arange(size)]
        i, j = members[:, :, None], members[:, None, :]
        i, j = np.broadcast_arrays(i, j)
        dense = np.asarray(covariance[i.ravel(), j.ravel()]).reshape(i.shape)
        inverse = inverse_factor(dense)
        keep = np.tril(np.ones((size, size), dtype=bool))
        rows.append(i[:, keep].ravel())
        columns.append(j[:, keep].ravel())
        values.append(inverse[:, keep].ravel())
    triplets = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_array(triplets, shape=covariance.shape)
