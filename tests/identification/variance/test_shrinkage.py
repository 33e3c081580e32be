"""The prior of group variances finds what was simulated, and shrinking pays."""

import numpy as np
import pytest
from identification.variance.dense import Table, readings

from elastocal.errors import InsufficientDataError
from elastocal.identification.noise_structure import Readings, by_group
from elastocal.identification.reml import (
    NARROWEST,
    LogPrior,
    evaluate,
    prior_of_groups,
    reml,
    stacks,
)

MEAN = 2 * np.log([1e-5, 2e-5, 6e-5])


def groups(configurations, each, omega_u, omega_v, seed, p=2):
    """Readings in many groups, log θ = μ_a + u_c + v_ca; log θ (configurations, 3)."""
    rng = np.random.default_rng(seed)
    log = MEAN + np.sqrt(omega_u) * rng.normal(size=(configurations, 1))
    log = log + np.sqrt(omega_v) * rng.normal(size=(configurations, 3))
    c = np.repeat(np.arange(configurations), each)
    e = np.exp(log[c] / 2) * rng.normal(size=(len(c), 3))
    marker = np.tile(np.arange(each), configurations)
    return Readings(rng.normal(size=(len(c), 3, p)), e, c, 0 * c, marker), log


@pytest.mark.parametrize(("omega_u", "omega_v"), [(0.6, 0.3), (0.0, 0.8), (1.0, 0.0)])
def test_hyperparameters_are_recovered(omega_u, omega_v):
    """On 600 configurations of 10: four standard errors are 0.14, 0.15 and 0.05."""
    r, _ = groups(600, 10, omega_u, omega_v, 0)
    structure = by_group(r)
    prior = prior_of_groups(structure, structure.sets.e)
    np.testing.assert_allclose(prior.mean[:3], MEAN, atol=0.15)
    block = np.linalg.inv(prior.precision[:3, :3])
    assert block[0, 1] == pytest.approx(omega_u, abs=0.2)
    assert block[0, 0] - block[0, 1] == pytest.approx(max(omega_v, NARROWEST), abs=0.08)
    assert not prior.precision[:3, 3:].any()


def test_shrunk_variances_are_nearer_the_truth():
    """Mean square error of log θ on 18 groups of 6 readings: less than half of the plain one."""
    shrunk, plain = 0.0, 0.0
    for seed in range(10):
        r, log = groups(15, 6, 0.2, 0.1, seed)
        structure = by_group(r)
        prior = prior_of_groups(structure, structure.sets.e)
        fit = reml(structure, (), prior, np.exp(prior.mean))
        free = reml(structure, (), None, np.exp(prior.mean))
        assert fit.converged and free.converged
        shrunk += ((np.log(fit.own) - log.ravel()) ** 2).mean()
        plain += ((np.log(free.own) - log.ravel()) ** 2).mean()
    assert shrunk < 0.5 * plain


def test_marginal_likelihood_is_the_integral_over_the_prior():
    """Laplace's value against quadrature where one log variance is unknown.

    With f degrees of freedom in s², ∫ p(s² | θ) N(log θ; μ, ω) d log θ is one-dimensional; the
    other groups have their variances fixed by a narrow prior.
    """
    r, _ = groups(4, 12, 0.0, 0.0, 1)
    structure = by_group(r)
    K = len(structure.names)
    mean = np.tile(MEAN, 4)
    precision = np.diag(np.full(K, 1e8))
    precision[0, 0] = 1 / 0.5
    found = reml(structure, (), LogPrior(mean, precision), np.exp(mean))
    stacked = stacks(structure, ())
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    values = []
    for node in nodes:
        theta = np.exp(mean)
        theta[0] = np.exp(mean[0] + np.sqrt(0.5) * node)
        values.append(evaluate(structure, stacked, theta).log_likelihood)
    top = max(values)
    integral = top + np.log(weights @ np.exp(np.array(values) - top) / np.sqrt(2 * np.pi))
    # Laplace with the expected curvature of 11 degrees of freedom is off by a few hundredths.
    assert found.log_likelihood == pytest.approx(integral, abs=0.1)


def test_too_few_readings_to_shrink_are_refused():
    r = readings(Table(configurations=8, markers=1, repeats=2, unbalanced=False), 0)
    structure = by_group(r)
    with pytest.raises(InsufficientDataError, match="repeat readings, or choose another"):
        prior_of_groups(structure, structure.sets.e)
