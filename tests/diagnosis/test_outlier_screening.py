"""Faulty readings are found, and only those; what an arm does is not taken for a fault."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from support.cells import kr270_chain, random_poses, table_of
from support.diagnosis_data import SIGMA, campaign, cell, diagnosed, measured

from elastocal.cell.arm_description import Nominal
from elastocal.diagnosis.baseline import fit_baseline
from elastocal.diagnosis.diagnosis_data import DiagnosisData, diagnosis_data_of
from elastocal.diagnosis.noise_floor import NoiseValues, fit_noise
from elastocal.diagnosis.reading_faults import screen_outliers
from elastocal.diagnosis.stated_floor import describe_faulty
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model

POSES = 60  # × 2 loads × 3 markers


def data_with(table: Measurements) -> DiagnosisData:
    return diagnosis_data_of(fit_baseline(campaign(n=POSES)[0], table), [])


@lru_cache
def clean() -> DiagnosisData:
    return data_with(campaign(n=POSES)[1])


def screened(dataset: DiagnosisData) -> tuple[np.ndarray, DiagnosisData, NoiseValues]:
    """Rows of the faulty readings, the data without them, and the noise of the others."""
    faulty = screen_outliers(dataset, dataset.data).faulty
    kept = dataset.without(faulty)
    return np.flatnonzero(faulty), kept, fit_noise(kept.data)


def spoiled(rows: np.ndarray, size: float, seed: int) -> Measurements:
    table = campaign(n=POSES)[1]
    error = np.random.default_rng(seed).normal(size=(len(rows), 3))
    position = table.position.copy()
    position[rows] += size * error / np.linalg.norm(error, axis=1, keepdims=True)
    return replace(table, position=position)


def test_good_readings_are_kept() -> None:
    faulty, _, noise = screened(clean())
    assert len(faulty) == 0 and not screen_outliers(clean(), clean().data).suspects.any()
    assert noise.factor == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_one_reading_in_a_hundred_that_is_a_millimetre_off_is_found_and_no_other(
    seed: int,
) -> None:
    rows = np.sort(np.random.default_rng(seed).choice(6 * POSES, 4, replace=False))
    table = spoiled(rows, 1e-3, seed)
    faulty, dataset, noise = screened(data_with(table))
    np.testing.assert_array_equal(faulty, rows)
    assert noise.factor == pytest.approx(1.0, abs=0.15)
    told = describe_faulty(dataset, dataset.data, noise)
    assert [f.line for f in told] == list(table.row[rows])
    for f, k in zip(told, rows, strict=True):
        assert f.error == pytest.approx(1e-3, rel=0.1)
        assert f.sigmas == pytest.approx(f.error / SIGMA / noise.factor, rel=0.01)
        assert f.configuration == table.configuration_labels[table.configuration[k]]
        assert f.marker == table.marker_names[table.marker[k]]


def test_heavy_tails_are_not_faults() -> None:
    """t with 4 degrees of freedom, of the stated size: all but a handful stay."""
    table = campaign(n=POSES)[1]
    shake = np.random.default_rng(3).standard_t(4, size=table.position.shape) / np.sqrt(2)
    faulty, _, _ = screened(data_with(replace(table, position=table.position + SIGMA * shake)))
    assert len(faulty) <= 0.02 * 6 * POSES


def test_a_slipped_marker_is_not_a_row_of_faults() -> None:
    table = campaign(n=POSES)[1]
    late = (table.marker == 1) & (table.time > 0.9 * table.time.max())
    position = table.position + 1e-3 * late[:, None]
    dataset = data_with(replace(table, position=position))
    found = screen_outliers(dataset, dataset.data)
    assert late.sum() > 8
    assert not (found.faulty & late).any()


@pytest.mark.parametrize("name", ["thermal_expansion:link2", "off_axis_compliance:joint3"])
def test_readings_that_looked_faulty_before_their_effect_was_found_are_taken_back(
    name: str,
) -> None:
    """All readings are Gaussian, whatever the arm does: none is faulty once that is known."""
    assert diagnosed(name).noise.faulty == ()


# Where the model is wrong, not the reading.

RIGID = ("base_frame", "joint_offset", "marker_position")
WRONG = 300  # poses


@lru_cache
def lagging(kind: str, markers: int, n: int = WRONG) -> tuple[Model, Measurements]:
    """An arm that every move leaves short of its target by a different part of it, or that has
    curves of errors at all joints, none of them in the model."""
    chain, plain = kr270_chain(), cell(RIGID, link_gravity=False, nominal=Nominal())
    q = random_poses(chain, n, 1)
    table = table_of(q, np.zeros(3), both=False)
    table = table.take(table.marker < markers)
    off = table.q.copy()
    if kind == "lag":
        moved = np.diff(q, axis=0, prepend=q[:1])
        part = moved / np.maximum(np.abs(moved).max(axis=1, keepdims=True), 1e-9)
        random = np.random.default_rng(3).lognormal(0, 1, (n, 1))
        off += (2e-4 * part * random)[table.configuration]
    else:
        off += 2e-4 * np.sin(7.3 * table.q + np.arange(6))
    read = measured(chain, plain, [], replace(table, q=off), 1)
    return Model.assembled(chain, plain), replace(read, q=table.q)


def with_faults(table: Measurements, rows: np.ndarray, size: float = 1e-3) -> Measurements:
    error = np.random.default_rng(4).normal(size=(len(rows), 3))
    position = table.position.copy()
    position[rows] += size * error / np.linalg.norm(error, axis=1, keepdims=True)
    return replace(table, position=position)


@pytest.mark.parametrize("markers", [1, 3])
@pytest.mark.parametrize("kind", ["lag", "curves"])
def test_an_arm_that_is_not_as_modelled_reads_nothing_wrong(kind: str, markers: int) -> None:
    model, table = lagging(kind, markers)
    dataset = diagnosis_data_of(fit_baseline(model, table), [])
    found = screen_outliers(dataset, dataset.data)
    assert not found.faulty.any()
    assert found.suspects.mean() < 0.02


@pytest.mark.parametrize("kind", ["lag", "curves"])
def test_distances_of_the_markers_tell_the_faulty_readings_of_such_an_arm(kind: str) -> None:
    model, table = lagging(kind, 3)
    rows = np.sort(np.random.default_rng(2).choice(len(table), 6, replace=False))
    read = with_faults(table, rows)
    dataset = diagnosis_data_of(fit_baseline(model, read), [])
    found = screen_outliers(dataset, dataset.data)
    np.testing.assert_array_equal(np.flatnonzero(found.faulty), rows)
    # Where no noise is stated, a millimetre is little beside what the arm does; but no other
    # reading is suspected.
    tracker = replace(model.cell.tracker, noise=None)
    bare = Model.assembled(model.chain, replace(model.cell, tracker=tracker))
    dataset = diagnosis_data_of(fit_baseline(bare, read), [])
    assert not dataset.data.stated
    found = screen_outliers(dataset, dataset.data)
    assert found.faulty.any() and set(np.flatnonzero(found.faulty)) <= set(rows)


def test_a_visit_whose_markers_moved_together_has_no_faulty_reading() -> None:
    """A millimetre common to its markers: the flange was elsewhere."""
    table = campaign(n=POSES)[1]
    position = table.position.copy()
    for c in (7, 23):
        visit = (table.configuration == c) & (table.force[:, 2] == 0)
        assert visit.sum() == 3
        position[visit] += np.array([6e-4, -6e-4, 6e-4])
    dataset = data_with(replace(table, position=position))
    assert not screen_outliers(dataset, dataset.data).faulty.any()


def test_a_visit_that_its_repeats_contradict_is_faulty() -> None:
    table = campaign(n=POSES)[1]
    rows = np.concatenate([np.arange(len(table))] * 3)
    repeat = np.repeat(np.arange(3), len(table))
    again = replace(table.take(rows), repeat=repeat, time=table.time[rows] + 3000.0 * repeat)
    noise = SIGMA * np.random.default_rng(5).normal(size=again.position.shape)
    bad = (again.configuration == 7) & (again.force[:, 2] == 0) & (repeat == 1)
    position = again.position + noise + bad[:, None] * np.array([6e-4, -6e-4, 6e-4])
    dataset = data_with(replace(again, position=position))
    found = screen_outliers(dataset, dataset.data)
    np.testing.assert_array_equal(np.flatnonzero(found.faulty), np.flatnonzero(bad))


def test_an_error_that_neighbours_share_is_the_arms() -> None:
    """Eight poses close together, measured at different times, a millimetre off alike; and one
    reading by itself."""
    chain, plain = kr270_chain(), cell(RIGID, link_gravity=False, nominal=Nominal())
    q = random_poses(chain, 300, 1)
    close = np.arange(20, 300, 37)
    q[close] = q[20] + np.random.default_rng(7).uniform(-0.02, 0.02, (len(close), 6))
    table = table_of(q, np.zeros(3), both=False)
    table = table.take(table.marker == 0)
    read = measured(chain, plain, [], table, 1)
    position = read.position.copy()
    position[close] += np.array([6e-4, -6e-4, 6e-4])
    position[101] += np.array([0, 1e-3, 0])
    model = Model.assembled(chain, plain)
    dataset = diagnosis_data_of(fit_baseline(model, replace(read, position=position)), [])
    found = screen_outliers(dataset, dataset.data)
    assert np.flatnonzero(found.faulty).tolist() == [101]
