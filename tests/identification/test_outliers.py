"""Faulty readings: none invented, the gross ones found, nothing dropped in silence."""

from dataclasses import replace

import numpy as np
import pytest
from support.calibration import campaign, cell_of, measured, planar_chain, table_at, with_values
from support.cells import random_poses

from elastocal.identification.identify import identify
from elastocal.identification.outliers import blocks, kept_of, rejection_point
from elastocal.identification.start import Options
from elastocal.model.manipulator import Model

SIGMA = 5e-5


def rows_of(outliers):
    return np.sort(np.array([o.line - 2 for o in outliers], dtype=int))


def test_a_shifted_block_of_two_fifths_of_the_distances_is_found():
    """The cable slipped for 48 of 120 rows, by 100 σ and more: all of them, at most one other."""
    cell = cell_of(("distance_sensor", "marker_position"), observe="distance")
    model, rng = Model.assembled(planar_chain(4), cell), np.random.default_rng(0)
    truth = with_values(model, {
        "tracker.anchor_x": 1.6, "tracker.anchor_y": -1.2, "tracker.anchor_z": 0.3,
        "tracker.length_offset": 0.1, "marker:M1.x": 0.05, "marker:M1.z": 0.1,
    })  # fmt: skip
    table = measured(model, table_at(random_poses(model.chain, 120, 0)), truth, 2e-4, rng)
    block = np.arange(48) + rng.integers(0, 72)
    distance = table.distance.copy()
    distance[block] += 0.03
    result = identify(model, replace(table, distance=distance), Options(faulty="drop"))
    found = rows_of(result.excluded)
    assert set(block) <= set(found) and len(found) <= len(block) + 1
    assert result.finding("many_left_out") in result.verdict.missing
    assert blocks([o.line for o in result.excluded])[0] == (block[0] + 2, block[-1] + 2)
    offset = result["tracker.length_offset"].held
    assert abs(offset - truth[model.names.index("tracker.length_offset")]) < 0.03 / 4


def test_dropping_equals_never_having_had_them():
    model, table, _ = campaign(poses=40, seed=2)
    rng = np.random.default_rng(1)
    bad, position = np.sort(rng.permutation(40)[:6]), table.position.copy()
    position[bad] += rng.choice([-1.0, 1.0], (6, 3)) * rng.uniform(1e-3, 1e-2, (6, 3))
    dropped = identify(model, replace(table, position=position), Options(faulty="drop"))
    never = identify(model, table.take(np.setdiff1d(np.arange(40), bad)))
    assert np.array_equal(rows_of(dropped.excluded), bad) and not never.faulty
    assert dropped.determined == never.determined and dropped.dof == never.dof
    std = np.sqrt(np.diag(never.covariance))
    assert (np.abs(dropped.x - never.x) < 1e-3 * std).all()
    np.testing.assert_allclose(dropped.covariance, never.covariance, rtol=1e-4,
                               atol=1e-6 * np.outer(std, std).max())  # fmt: skip
    assert dropped.heldout_rms == pytest.approx(never.heldout_rms, rel=1e-4)


@pytest.mark.parametrize("at_an_end", [False, True])
def test_accidents_are_set_apart_and_what_errs_at_the_end_of_a_joint_is_the_arms(at_an_end):
    model, table, _ = campaign(poses=60, seed=2)
    bad = np.argsort(table.q[:, 1])[-4:] if at_an_end else np.array([5, 20, 31, 48])
    position = table.position + 1e-3 * np.isin(np.arange(60), bad)[:, None]
    result = identify(model, replace(table, position=position))
    assert set(rows_of(result.outliers if at_an_end else result.excluded)) == set(bad)


def test_stated_sigmas_count():
    """A reading of sigma 2 mm off by 3 mm is no outlier; one of sigma 20 µm off by 1 mm is."""
    model, exact, _ = campaign(seed=9, sigma=0.0)
    rng, sigma = np.random.default_rng(1), np.full((30, 3), 2e-5)
    sigma[:10] = 2e-3
    position = exact.position + sigma * rng.normal(size=(30, 3))
    position[3] = exact.position[3] + [3e-3, 0, 0]
    position[20] = exact.position[20] + [1e-3, 0, 0]
    result = identify(model, replace(exact, sigma=sigma, position=position))
    assert rows_of(result.faulty).tolist() == [20]


@pytest.mark.parametrize("dof", [3, 8])
def test_what_setting_far_readings_apart_makes_of_a_mean(dof):
    """Means of readings of which those beyond the rejection point are set apart, as identification
    does it: of the variance, and the size of what is kept, that are said."""
    rng, readings, draws = np.random.default_rng(4), 180, 600
    z = rng.standard_t(dof, size=(draws, readings, 3)) * np.sqrt(1 - 2 / dof)
    kept = np.ones(z.shape[:2], dtype=bool)
    for _ in range(8):
        count = kept.sum(axis=1)[:, None]
        mean = (z * kept[..., None]).sum(axis=1) / count
        off = z - mean[:, None]
        sigma = np.sqrt((off**2 * kept[..., None]).sum(axis=(1, 2)) / (3 * (count[:, 0] - 1)))
        kept = (np.abs(off) < rejection_point(3 * readings) * sigma[:, None, None]).all(axis=2)
    said = kept_of(dof, 3 * readings, 3)
    assert readings * np.mean(mean**2) == pytest.approx(said.variance, rel=0.1)
    assert np.sqrt(np.mean(sigma**2)) == pytest.approx(said.sigma, rel=0.03)
    # No estimate knows more than the Fisher information of t, (dof + 1)/(dof + 3) over its scale.
    assert said.variance > (1 - 2 / dof) * (dof + 3) / (dof + 1)
