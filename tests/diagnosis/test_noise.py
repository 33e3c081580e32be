"""The noise likelihood against dense Gaussians, and what is fitted against what was drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats
from support.diagnosis_data import campaign
from support.noisy_data import dense_noise, random_data, used_rows

from elastocal.cell_tables import Unsteadiness
from elastocal.diagnosis import baseline
from elastocal.diagnosis.baseline import Blocks, NoiseValues, NoisyData, fit_baseline, project
from elastocal.diagnosis.diagnosis_data import diagnosis_data_of
from elastocal.measurements import visits
from elastocal.model.manipulator import Model

NOISE = NoiseValues(1.3, np.array([4e-6, 9e-6, 2e-5]), np.array([0.4, 0.1, 0.9]))
SEEDS = range(2)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_marginal_likelihood_is_that_of_the_dense_gaussian(seed: int) -> None:
    data = random_data(seed)
    rows = used_rows(data)
    X = data.X.reshape(-1, data.X.shape[2])[rows]
    S = dense_noise(data, NOISE) + X / data.precision @ X.T
    expected = stats.multivariate_normal(cov=1e10 * S).logpdf(1e5 * data.r.ravel()[rows])
    expected += len(rows) * np.log(1e5)
    assert project(data, NOISE).marginal == pytest.approx(expected, rel=1e-9)
    prior = baseline.log_prior(data.stated, NOISE)
    assert data.model.objective(NOISE.logs())[0] == pytest.approx(-2 * expected + prior, rel=1e-9)


@pytest.mark.parametrize("stated", [True, False])
def test_the_slope_is_that_of_finite_differences(stated: bool) -> None:
    data, at, h = random_data(0, stated=stated), NOISE.logs(), 1e-5
    slope = data.model.objective(NOISE.logs())[1]
    for k, step in enumerate(h * np.eye(len(at))):
        up, down = (data.model.objective(at + s * step)[0] for s in (1, -1))
        assert slope[k] == pytest.approx((up - down) / (2 * h), rel=1e-5, abs=1e-5)


def drawn(true_noise: NoiseValues, n: int, seed: int) -> NoisyData:
    """Readings of two or three markers in two visits to each of n configurations."""
    rng = np.random.default_rng(seed)
    count = rng.choice([4, 6], n)
    configuration = np.repeat(np.arange(n), count)
    visit = 2 * configuration + np.concatenate([np.arange(k) >= k // 2 for k in count])
    blocks = Blocks.of(configuration, visit, 3)
    base = random_data(seed, blocks, p=5, joints=len(true_noise.joint))
    base = replace(base, left_out=blocks.absent, precision=np.full(5, 1e-6))
    V = base.V(true_noise)
    noise = (np.linalg.cholesky(V) @ rng.normal(size=(*V.shape[:2], 1)))[..., 0]
    return replace(base, r=base.masked(noise + base.X @ rng.normal(size=5)))


def test_the_noise_that_made_the_readings_is_found() -> None:
    """Nearly: 400 configurations tell the joints to a tenth, and what a joint does at each better
    than whether it does so at every visit."""
    true_noise = NoiseValues(1.4, np.array([5e-6, 1.5e-5]), np.full(2, 0.6))
    data = drawn(true_noise, 400, 3)
    found = baseline.fit_noise(data)
    assert found.factor == pytest.approx(true_noise.factor, rel=0.05)
    np.testing.assert_allclose(found.joint, true_noise.joint, rtol=0.2)
    assert found.shared_by_all == pytest.approx(true_noise.shared_by_all, abs=0.35)
    both = (noise.joint * np.hypot(1, noise.shared) for noise in (found, true_noise))
    np.testing.assert_allclose(*both, rtol=0.15)
    # No search from it or from the true noise finds a twentieth of −2 log posterior more.
    for start in (found, true_noise):
        further = optimize.minimize(lambda t: data.model.objective(t)[:2], start.logs(), jac=True)
        assert data.model.objective(found.logs())[0] < further.fun + 0.05


def test_a_stated_drift_is_noise_that_readings_have_in_common_by_their_times() -> None:
    """Its waves and what changes faster, common to a visit, make drift² exp(−|t − t′|/lasting)."""
    size, lasting = 40e-6, 900.0
    model, table = campaign(n=12)
    visit = visits(table)
    table = replace(table, time=60.0 * visit)
    kinds = Unsteadiness(drift=size, lasting=lasting), Unsteadiness(configuration=1.0)
    stated, shaken = (Model.assembled(model.chain, replace(model.cell, noise=n)) for n in kinds)
    base = fit_baseline(model, table)
    plain, data = (diagnosis_data_of(replace(base, model=m), []) for m in (model, stated))
    assert plain.drift == 0 and data.drift == size
    blocks, new = data.blocks, len(data.fitted) - len(plain.fitted)
    waves = blocks.unpack(data.data.X[:, :, -new:])
    found = np.einsum("nik,mjk->nmij", waves, waves)
    faster = data.data.covariance - plain.data.covariance
    for members, own in zip(blocks.member, faster, strict=True):
        here = members[members < blocks.n]
        square = own.reshape(len(members), 3, -1, 3)[: len(here), :, : len(here)]
        found[np.ix_(here, here)] += square.transpose(0, 2, 1, 3)
    own_visit, when = visit[data.lead], table.time[data.lead]
    alike = np.exp(-np.abs(when[:, None] - when) / lasting)
    expected = size**2 * alike[..., None, None] * np.eye(3)
    same = own_visit[:, None] == own_visit
    np.testing.assert_allclose(found[same], expected[same], atol=1e-9 * size**2)
    assert np.abs(found - expected).max() < 0.1 * size**2
    # What is common to a configuration is in those that are only planned, too.
    now, planned = (diagnosis_data_of(replace(base, model=shaken, planned=k), []) for k in (0, 9))
    np.testing.assert_array_equal(now.data.covariance, planned.data.covariance)
