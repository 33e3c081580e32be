"""The noise likelihood against dense Gaussians, and what is fitted against what was drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg, optimize, stats
from support.diagnosis_data import campaign, dense_noise, kept_only, random_data, used_rows

from elastocal.cell.arm_description import Unsteadiness
from elastocal.diagnosis import (
    Blocks,
    NoiseValues,
    NoisyData,
    Weighted,
    covariance,
    diagnosis_data_of,
    fit_baseline,
    fit_noise,
    likelihood,
    log_prior,
    posterior,
    project,
)
from elastocal.diagnosis.noise_floor import (
    curved_likelihood,
    inverse_triangle,
    least_within,
    prior_curvature,
    scored_climb,
)
from elastocal.measurements import visits
from elastocal.model import Model

NOISE = NoiseValues(1.3, np.array([4e-6, 9e-6, 2e-5]), np.array([0.4, 0.1, 0.9]))
SEEDS = range(4)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_covariance_is_built_of_tracker_noise_visits_and_configurations(seed: int) -> None:
    data = random_data(seed)
    rows, V = used_rows(data), covariance(data, NOISE)
    whole = linalg.block_diag(*V)[np.ix_(rows, rows)]
    np.testing.assert_allclose(whole, dense_noise(data, NOISE), atol=1e-22, rtol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_marginal_likelihood_is_that_of_the_dense_gaussian(seed: int) -> None:
    data = random_data(seed)
    rows = used_rows(data)
    X = data.X.reshape(-1, data.X.shape[2])[rows]
    S = dense_noise(data, NOISE) + X / data.precision @ X.T
    expected = stats.multivariate_normal(cov=1e10 * S).logpdf(1e5 * data.r.ravel()[rows])
    expected += len(rows) * np.log(1e5)
    assert project(data, NOISE).marginal == pytest.approx(expected, rel=1e-9)
    prior = log_prior(data.stated, NOISE)[0]
    assert likelihood(data, NOISE)[0] == pytest.approx(-2 * expected + prior, rel=1e-9)


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_slope_is_that_of_finite_differences(seed: int, stated: bool) -> None:
    data, at, h = random_data(seed, stated=stated), NOISE.logs(), 1e-5
    slope = likelihood(data, NOISE)[1]
    for k, step in enumerate(h * np.eye(len(at))):
        up, down = (likelihood(data, NoiseValues.of_logs(at + s * step))[0] for s in (1, -1))
        assert slope[k] == pytest.approx((up - down) / (2 * h), rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("stated", [True, False])
def test_the_curvature_is_that_of_the_dense_gaussian(stated: bool) -> None:
    """tr P V_k P V_l with P dense but for what links configurations, which the fit's few columns
    make small; V_k by differences of the dense covariance."""
    data, at, h = random_data(3, stated=stated), NOISE.logs(), 1e-4
    data = replace(data, X=1e-9 * data.X)  # P = V⁻¹: configurations are independent
    rows = used_rows(data)
    inverse = np.linalg.inv(dense_noise(data, NOISE))
    both = [[NoiseValues.of_logs(at + s), NoiseValues.of_logs(at - s)] for s in h * np.eye(len(at))]
    parts = [(dense_noise(data, a) - dense_noise(data, b)) / (2 * h) for a, b in both]
    assert len(inverse) == len(rows)
    PV = [inverse @ V for V in parts]
    expected = np.array([[np.vdot(a.T, b) for b in PV] for a in PV])
    expected += prior_curvature(stated, data.G.shape[2])
    np.testing.assert_allclose(curved_likelihood(data, NOISE)[2], expected, rtol=1e-5, atol=1e-5)


def test_the_curvature_has_no_saddle_where_joints_explain_nearly_all() -> None:
    """One reading of three coordinates at each configuration, six joints, many columns fitted: a
    part that is left over as a difference of large ones would be negative."""
    blocks = Blocks.of(np.arange(60), np.arange(60), 3)
    data = random_data(5, blocks, p=30, joints=6)
    noise = NoiseValues(0.05, np.geomspace(3e-6, 3e-5, 6), np.full(6, 0.3))
    assert np.linalg.eigvalsh(curved_likelihood(data, noise)[2]).min() > 0


@pytest.mark.parametrize("corner", [False, True])
def test_a_climb_ends_where_the_value_is_least(corner: bool) -> None:
    """Of a function whose information is half its curvature along one axis, a limit in the way."""
    A = np.array([[3.0, 0.4, 0.0], [0.4, 2.0, 0.3], [0.0, 0.3, 8.0]])
    least = np.array([4.0, -1.0, 0.5])
    evaluations = 0

    def evaluate(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        nonlocal evaluations
        evaluations += 1
        d = x - least
        return float(d @ A @ d) / 2, A @ d, A - np.diag([0.0, 0.0, 4.0])

    upper = np.array([2.0 if corner else 10.0, 10.0, 10.0])
    found, ended = scored_climb(evaluate, np.zeros(3), np.full(3, -10.0), upper, 1e-10, 40)
    expected = least.copy()
    if corner:
        expected[0] = 2.0
        inner = A[1:, 1:], -A[1:, 0] * (2.0 - least[0])
        expected[1:] = least[1:] + np.linalg.solve(*inner)
    assert ended
    assert evaluations < 15
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize(("readings", "visits"), [(3, 3), (6, 1), (4, 2)])
def test_the_slope_is_right_for_many_visits_and_for_one(readings: int, visits: int) -> None:
    """Columns of the joints in all visits may be more than a configuration's rows, or fewer."""
    configuration = np.repeat(np.arange(9), readings)
    visit = np.concatenate([c * visits + np.arange(readings) % visits for c in range(9)])
    blocks = Blocks.of(configuration, visit, 3)
    data, h = random_data(7, blocks, p=4, joints=6), 1e-5
    at = NoiseValues(1.2, np.geomspace(3e-6, 3e-5, 6), np.full(6, 0.3)).logs()
    slope = likelihood(data, NoiseValues.of_logs(at))[1]
    for k, step in enumerate(h * np.eye(len(at))):
        up, down = (posterior(data, NoiseValues.of_logs(at + s * step)) for s in (1, -1))
        assert slope[k] == pytest.approx((up - down) / (2 * h), rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_another_prior_needs_no_other_weighting(seed: int) -> None:
    data = random_data(seed)
    at = Weighted.of(data, NOISE)
    for scale in (0.1, 1.0, 30.0):
        other = replace(data, precision=data.precision * scale)
        whole = project(other, NOISE)
        assert at.marginal(other.precision) == pytest.approx(whole.marginal, rel=1e-12)
        np.testing.assert_allclose(at.projection(other.precision).u, whole.u, rtol=1e-9)
    assert posterior(data, NOISE) == likelihood(data, NOISE)[0]


@pytest.mark.parametrize("seed", SEEDS)
def test_readings_left_out_count_as_if_they_were_never_made(seed: int) -> None:
    data = random_data(seed)
    fewer = kept_only(data)
    assert fewer.blocks.n < data.blocks.n
    for one, other in zip(likelihood(data, NOISE), likelihood(fewer, NOISE), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)
    rubbish = np.where(data.left_out, 1e3, data.r)
    assert likelihood(replace(data, r=rubbish), NOISE)[0] == likelihood(data, NOISE)[0]


@pytest.mark.parametrize("seed", SEEDS)
def test_the_projected_residual_is_the_weighted_residual_of_the_fit(seed: int) -> None:
    """u = P r with the dense P, and u = V⁻¹(r − Xβ̂) with the ridge solution β̂."""
    data, rows = random_data(seed), used_rows(random_data(seed))
    at = project(data, NOISE)
    X, r = data.X.reshape(-1, data.X.shape[2])[rows], data.r.ravel()[rows]
    inverse = np.linalg.inv(dense_noise(data, NOISE))
    M = X.T @ inverse @ X + np.diag(data.precision)
    beta = np.linalg.solve(M, X.T @ inverse @ r)
    u = inverse @ (r - X @ beta)
    np.testing.assert_allclose(at.u.ravel()[rows], u, rtol=1e-7, atol=1e-9 * np.abs(u).max())
    deviation = at.beta_deviation
    np.testing.assert_allclose(deviation.T @ deviation, np.linalg.inv(M), rtol=1e-7)
    np.testing.assert_allclose(at.beta, beta, rtol=1e-6)


@pytest.mark.parametrize("seed", SEEDS)
def test_residuals_to_be_flipped_scatter_as_the_noise_does(seed: int) -> None:
    """e_c = V_c^½ P_cc^−½ u_c, by scipy's matrix square roots, whose covariance is V_c."""
    data = random_data(seed)
    at = project(data, NOISE)
    for c, inverse in enumerate(at.inverse):
        P = inverse - at.H[c] @ at.H[c].T
        root = linalg.sqrtm(np.linalg.inv(inverse)).real
        e = root @ np.linalg.inv(linalg.sqrtm(P).real) @ at.u[c]
        np.testing.assert_allclose(at.scattered[c], e, rtol=1e-5, atol=1e-9)


def drawn(true_noise: NoiseValues, n: int, seed: int) -> NoisyData:
    """Readings of two or three markers in two visits to each of n configurations."""
    rng = np.random.default_rng(seed)
    count = rng.choice([4, 6], n)
    configuration = np.repeat(np.arange(n), count)
    visit = 2 * configuration + np.concatenate([np.arange(k) >= k // 2 for k in count])
    blocks = Blocks.of(configuration, visit, 3)
    base = random_data(seed, blocks, p=5, joints=len(true_noise.joint))
    base = replace(base, left_out=blocks.absent, precision=np.full(5, 1e-6))
    V = covariance(base, true_noise)
    noise = (np.linalg.cholesky(V) @ rng.normal(size=(*V.shape[:2], 1)))[..., 0]
    return replace(base, r=base.masked(noise + base.X @ rng.normal(size=5)))


@pytest.mark.parametrize(
    "true_noise",
    [
        NoiseValues(1.4, np.array([5e-6, 1.5e-5]), np.full(2, 0.6)),
        NoiseValues(0.7, np.array([1.2e-5, 8e-6]), np.full(2, 0.2)),
    ],
)
def test_the_noise_that_made_the_readings_is_found(true_noise: NoiseValues) -> None:
    """Nearly: 400 configurations tell the joints to a tenth, and what a joint does at each better
    than whether it does so at every visit."""
    found = fit_noise(drawn(true_noise, 400, 3))
    assert found.factor == pytest.approx(true_noise.factor, rel=0.05)
    np.testing.assert_allclose(found.joint, true_noise.joint, rtol=0.2)
    assert found.shared_by_all == pytest.approx(true_noise.shared_by_all, abs=0.35)
    both = (noise.joint * np.hypot(1, noise.shared) for noise in (found, true_noise))
    np.testing.assert_allclose(*both, rtol=0.15)


def test_some_configurations_are_as_if_the_others_had_not_been_measured() -> None:
    data = drawn(NOISE, 20, 4)
    others = np.arange(20) % 3 != 0
    left_out = data.left_out | others[:, None]
    alone = likelihood(data.every(3), NOISE)
    masked = likelihood(replace(data, left_out=left_out), NOISE)
    assert alone[0] == pytest.approx(masked[0], rel=1e-12)
    np.testing.assert_allclose(alone[1], masked[1], rtol=1e-9)


@pytest.mark.parametrize("n", [60, 400, 1100])
def test_the_noise_found_is_the_most_probable_one(n: int) -> None:
    """No search from it or from the true noise finds a twentieth of −2 log posterior more."""
    true_noise = NoiseValues(1.4, np.array([5e-6, 1.5e-5]), np.full(2, 0.6))
    data = drawn(true_noise, n, 3)
    best = fit_noise(data)
    for start in (best, true_noise):
        further = optimize.minimize(
            lambda t: likelihood(data, NoiseValues.of_logs(t)), start.logs(), jac=True,
            method="BFGS",
        )  # fmt: skip
        assert likelihood(data, best)[0] < further.fun + 0.05


def test_the_start_of_the_search_does_not_matter() -> None:
    data = drawn(NoiseValues(1.0, np.array([8e-6, 8e-6]), np.full(2, 0.3)), 60, 5)
    far = NoiseValues(2.5, np.array([1e-4, 1e-7]), np.full(2, 1.5))
    ends = [likelihood(data, fit_noise(data, start))[0] for start in (None, far)]
    assert ends[0] == pytest.approx(ends[1], abs=0.05)


@pytest.mark.parametrize("n", [1, 64, 65, 131])
def test_the_inverse_of_a_triangle_is_one(n: int) -> None:
    L = np.tril(np.random.default_rng(n).normal(size=(n, n)) / n) + np.eye(n)
    found = inverse_triangle(L)
    np.testing.assert_allclose(found @ L, np.eye(n), atol=1e-12)
    assert not np.triu(found, 1).any()


@pytest.mark.parametrize("n", [1, 4, 30])
def test_a_step_within_bounds_is_that_of_bounded_least_squares(n: int) -> None:
    """Bounds through the start among them, and curvatures that differ by orders."""
    rng = np.random.default_rng(n)
    for _ in range(20):
        B = rng.normal(size=(n + 2, n)) * 10 ** rng.uniform(-2, 2, n)
        H, slope = B.T @ B + 1e-6 * np.eye(n), 10 * rng.normal(size=n)
        low = -rng.uniform(0.1, 1.5, n) * (rng.random(n) > 0.2)
        high = low + rng.uniform(0.2, 1.5, n)
        root = linalg.cholesky(H)
        target = -linalg.solve_triangular(root, slope, trans="T")
        expected = optimize.lsq_linear(root, target, (low, high), method="bvls", tol=1e-13).x
        found = least_within(H, slope, low, high)
        assert (found >= low).all() and (found <= high).all()
        values = [slope @ s + s @ H @ s / 2 for s in (found, expected)]
        assert values[0] == pytest.approx(values[1], rel=1e-9)


def test_a_stated_drift_is_noise_that_readings_have_in_common_by_their_times() -> None:
    """Its waves and what changes faster, common to a visit, make drift² exp(−|t − t′|/lasting)."""
    size, lasting = 40e-6, 900.0
    model, table = campaign(n=12)
    visit = visits(table)
    table = replace(table, time=60.0 * visit)
    noise = Unsteadiness(drift=size, lasting=lasting)
    stated = Model.assembled(model.chain, replace(model.cell, noise=noise))
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
    expected = (
        size**2 * np.exp(-np.abs(when[:, None] - when) / lasting)[..., None, None] * np.eye(3)
    )
    same = own_visit[:, None] == own_visit
    np.testing.assert_allclose(found[same], expected[same], atol=1e-9 * size**2)
    assert np.abs(found - expected).max() < 0.1 * size**2
