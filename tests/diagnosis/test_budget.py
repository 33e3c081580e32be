"""Errors of configurations left out of the fit: as if each were, one by one."""

from __future__ import annotations

import numpy as np
import pytest
from support.diagnosis_data import SIGMA, campaign, diagnosed, random_data

from elastocal.diagnosis.baseline import fit_baseline
from elastocal.diagnosis.diagnosis_data import diagnosis_data_of
from elastocal.diagnosis.hypotheses import possible
from elastocal.diagnosis.model_set import Item, fit_set
from elastocal.diagnosis.noise_floor import NoiseValues, covariance, project
from elastocal.diagnosis.stated_floor import left_out_residual, left_out_together

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


def test_a_drift_is_judged_on_hours_that_were_left_out() -> None:
    """Between two neighbours it needs no model; what does not go with time is left out singly."""
    model, table = campaign("thermal_expansion:link2")
    base = fit_baseline(model, table)
    dataset = diagnosis_data_of(base, possible(model, table)[0])
    (h,) = (h for h in dataset.hypotheses if (h.name, h.where) == ("thermal_expansion", "link2"))
    chosen = fit_set(dataset, (Item(h, np.array([1200.0]), 0.0),))
    drift = left_out_together(dataset, chosen)
    assert drift is not None and len(np.unique(drift)) == 10
    (still,) = (h for h in dataset.hypotheses if h.label == "encoder_scale:joint3")
    assert left_out_together(dataset, fit_set(dataset, (Item(still, np.zeros(0), 0.0),))) is None


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
