"""What a tracker's own errors do to its readings."""

from __future__ import annotations

import numpy as np
from model.effects.stick import model, positions, rows, stick

STATION = np.array([0.5, -0.4, 0.3])
TURN = np.array([[q, p] for q in np.radians([-150, -60, 0, 90, 170]) for p in (-0.8, 0.1, 0.9)])


def readings(**values: float) -> tuple[np.ndarray, np.ndarray]:
    """True and reported positions about the instrument, of a stick that turns and nods."""
    m = model(stick("zy", (1.0, 1.5)), "tracker_distortion", tracker=STATION)
    return positions(m, rows(TURN)) - STATION, positions(m, rows(TURN), **values) - STATION


def azimuth(p: np.ndarray) -> np.ndarray:
    return np.arctan2(p[:, 1], p[:, 0])


def elevation(p: np.ndarray) -> np.ndarray:
    return np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]))


def test_a_scale_error_multiplies_ranges_from_the_instrument() -> None:
    true, observed = readings(scale=1e-3)
    np.testing.assert_allclose(observed, 1.001 * true, rtol=1e-14)


def test_refraction_lifts_by_the_square_of_the_horizontal_range() -> None:
    true, observed = readings(refraction=1e-4)
    np.testing.assert_allclose(observed[:, :2], true[:, :2], atol=1e-15)
    lift = 1e-4 * (true[:, 0] ** 2 + true[:, 1] ** 2)
    np.testing.assert_allclose(observed[:, 2] - true[:, 2], lift, atol=1e-15)


def test_an_eccentric_azimuth_circle_turns_by_the_azimuth() -> None:
    true, observed = readings(azimuth_sin=1e-3, azimuth_cos=-2e-3)
    A = azimuth(true)
    turned = np.angle(np.exp(1j * (azimuth(observed) - A)))
    np.testing.assert_allclose(turned, 1e-3 * np.sin(A) - 2e-3 * np.cos(A), atol=1e-14)
    np.testing.assert_allclose(elevation(observed), elevation(true), atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(observed, axis=1), np.linalg.norm(true, axis=1))


def test_an_eccentric_elevation_circle_tilts_by_the_elevation() -> None:
    true, observed = readings(elevation_sin=1e-3, elevation_cos=-2e-3)
    E = elevation(true)
    np.testing.assert_allclose(
        elevation(observed) - E, 1e-3 * np.sin(E) - 2e-3 * np.cos(E), atol=1e-14
    )
    np.testing.assert_allclose(azimuth(observed), azimuth(true), atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(observed, axis=1), np.linalg.norm(true, axis=1))
