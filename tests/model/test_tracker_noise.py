"""What a tracker's stated noise means for x, y, z: against readings drawn in polar coordinates."""

from dataclasses import replace

import numpy as np
import pytest
from support.calibration import table_at

from elastocal.cell.arm_description import CartesianNoise, PolarNoise, Tracker
from elastocal.errors import InputError
from elastocal.model.observations import available_noise, polar_axes, position_covariance

AXIS = Tracker(noise=CartesianNoise(np.array([1e-5, 2e-5, 3e-5])))
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


@pytest.mark.parametrize(
    "sight", [[2, 1, 0.5], [-1, 3, -1], [0.5, -0.2, 1.5], [-4, -4, 0], [0, 1, 0]]
)
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


def test_axes_are_orthonormal_right_handed_and_azimuth_is_horizontal():
    sight = np.random.default_rng(2).normal(size=(50, 3))
    axes = polar_axes(sight)
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), np.tile(np.eye(3), (50, 1, 1)),
                               atol=1e-12)  # fmt: skip
    np.testing.assert_allclose(np.linalg.det(axes), 1.0)
    np.testing.assert_allclose(axes[:, 1, 2], 0.0)
    assert (axes[:, 2, 2] > 0).all()  # elevation grows upwards
    np.testing.assert_allclose(np.cross(axes[:, 0], sight), 0.0, atol=1e-12)


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_straight_above_or_below_the_tracker(up):
    covariance, _ = position_covariance(table([0, 0, 2 * up]), Tracker(noise=NOISE), "polar")
    across, along = 3e-4 + 2e-4, 1e-4 + 1e-4
    np.testing.assert_allclose(covariance[0], np.diag([across, across, along]) ** 2, atol=1e-20)


def test_isotropic_polar_noise_is_cartesian():
    same = PolarNoise(2e-5, 0.0, 2e-5, 0.0)
    points = np.random.default_rng(3).normal(size=(20, 3))
    covariance, _ = position_covariance(table(points), Tracker(STATION, same), "polar")
    np.testing.assert_allclose(covariance, np.tile(4e-10 * np.eye(3), (20, 1, 1)), atol=1e-22)


def test_cartesian_noise_of_cell_and_rows():
    points = np.random.default_rng(4).normal(size=(5, 3))
    covariance, text = position_covariance(table(points), AXIS, "axis")
    np.testing.assert_allclose(covariance, np.tile(np.diag([1e-10, 4e-10, 9e-10]), (5, 1, 1)))
    assert "[10.0, 20.0, 30.0] µm" in text
    sigma = np.random.default_rng(5).uniform(1e-6, 1e-4, (5, 3))
    covariance, text = position_covariance(replace(table(points), sigma=sigma), AXIS, "rows")
    np.testing.assert_allclose(covariance, [np.diag(s**2) for s in sigma])
    assert "per-row cartesian" in text


def test_turning_station_and_points_together_turns_the_covariance():
    """About the vertical, which the tracker's angles refer to."""
    points = np.random.default_rng(6).normal(size=(8, 3)) + np.array([3, 0, 0])
    c, s = np.cos(0.7), np.sin(0.7)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    a, _ = position_covariance(table(points), Tracker(STATION, NOISE), "polar")
    b, _ = position_covariance(table(points @ R.T), Tracker(R @ STATION, NOISE), "polar")
    np.testing.assert_allclose(b, R @ a @ R.T, atol=1e-20)


def test_the_tables_sigmas_come_first():
    bare = table([[1.0, 2.0, 3.0]])
    rows = replace(bare, sigma=np.full((1, 3), 1e-5))
    polar = Tracker(noise=NOISE)
    assert [available_noise(rows, t) for t in (AXIS, polar, Tracker())] == ["rows"] * 3
    assert [available_noise(bare, t) for t in (AXIS, polar, Tracker())] == ["axis", "polar", "none"]


@pytest.mark.parametrize(
    ("kind", "tracker", "message"),
    [
        ("rows", AXIS, r"table\.csv has no sigma_… columns"),
        ("axis", Tracker(noise=NOISE), r"the cell has no \[tracker\] sigma_um"),
        ("polar", AXIS, r"the cell has no \[tracker\] range_um"),
        ("polar", Tracker(), r"the cell has no \[tracker\] range_um"),
    ],
)
def test_noise_that_is_not_stated_is_refused(kind, tracker, message):
    with pytest.raises(InputError, match=message):
        position_covariance(table([[1.0, 2.0, 3.0]]), tracker, kind)


def test_a_marker_inside_the_tracker_is_refused():
    with pytest.raises(InputError, match="a marker stands at the tracker's own position"):
        position_covariance(table([STATION]), Tracker(STATION, NOISE), "polar")


def test_polar_noise_needs_positions():
    bare = replace(table([[1.0, 2.0, 3.0]]), position=None)
    with pytest.raises(InputError, match=r"table\.csv has no positions"):
        position_covariance(bare, Tracker(noise=NOISE), "polar")
