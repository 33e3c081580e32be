"""The laser tracker's noise, and how repeatable the arm is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from places import log_uniform
from skeleton import Array

Variant = Literal[
    "as_modelled", "sigma_wrong", "heavy_tails", "outliers", "joint_pattern", "shared_scatter"
]
VARIANTS: tuple[Variant, ...] = get_args(Variant)

LEVELS = (10e-6, 100e-6)  # m, rms of one coordinate over the campaign
REPEATABILITY = 6e-6  # rad per joint and visit
OUTLIER_SHARE, OUTLIER_SIZE = 0.01, (3e-4, 2e-3)  # of readings; m
PATTERN = (0.2, 3.0)  # one joint's repeatability over the usual one
STATED = (0.67, 1.5)  # stated sigma over the true one


@dataclass(frozen=True)
class Noise:
    """σ of range is s (10 µm + 1 µm/m r), across it s (10 µm + per_metre r), and s such that one
    coordinate's rms σ is `level` m at `distance` m.  stated: stated σ over the true one;
    repeatability (J,) rad, one draw per visit (per pose in the variant "shared_scatter").
    """

    variant: Variant
    level: float
    distance: float
    per_metre: float
    stated: float
    repeatability: Array
    outlier_share: float

    def sigma(self, points: Array) -> Array:
        """True sigma (..., 3) in m along range, azimuth and elevation of points (..., 3)."""
        unit = np.sqrt(np.mean(self._shape(np.array(self.distance)) ** 2))
        return self._shape(np.linalg.norm(points, axis=-1)) * (self.level / unit)

    def _shape(self, r: Array) -> Array:
        across = 10e-6 + self.per_metre * r
        return np.stack([10e-6 + 1e-6 * r, across, across], axis=-1)

    def jitter(self, pose: NDArray[np.int64], rng: np.random.Generator) -> Array:
        """What each drive misses its target by, (n, J) rad, at visits of `pose` (n,)."""
        per_visit = rng.normal(size=(len(pose), len(self.repeatability)))
        if self.variant == "shared_scatter":
            first, group = np.unique(pose, return_index=True, return_inverse=True)[1:]
            per_visit = per_visit[first[group]]
        return per_visit * self.repeatability

    def add(self, points: Array, rng: np.random.Generator) -> Array:
        """Readings (n, M, 3) of points (n, M, 3), both in m in the tracker's frame."""
        error = rng.normal(size=points.shape)
        if self.variant == "heavy_tails":
            # Student's t with 4 degrees of freedom has variance 2.
            error = rng.standard_t(4, size=points.shape) / np.sqrt(2)
        read = points + np.einsum("...k,...ki->...i", error * self.sigma(points), polar(points))
        hit = rng.random(points.shape[:2]) < self.outlier_share
        away = rng.normal(size=(int(hit.sum()), 3))
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        low, high = np.log(OUTLIER_SIZE)
        read[hit] += away * np.exp(rng.uniform(low, high, (len(away), 1)))
        return read


def draw_noise(
    variant: Variant,
    n_joints: int,
    distance: float,
    rng: np.random.Generator,
    level: float | None = None,
) -> Noise:
    """A noise of the given kind at `distance` m; its level in m, log-uniform unless given."""
    drawn = log_uniform(LEVELS, rng)
    per_metre = float(rng.uniform(5e-6, 12e-6))
    stated = log_uniform(STATED, rng)
    pattern = np.array([log_uniform(PATTERN, rng) for _ in range(n_joints)])
    return Noise(
        variant,
        drawn if level is None else level,
        distance,
        per_metre,
        stated if variant == "sigma_wrong" else 1.0,
        REPEATABILITY * (pattern if variant == "joint_pattern" else np.ones(n_joints)),
        OUTLIER_SHARE if variant == "outliers" else 0.0,
    )


def polar(points: Array) -> Array:
    """Unit vectors along range, azimuth and elevation, (..., 3 directions, 3)."""
    along = points / np.linalg.norm(points, axis=-1, keepdims=True)
    x, y, z = np.moveaxis(along, -1, 0)
    flat = np.hypot(x, y)
    azimuth = np.stack([-y / flat, x / flat, np.zeros_like(flat)], axis=-1)
    elevation = np.stack([-x * z / flat, -y * z / flat, flat], axis=-1)
    return np.stack([along, azimuth, elevation], axis=-2)
