"""Faulty readings: none invented, the gross ones found, nothing dropped in silence."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from support.calibration import (
    GEOMETRY,
    PLACED,
    cell_of,
    measured,
    planar_chain,
    table_at,
    true_values,
    with_values,
)
from support.cells import random_poses

from elastocal.identification.identify import identify
from elastocal.identification.options import Options
from elastocal.identification.outliers import FALSE_ALARM, blocks, kept_of, rejection_point
from elastocal.model.manipulator import Model

SIGMA = 5e-5


def clean_table(model, seed, poses):
    rng = np.random.default_rng(seed)
    truth = true_values(model, rng)
    plan = table_at(random_poses(model.chain, poses, seed))
    return measured(model, plan, truth, SIGMA, rng), truth, rng


def with_gross_errors(table, rng, share, low=1e-3, high=0.1):
    """Every component of a share of the readings is off by `low` to `high` (m)."""
    n = len(table)
    bad = np.sort(rng.permutation(n)[: round(share * n)])
    position = table.position.copy()
    size = rng.uniform(low, high, (len(bad), 3))
    position[bad] += rng.choice([-1.0, 1.0], (len(bad), 3)) * size
    return replace(table, position=position), bad


def rows_of(outliers):
    return np.sort(np.array([o.line - 2 for o in outliers], dtype=int))


def test_clean_tables_hardly_ever_raise_an_alarm():
    """At a rate of 1 % more than 3 alarms in 20 tables have a probability below 1e-4."""
    model = Model.assembled(planar_chain(), cell_of(("base_frame",)))
    tables = (clean_table(model, seed, 12)[0] for seed in range(20))
    alarms = sum(bool(identify(model, table).faulty) for table in tables)
    assert alarms <= stats.binom.isf(1e-4, 20, FALSE_ALARM)


# --- gross errors ---------------------------------------------------------------------------


def test_a_tenth_of_gross_errors_is_found_and_little_else():
    """20 σ and more are far beyond any limit.  A good reading is accused in one table of a
    hundred, so not one of 54 with a probability of 99 %; one per table is allowed."""
    model = Model.assembled(planar_chain(), cell_of(GEOMETRY))
    table, _, rng = clean_table(model, 1, 60)
    wrong, bad = with_gross_errors(table, rng, 0.1)
    found = rows_of(identify(model, wrong).faulty)
    assert set(bad) <= set(found)
    assert len(found) <= len(bad) + 1


def distance_block(seed, share, shift):
    model = Model.assembled(
        planar_chain(4), cell_of(("distance_sensor", "marker_position"), observe="distance")
    )
    rng = np.random.default_rng(seed)
    truth = with_values(model, {
        "tracker.anchor_x": 1.6, "tracker.anchor_y": -1.2, "tracker.anchor_z": 0.3,
        "tracker.length_offset": 0.1, "marker:M1.x": 0.05, "marker:M1.z": 0.1,
    })  # fmt: skip
    table = measured(model, table_at(random_poses(model.chain, 120, seed)), truth, 2e-4, rng)
    start = int(rng.integers(0, round(120 * (1 - share))))
    block = np.arange(start, start + round(120 * share))
    distance = table.distance.copy()
    distance[block] += shift
    return model, replace(table, distance=distance), block, truth


def test_a_shifted_block_of_two_fifths_of_the_distances_is_found():
    """The cable slipped for 48 of 120 rows, by 100 σ and more: all of them, at most one other."""
    model, table, block, truth = distance_block(0, 0.4, 0.03)
    result = identify(model, table, Options(faulty="drop"))
    found = rows_of(result.excluded)
    assert set(block) <= set(found) and len(found) <= len(block) + 1
    assert blocks([o.line for o in result.excluded])[0] == (block[0] + 2, block[-1] + 2)
    offset = result["tracker.length_offset"].held
    assert abs(offset - truth[model.names.index("tracker.length_offset")]) < 0.03 / 4


# --- leaving them out -----------------------------------------------------------------------


def test_dropping_equals_never_having_had_them():
    model = Model.assembled(planar_chain(), cell_of(PLACED))
    table, _, rng = clean_table(model, 2, 40)
    wrong, bad = with_gross_errors(table, rng, 0.15, high=0.01)
    dropped = identify(model, wrong, Options(faulty="drop"))
    good = np.setdiff1d(np.arange(40), bad)
    never = identify(model, table.take(good))
    assert np.array_equal(rows_of(dropped.excluded), bad)
    assert dropped.determined == never.determined and dropped.dof == never.dof
    std = np.sqrt(np.diag(never.covariance))
    assert (np.abs(dropped.x - never.x) < 1e-3 * std).all()
    np.testing.assert_allclose(dropped.covariance, never.covariance, rtol=1e-4,
                               atol=1e-6 * np.outer(std, std).max())  # fmt: skip
    assert dropped.heldout_rms == pytest.approx(never.heldout_rms, rel=1e-4)


def test_nothing_is_left_out_in_silence():
    model = Model.assembled(planar_chain(), cell_of(PLACED))
    table, _, rng = clean_table(model, 7, 40)
    wrong, bad = with_gross_errors(table, rng, 0.05)
    kept = identify(model, wrong, Options(faulty="keep"))
    assert np.array_equal(rows_of(kept.outliers), bad) and kept.excluded == ()
    assert len(kept.residual) == 120 and len(kept.residual_table()) == 40
    assert any(w.startswith("2 readings lie beyond what the noise explains") for w in kept.warnings)
    assert any("outliers='drop' excludes them" in w for w in kept.warnings)
    dropped = identify(model, wrong, Options(faulty="drop"))
    assert np.array_equal(rows_of(dropped.excluded), bad) and dropped.outliers == ()
    assert len(dropped.residual) == 114
    assert not {row["line"] - 2 for row in dropped.residual_table()} & set(bad)
    assert any(w.startswith("2 readings were excluded as outliers") for w in dropped.warnings)
    listed = dropped.to_json()["excluded"]
    assert [o["line"] - 2 for o in listed] == list(bad)
    assert all(o["residual"] > 1e-3 and o["ratio"] > 10 for o in listed)


def test_stated_sigmas_count():
    """A reading of sigma 2 mm that is off by 3 mm is no outlier; one of sigma 20 µm off by 1 mm
    is."""
    model = Model.assembled(planar_chain(), cell_of(PLACED))
    rng = np.random.default_rng(9)
    truth = true_values(model, rng)
    plan = table_at(random_poses(model.chain, 30, 9))
    sigma = np.full((30, 3), 2e-5)
    sigma[:10] = 2e-3
    exact = measured(model, plan, truth, 0.0, rng)
    position = exact.position + sigma * rng.normal(size=(30, 3))
    position[3] = exact.position[3] + [3e-3, 0, 0]
    position[20] = exact.position[20] + [1e-3, 0, 0]
    result = identify(model, replace(plan, sigma=sigma, position=position))
    assert rows_of(result.faulty).tolist() == [20]


# --- what it makes of an estimate -------------------------------------------------------------


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
