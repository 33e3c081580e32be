"""Weights: W Σ Wᵀ = I for every way of stating the noise."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg
from support.calibration import table_at

from elastocal.cell_tables import CartesianNoise, PolarNoise, Tracker
from elastocal.identification.weighted_problem import weights_for
from elastocal.messages import InputError
from elastocal.model.observations import observe

POLAR = Tracker(np.array([0.3, -0.2, 0.1]), PolarNoise(2e-6, 3e-6, 5e-6, 2e-5))
AXIS = Tracker(noise=CartesianNoise(np.array([1e-5, 2e-5, 3e-5])))


def some_table(n=12, states=1, seed=0):
    rng = np.random.default_rng(seed)
    forces = [[0.0, 0.0, -100.0 * s] for s in range(states)]
    table = table_at(rng.normal(size=(n, 3)), forces)
    position = rng.normal(size=(len(table), 3)) + np.array([2.0, 1.0, 0.5])
    return replace(table, position=position)


def reading_covariance(table, tracker):
    """Σ (3 n, 3 n) written out reading by reading, from the definition of the polar directions."""
    blocks = []
    for i, p in enumerate(table.position):
        if table.sigma is not None:
            sigma, polar = table.sigma[i], table.sigma_frame == "polar"
        elif isinstance(tracker.noise, PolarNoise):
            noise, reach = tracker.noise, np.linalg.norm(p - tracker.position)
            across = noise.transverse + noise.transverse_per_m * reach
            sigma = np.array([noise.range + noise.range_per_m * reach, across, across])
            polar = True
        else:
            sigma, polar = tracker.noise.sigma, False
        axes = np.eye(3)
        if polar:
            ray = (p - tracker.position) / np.linalg.norm(p - tracker.position)
            side = np.cross([0, 0, 1], ray)
            side /= np.linalg.norm(side)
            axes = np.array([ray, side, np.cross(ray, side)])
        blocks.append(axes.T @ np.diag(sigma**2) @ axes)
    return linalg.block_diag(*blocks)


def assert_whitens(weights, covariance):
    W = weights.whiten.toarray()
    np.testing.assert_allclose(W @ covariance @ W.T, np.eye(len(W)), atol=1e-9)


def with_sigma(table, frame, seed=1):
    rng = np.random.default_rng(seed)
    sigma = 10.0 ** rng.uniform(-6, -3, (len(table), 3))
    return replace(table, sigma=sigma, sigma_frame=frame)


@pytest.mark.parametrize("kind", ["position", "deflection"])
@pytest.mark.parametrize("case", ["axis", "polar", "rows cartesian", "rows polar"])
def test_whitens_positions_and_deflections(case, kind):
    tracker = POLAR if "polar" in case else AXIS
    table = some_table(states=1 if kind == "position" else 2)
    if case.startswith("rows"):
        table = with_sigma(table, case.split()[1])
    observed = observe(table, kind)
    weights = weights_for(observed, tracker)
    assert weights.kind == case.split()[0] and weights.absolute
    mix = np.kron(observed.combine.toarray(), np.eye(3))
    assert_whitens(weights, mix @ reading_covariance(table, tracker) @ mix.T)


def test_whitens_poses_and_distances():
    rng = np.random.default_rng(2)
    table = some_table(n=5)
    table = replace(table, rotation=rng.normal(size=(5, 3)), distance=rng.uniform(1, 2, 5))
    tracker = replace(AXIS, rotation_sigma=2e-5, distance_sigma=4e-5)
    block = np.diag([1e-5, 2e-5, 3e-5, 2e-5, 2e-5, 2e-5]) ** 2
    assert_whitens(weights_for(observe(table, "pose"), tracker), np.kron(np.eye(5), block))
    assert_whitens(weights_for(observe(table, "distance"), tracker), 16e-10 * np.eye(5))


def test_auto_takes_the_tables_sigmas_then_the_cells_then_none():
    table, rows = some_table(), np.ones(36)
    stated = with_sigma(table, "cartesian")
    for given, tracker, kind in (
        (stated, AXIS, "rows"),
        (stated, Tracker(), "rows"),
        (table, AXIS, "axis"),
        (table, Tracker(), "none"),
    ):
        weights = weights_for(observe(given, "position"), tracker)
        assert weights.kind == kind and weights.absolute == (kind != "none")
    assert weights.whiten is None and weights.apply(rows) is rows


def test_distances_and_poses_need_their_own_sigma():
    table = replace(some_table(), distance=np.ones(12), rotation=np.zeros((12, 3)))
    with pytest.raises(InputError, match=r"distances need \[tracker\] distance_um"):
        weights_for(observe(table, "distance"), AXIS, "axis")
    with pytest.raises(InputError, match=r"poses need \[tracker\] rotation_urad"):
        weights_for(observe(table, "pose"), AXIS, "axis")
