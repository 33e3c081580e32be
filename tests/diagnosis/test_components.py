"""Many causes at once: the likelihood of a sum, what each earns, lines, shares, and answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from support.diagnosis_data import campaign
from support.noisy_data import dense_noise, random_data, used_rows

from elastocal.diagnosis.baseline import NoiseValues, NoisyData, fit_baseline
from elastocal.diagnosis.component_families import component_of
from elastocal.diagnosis.components import Component, FittedSum, Sizes, fit_sum, posed
from elastocal.diagnosis.diagnosis_data import diagnosis_data_of
from elastocal.diagnosis.evidence import Item
from elastocal.diagnosis.hypotheses import possible
from elastocal.model.effects.geometry import EncoderScale
from elastocal.model.effects.smooth import JointCurve, Waves

Array = np.ndarray
NOISE = NoiseValues(1.1, np.array([2e-6, 4e-6, 3e-6]), np.full(3, 0.4))


def component(data: NoisyData, seed: int, k: int, smooth: bool = False) -> Component:
    """Random columns that move the readings by some 1e-5 m."""
    rng = np.random.default_rng((seed, 11))
    columns = 1e-5 * rng.normal(size=(*data.r.shape, k))
    if not smooth:
        return Component("angle", EncoderScale(), f"joint{seed}", columns, fellows=8)
    waves = Waves(0.0, np.arange(1.0, k // 2 + 1))
    return Component(
        "angle", JointCurve(), f"joint{seed}", columns, waves=waves, lengths=(-2.0, 1.0)
    )


def some(seed: int = 3) -> tuple[NoisyData, list[Component], Sizes]:
    data = random_data(seed)
    components = [component(data, 1, 2), component(data, 2, 6, smooth=True), component(data, 3, 1)]
    sizes = Sizes(0.2, np.array([0.3, -0.4, 0.1]), np.array([0.0, -0.7, 0.0]))
    return data, components, sizes


def rows_of(data: NoisyData, packed: Array) -> Array:
    return packed.reshape(-1, packed.shape[2])[used_rows(data)]


def dense(data: NoisyData, components: list[Component], at: Sizes) -> Array:
    """The covariance of all readings, the data's own columns integrated out too."""
    V = np.exp(2 * at.factor) * dense_noise(data, NOISE)
    X = rows_of(data, data.X)
    V += X @ np.diag(1 / data.precision) @ X.T
    for c, s, length in zip(components, at.size, at.length, strict=True):
        C = rows_of(data, c.columns)
        V += C @ np.diag(np.exp(2 * s) * c.shares(length)[0]) @ C.T
    return V


def test_the_likelihood_is_that_of_a_normal_distribution() -> None:
    data, components, at = some()
    problem = posed(data, components, NOISE)
    r = data.r.ravel()[used_rows(data)]
    expected = multivariate_normal(np.zeros(len(r)), dense(data, components, at)).logpdf(r)
    assert -problem.factored(at)[1] / 2 == pytest.approx(expected, abs=1e-6)


def test_the_information_is_the_average_of_the_dense_gaussian() -> None:
    """rᵀPV_iPV_jPr and the prior's curvatures; V_i by differences of the dense covariance."""
    data, components, at = some()
    theta, K, h = np.concatenate([[at.factor], at.size, at.length]), len(components), 1e-5

    def covariance(theta: Array) -> Array:
        return dense(data, components, Sizes(theta[0], theta[1 : K + 1], theta[K + 1 :]))

    inverse = np.linalg.inv(covariance(theta))
    u = inverse @ data.r.ravel()[used_rows(data)]
    moved = [(covariance(theta + s) - covariance(theta - s)) @ u / (2 * h)
             for s in h * np.eye(len(theta))]  # fmt: skip
    expected = np.array([[a @ inverse @ b for a in moved] for b in moved])
    problem = posed(data, components, NOISE)
    expected[1 : K + 1, 1 : K + 1] += 2 * problem.pool.precision
    expected[0, 0] += 8.0 if data.stated else 0.0
    np.testing.assert_allclose(problem.objective(theta)[2], expected, rtol=1e-5, atol=1e-5)


def test_a_compliance_below_zero_is_no_cause() -> None:
    """Evidence of a half Gaussian: of what is positive twice as much, of what is not next to none,
    and so it is not in the sum."""
    h = next(h for h in possible(*campaign(n=20))[0] if h.effect.name == "base_compliance")
    data = random_data(5, p=2)
    unit = np.tile(1e-14 * np.eye(data.r.shape[1]), (len(data.r), 1, 1))
    data = replace(data, left_out=data.left_out & False, covariance=unit)
    free, quiet = component(data, 1, 1), NOISE.of_instrument()
    half = replace(free, hypothesis=replace(h, parameters=h.parameters[:1]))
    assert half.bounded.tolist() == [0] and not free.bounded.any()
    noise = 1e-7 * np.random.default_rng(7).normal(size=data.r.shape)

    def sums(w: float) -> list[FittedSum]:
        read = replace(data, r=w * free.columns[..., 0] + noise)
        return [fit_sum(read, [c], quiet, refit_noise=False) for c in (free, half)]

    (either, positive), (negative, none) = sums(1.0), sums(-1.0)
    assert positive.score - either.score == pytest.approx(np.log(2), abs=1e-6)
    assert positive.earned[0] - either.earned[0] == pytest.approx(np.log(2), abs=1e-6)
    assert negative.components and not none.components


def test_what_was_found_at_settings_of_its_own_costs_its_search() -> None:
    """As many nats as there are values that it could have had."""
    model, table = campaign("gear_eccentricity:joint4", n=20)
    base, hypotheses = fit_baseline(model, table), possible(model, table)[0]
    h = next(h for h in hypotheses if h.key == ("gear_ripple", "joint5"))
    dataset = diagnosis_data_of(base, [h])
    grid = dataset.grids[h.key]
    k = int(np.argmin(grid.log_prior))
    found = component_of(dataset, Item(h, grid.values[k], 0.0))
    assert found.search == -grid.log_prior[k] > np.log(10)
