"""Errors of configurations left out of the fit: as if each were, one by one."""

from __future__ import annotations

import numpy as np
import pytest
from support.diagnosis_data import SIGMA, campaign, diagnosed, random_blocks, random_data

from elastocal.diagnosis import (
    Item,
    NoiseValues,
    blocks_of_time,
    covariance,
    diagnosis_data_of,
    fit_baseline,
    fit_set,
    left_out_residual,
    left_out_together,
    noise_rms,
    possible,
    project,
    rms_with_interval,
    squared_lengths,
)

NOISE = NoiseValues(1.2, np.array([4e-6, 9e-6, 1e-5]), np.full(3, 0.4))
SEEDS = range(4)


@pytest.mark.parametrize("seed", SEEDS)
def test_left_out_residuals_are_those_of_fits_without_the_configuration(seed: int) -> None:
    data = random_data(seed)
    found = left_out_residual(project(data, NOISE))
    inverse, X, r = np.linalg.inv(covariance(data, NOISE)), data.masked(data.X), data.masked(data.r)
    for c in range(len(r)):
        rest = np.arange(len(r)) != c
        M = np.einsum("cmp,cmn,cnq->pq", X[rest], inverse[rest], X[rest])
        z = np.einsum("cmp,cmn,cn->p", X[rest], inverse[rest], r[rest])
        beta = np.linalg.solve(M + np.diag(data.precision), z)
        expected = r[c] - X[c] @ beta
        np.testing.assert_allclose(found[c], expected, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_groups_areleft_out_together(seed: int) -> None:
    data = random_data(seed)
    together = np.array([0, 1, 0, 2, 1])
    found = left_out_residual(project(data, NOISE), together)
    inverse, X, r = np.linalg.inv(covariance(data, NOISE)), data.masked(data.X), data.masked(data.r)
    for g in range(3):
        rest = together != g
        M = np.einsum("cmp,cmn,cnq->pq", X[rest], inverse[rest], X[rest])
        z = np.einsum("cmp,cmn,cn->p", X[rest], inverse[rest], r[rest])
        beta = np.linalg.solve(M + np.diag(data.precision), z)
        expected = (r - X @ beta)[~rest]
        np.testing.assert_allclose(found[~rest], expected, rtol=1e-6, atol=1e-12)
    alone = left_out_residual(project(data, NOISE), np.arange(5))
    np.testing.assert_allclose(alone, left_out_residual(project(data, NOISE)), rtol=1e-6)


def test_blocks_of_time_follow_each_other() -> None:
    """By the first reading of each configuration, whatever the order of the rows."""
    blocks = random_blocks(3, sizes=(3, 2) * 15)
    time = np.random.default_rng(0).uniform(0, 100, blocks.n)
    first = np.append(time, np.inf)[blocks.member].min(axis=1)
    tenth = blocks_of_time(blocks, time)
    assert np.bincount(tenth).tolist() == [3] * 10
    assert (np.diff(tenth[np.argsort(first)]) >= 0).all()


def test_a_drift_is_judged_on_hours_that_were_left_out() -> None:
    """Between two neighbours it needs no model; what does not go with time is left out singly."""
    model, table = campaign("thermal_expansion:link2")
    base = fit_baseline(model, table)
    dataset = diagnosis_data_of(base, possible(model, table)[0])
    (h,) = (h for h in dataset.hypotheses if (h.name, h.where) == ("thermal_expansion", "link2"))
    chosen = fit_set(dataset, (Item(h, np.array([1200.0]), 0.0),))
    drift = left_out_together(dataset, chosen)
    assert drift is not None and len(np.unique(drift)) == 10
    (still,) = (h for h in dataset.hypotheses if h.label == "encoder_scale at joint3")
    assert left_out_together(dataset, fit_set(dataset, (Item(still, np.zeros(0), 0.0),))) is None


@pytest.mark.parametrize("seed", SEEDS)
def test_lengths_are_summed_over_readings_that_count(seed: int) -> None:
    data = random_data(seed)
    squares, count = squared_lengths(data, data.masked(data.r))
    kept = ~data.left_out.all(axis=1)
    assert count.sum() == data.n_rows / 3
    assert squares.sum() == pytest.approx((data.r[~data.left_out] ** 2).sum())
    assert (squares[~kept] == 0).all()
    rms, (low, high) = rms_with_interval(data, data.r, np.random.default_rng(0))
    assert low < rms < high
    assert rms == pytest.approx(np.sqrt(squares.sum() / count.sum()))


def test_the_rms_of_noise_is_that_of_noise_drawn_from_its_covariance() -> None:
    data = random_data(1)
    L = np.linalg.cholesky(covariance(data, NOISE))
    z = np.random.default_rng(0).normal(size=(4000, *data.r.shape))
    drawn = np.einsum("cmn,dcn->dcm", L, z)
    lengths = np.array([squared_lengths(data, data.masked(x))[0].sum() for x in drawn])
    count = squared_lengths(data, data.r)[1].sum()
    assert noise_rms(data, NOISE) == pytest.approx(np.sqrt(lengths.mean() / count), rel=0.03)


@pytest.mark.parametrize("name", ["gear_eccentricity:joint4", "thermal_expansion:link2"])
def test_the_gap_falls_step_by_step_to_the_noise_floor(name: str) -> None:
    d = diagnosed(name)
    steps = [s.step for s in d.budget]
    assert steps[0] == "base_frame" and steps[-2:] == [name, "noise_floor"]
    rms = [s.heldout_rms for s in d.budget]
    assert rms == sorted(rms, reverse=True)
    assert all(s.ci95[0] <= s.heldout_rms <= s.ci95[1] for s in d.budget)
    assert rms[-2] < 1.25 * rms[-1]
    assert rms[-3] > 1.2 * rms[-2]
    assert d.gap.nominal == rms[0] and d.gap.calibrated == rms[-3]
    assert d.gap.explained == rms[-2] and d.gap.noise_floor == rms[-1]
    # Three axes of tracker noise, and what the joints' scatter adds.
    assert np.sqrt(3) * SIGMA < 1.1 * rms[-1] and rms[-1] < 3 * np.sqrt(3) * SIGMA


def test_without_an_effect_the_calibrated_gap_is_the_explained_one() -> None:
    d = diagnosed()
    assert d.gap.calibrated == d.gap.explained == d.budget[-2].heldout_rms
    assert d.gap.explained < 1.3 * d.gap.noise_floor
