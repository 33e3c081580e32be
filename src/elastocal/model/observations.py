"""From table rows to observed values: which rows are read, and how they combine."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from elastocal.cell_tables import CartesianNoise, PolarNoise, Tracker
from elastocal.measurements import Measurements, load_states, numbered
from elastocal.messages import InputError, require
from elastocal.units import Array, BoolArray, IntArray

SIZE = {"position": 3, "deflection": 3, "pose": 6, "distance": 1}
XYZ = ("x", "y", "z")
COMPONENTS = {
    "position": XYZ, "deflection": XYZ, "pose": (*XYZ, "rx", "ry", "rz"), "distance": ("distance",),
}  # fmt: skip


@dataclass(frozen=True)
class Observations:
    """N observations of `size` components each, as linear combinations of table rows.  `value`
    (N·size,) holds what was observed, row-major (all components of an observation together);
    `combine` (N, n_rows) says which rows enter: the identity, or loaded minus mean unloaded for
    deflections.  `lead` (N,) is the table row that names each observation."""

    kind: str
    value: Array
    combine: sparse.csr_array
    lead: NDArray[np.int64]
    table: Measurements

    @property
    def size(self) -> int:
        return SIZE[self.kind]

    @property
    def configuration(self) -> NDArray[np.int64]:
        return self.table.configuration[self.lead]

    @cached_property
    def n_configurations(self) -> int:
        return int(numbered(self.configuration).max(initial=-1)) + 1

    @property
    def load(self) -> IntArray:
        """Number (N,) of the load state."""
        return load_states(self.table.force[self.lead])

    @property
    def place(self) -> IntArray:
        """Number (N,) of what was read: configuration, marker and load; of one number are repeats
        of each other."""
        return numbered(self.configuration, self.table.marker[self.lead], self.load)

    def apply(self, rows: NDArray) -> NDArray:
        """Combine a per-row array (n_rows, size, …) to observations (N, size, …)."""
        if self.kind != "deflection":
            return rows
        flat = self.combine @ rows.reshape(len(rows), -1)
        return flat.reshape((len(self.lead), *rows.shape[1:]))


def observe(table: Measurements, kind: str) -> Observations:
    """The observed values of a table for `kind` in position, deflection, pose, distance.  A pose's
    rotation is observed relative to the measured one, so its value is zero and the prediction is
    the rotation vector of R_measuredᵀ R_model."""
    n = len(table)
    if kind == "deflection":
        lead, combine = pair_loaded_with_unloaded(table)
    else:
        lead = np.arange(n)
        combine = sparse.eye_array(n, format="csr")
    if kind == "distance":
        value = _needed(table.distance, table, "distance_mm (or distance_m)", kind)[:, None]
    else:
        value = _needed(table.position, table, "x_mm, y_mm, z_mm", kind)
        if kind == "pose":
            _needed(table.rotation, table, "rx_deg, ry_deg, rz_deg or qw, qx, qy, qz", kind)
            value = np.hstack([value, np.zeros((n, 3))])
    if kind == "deflection":
        value = np.asarray(combine @ value)
    return Observations(kind, value.ravel(), combine, lead, table)


def pure_error(group: IntArray, values: Array) -> tuple[float, int]:
    """Sum of squares of `values` (n, d) about the mean of their `group` (n,), and its degrees of
    freedom."""
    group = numbered(group)
    count = np.bincount(group)
    mean = np.zeros((len(count), values.shape[1]))
    np.add.at(mean, group, values)
    left = values - (mean / count[:, None])[group]
    return float((left**2).sum()), int((count - 1).sum()) * values.shape[1]


def subset(observed: Observations, chosen: BoolArray | IntArray | slice) -> Observations:
    """Of those that hold (N,), or of these numbers, which ascend."""
    value = observed.value.reshape(-1, observed.size)[chosen].ravel()
    rows = np.unique(observed.combine[chosen].indices)
    lead, own = np.searchsorted(rows, observed.lead[chosen]), observed.combine[chosen][:, rows]
    return Observations(observed.kind, value, own, lead, observed.table.take(rows))


def _needed(column: Array | None, table: Measurements, names: str, kind: str) -> Array:
    if column is None:
        raise InputError(
            f"{table.source}: observe = '{kind}' needs the columns {names}, which the table lacks"
        )
    return column


def pair_loaded_with_unloaded(table: Measurements) -> tuple[NDArray[np.int64], sparse.csr_array]:
    """The loaded rows (N,), and the combination (N, n) that pairs each with its unloaded partner:
    same configuration, repeat and marker.  Where that repeat was not measured unloaded, the mean of
    all unloaded repeats of the same configuration and marker serves."""
    loaded = np.any(table.force != 0, axis=1)
    if not loaded.any():
        raise InputError(
            f"{table.source}: observe = 'deflection' needs loaded rows, but force_x_N, force_y_N, "
            "force_z_N are zero or missing in every row"
        )
    lead, unloaded = np.flatnonzero(loaded), sparse.diags_array((~loaded).astype(float))

    def partners(*keys: NDArray[np.int64]) -> sparse.csr_array:
        """1 (N, n) where an unloaded row has the keys of a loaded one."""
        of = sparse.csr_array((np.ones(len(table)), (np.arange(len(table)), numbered(*keys))))
        return sparse.csr_array(of[lead] @ (of.T @ unloaded))

    found = partners(table.configuration, table.repeat, table.marker)
    if not (number := found.sum(axis=1)).all():
        alone = sparse.diags_array((number == 0).astype(float))
        found = found + alone @ partners(table.configuration, table.marker)
        number = found.sum(axis=1)
    if not number.all():
        i = lead[number.argmin()]
        raise InputError(
            f"{table.source}, line {table.row[i]}: the loaded reading of configuration "
            f"{table.configuration_labels[table.configuration[i]]}, marker "
            f"{table.marker_names[table.marker[i]]} has no unloaded reading to subtract; measure "
            "it without load, or use observe = 'position'"
        )
    own = sparse.eye_array(len(table), format="csr")[lead]
    combine = sparse.csr_array(own - sparse.diags_array(1 / number) @ found)
    combine.sort_indices()
    return lead, combine


def available_noise(table: Measurements, tracker: Tracker) -> str:
    """Which noise is stated: "rows" (the table's sigmas win), "polar", "axis" or "none"."""
    if table.sigma is not None:
        return "rows"
    if isinstance(tracker.noise, PolarNoise):
        return "polar"
    return "none" if tracker.noise is None else "axis"


def position_covariance(table: Measurements, tracker: Tracker, kind: str) -> tuple[Array, str]:
    """Covariance (n, 3, 3) in m² of each row's x, y, z, and a sentence on where it comes from.
    `kind`: "rows", "axis" or "polar".  Polar noise lies along the line of sight and across it:
    Σ = Σ_k s_k² e_k e_kᵀ over range, azimuth and elevation direction."""
    n, noise = len(table), tracker.noise
    if kind == "axis":
        need(isinstance(noise, CartesianNoise), "the cell has no [tracker] sigma_um")
        assert isinstance(noise, CartesianNoise)
        text = f"tracker sigma {np.round(noise.sigma * 1e6, 3).tolist()} µm along x, y, z"
        return np.broadcast_to(np.eye(3) * noise.sigma**2, (n, 3, 3)), text
    if kind == "rows":
        need(table.sigma is not None, f"{table.source} has no sigma_… columns")
        sigma, text = np.asarray(table.sigma), f"per-row {table.sigma_frame} sigmas from the table"
        if table.sigma_frame != "polar":
            return np.eye(3) * (sigma**2)[:, None, :], text
    need(table.position is not None, f"{table.source} has no positions")
    sight = np.asarray(table.position) - tracker.position
    if kind == "polar":
        stated = "range_um, range_ppm, transverse_um, transverse_ppm"
        need(isinstance(noise, PolarNoise), f"the cell has no [tracker] {stated}")
        assert isinstance(noise, PolarNoise)
        reach = np.linalg.norm(sight, axis=1)
        along = noise.range + noise.range_per_m * reach
        across = noise.transverse + noise.transverse_per_m * reach
        sigma = np.column_stack([along, across, across])
        text = "polar tracker noise (range and transverse) from the cell"
    axes = polar_axes(sight)
    return np.einsum("nki,nk,nkj->nij", axes, sigma**2, axes), text


def polar_axes(sight: Array) -> Array:
    """Unit vectors (n, 3, 3): range, azimuth and elevation direction of each line of sight."""
    length = np.linalg.norm(sight, axis=1, keepdims=True)
    need(bool((length > 0).all()), "a marker stands at the tracker's own position")
    radial = sight / length
    azimuth = np.column_stack([-radial[:, 1], radial[:, 0], np.zeros(len(radial))])
    flat = np.linalg.norm(azimuth, axis=1)
    # Straight above the tracker azimuth is undefined; any horizontal direction serves.
    azimuth = np.where(flat[:, None] > 1e-9, azimuth / np.maximum(flat, 1e-300)[:, None], [1, 0, 0])
    return np.stack([radial, azimuth, np.cross(radial, azimuth)], axis=1)


def need(condition: bool, message: str) -> None:
    require(condition, f"these weights cannot be formed: {message}")
