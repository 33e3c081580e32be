"""What a tracker's stated noise means for x, y, z: against readings drawn in polar coordinates."""

from dataclasses import replace

import numpy as np
import pytest
from support.calibration import table_at

from elastocal.cell.arm_description import PolarNoise, Tracker
from elastocal.model.observations import polar_axes, position_covariance

NOISE = PolarNoise(range=1e-4, range_per_m=5e-5, transverse=3e-4, transverse_per_m=1e-4)
STATION = np.array([1.0, -0.5, 0.8])


def table(points):
    points = np.atleast_2d(np.asarray(points, dtype=float))
    return replace(table_at(np.zeros((len(points), 3))), position=points)


def polar_draws(sight, sigma, rng, n):
    """Cartesian points of range, azimuth and elevation readings; transverse sigmas are lengths."""
    r = np.linalg.norm(sight)
    azimuth, elevation = np.arctan2(sight[1], sight[0]), np.arcsin(sight[2] / r)
    r_n = r + sigma[0] * rng.normal(size=n)
    azimuth = azimuth + sigma[1] / (r * np.cos(elevation)) * rng.normal(size=n)
    elevation = elevation + sigma[2] / r * rng.normal(size=n)
    flat = r_n * np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth),
                            r_n * np.sin(elevation)])  # fmt: skip


@pytest.mark.parametrize("sight", [[-1, 3, -1], [0.5, -0.2, 1.5]])
@pytest.mark.parametrize("rows", [False, True])
def test_polar_covariance_against_draws_in_polar_coordinates(sight, rows):
    """n draws: an entry of the sample covariance has standard error ≤ √(2/n) of the two
    standard deviations' product; five of them, plus the curvature (σ/r)² < 1e-6, bound it."""
    sight, n = np.array(sight, dtype=float), 200_000
    reach = np.linalg.norm(sight)
    across = NOISE.transverse + NOISE.transverse_per_m * reach
    sigma = np.array([NOISE.range + NOISE.range_per_m * reach, across, across])
    measured = table(STATION + sight)
    if rows:
        sigma = np.array([5e-5, 4e-4, 2e-4])
        measured = replace(measured, sigma=sigma[None], sigma_frame="polar")
    kind = "rows" if rows else "polar"
    covariance, text = position_covariance(measured, Tracker(STATION, NOISE), kind)
    assert "polar" in text
    draws = polar_draws(sight, sigma, np.random.default_rng(1), n)
    sample = np.cov(draws.T)
    # compare along the polar directions, where the sizes differ
    axes = polar_axes(sight[None])[0]
    difference = axes @ (covariance[0] - sample) @ axes.T
    assert (np.abs(difference) < 5 * np.sqrt(2 / n) * np.outer(sigma, sigma)).all()
