"""What the tracker's stated noise means for a reading: covariance of x, y, z."""

from __future__ import annotations

import numpy as np

from elastocal.cell.arm_description import CartesianNoise, PolarNoise, Tracker
from elastocal.errors import InputError, require
from elastocal.measurements import Measurements
from elastocal.units import Array


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
    Σ = Σ_k s_k² e_k e_kᵀ over range, azimuth and elevation direction.

    Raises InputError where the noise that `kind` names is not stated.
    """
    n = len(table)
    if kind == "rows":
        need(table.sigma is not None, f"{table.source} has no sigma_… columns")
        sigma = np.asarray(table.sigma)
        text = f"per-row {table.sigma_frame} sigmas from the table"
        polar = table.sigma_frame == "polar"
    elif kind == "axis":
        noise = tracker.noise
        if not isinstance(noise, CartesianNoise):
            raise InputError("these weights cannot be formed: the cell has no [tracker] sigma_um")
        sigma, polar = np.tile(noise.sigma, (n, 1)), False
        text = f"tracker sigma {np.round(noise.sigma * 1e6, 3).tolist()} µm along x, y, z"
    else:
        noise = tracker.noise
        if not isinstance(noise, PolarNoise):
            raise InputError(
                "these weights cannot be formed: the cell has no [tracker] range_um, range_ppm, "
                "transverse_um, transverse_ppm"
            )
        reach = np.linalg.norm(_position(table) - tracker.position, axis=1)
        along = noise.range + noise.range_per_m * reach
        across = noise.transverse + noise.transverse_per_m * reach
        sigma, polar = np.column_stack([along, across, across]), True
        text = "polar tracker noise (range and transverse) from the cell"
    if not polar:
        return np.eye(3) * (sigma**2)[:, None, :], text
    axes = polar_axes(_position(table) - tracker.position)
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


def _position(table: Measurements) -> Array:
    need(table.position is not None, f"{table.source} has no positions")
    return np.asarray(table.position)


def need(condition: bool, message: str) -> None:
    """Raise InputError unless `condition` holds: what the noise model lacks."""
    require(condition, f"these weights cannot be formed: {message}")
