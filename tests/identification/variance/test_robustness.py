"""Tables at the edge: perfect, tiny, lopsided, large."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from identification.variance.dense import Table, readings

from elastocal.errors import InputError
from elastocal.identification.noise_choice import estimate_noise, settle
from elastocal.identification.noise_structure import Readings, noise_models

BASE = Table(configurations=9, markers=3, repeats=4, unbalanced=False)


def finite(found):
    assert np.isfinite(found.x).all()
    assert np.isfinite(found.covariance.matrix).all()
    assert (np.diag(found.covariance.matrix) >= 0).all()
    assert not np.isnan(found.covariance.dof).any()
    assert np.isfinite(found.fit.state.theta).all()
    assert np.isfinite(found.fit.log_likelihood)


@pytest.mark.parametrize("kind", noise_models())
def test_perfect_data(kind):
    """Residuals of exactly zero: the estimate is exact, its deviations next to nothing."""
    r = readings(BASE, 0)
    found = settle(r.moved(0 * r.e), kind)
    finite(found.noise)
    assert found.good.all()
    np.testing.assert_array_equal(found.noise.x, 0)
    assert found.noise.covariance.std.max() < 1e-30


@pytest.mark.parametrize("spare", [1, 2, 5, 8])
def test_parameters_nearly_as_many_as_rows(spare):
    r = readings(Table(configurations=10, markers=1, repeats=1, p=30 - spare, unbalanced=False), 1)
    found = settle(r)
    finite(found.noise)
    assert found.noise.covariance.dof.max() <= spare * (1 + 1e-6)


@pytest.mark.parametrize("kind", ["auto", "axis+configuration", "groups"])
def test_dependent_columns_are_named(kind):
    r = readings(BASE, 0)
    B = np.concatenate([r.B, r.B[:, :, :1] + 2 * r.B[:, :, 1:2]], axis=2)
    with pytest.raises(InputError, match=r"columns \[\d\] of B depend on the others"):
        estimate_noise(replace(r, B=B), kind)


@pytest.mark.parametrize("name", ["B", "e"])
def test_numbers_must_be_finite(name):
    r = readings(BASE, 0)
    values = getattr(r, name).copy()
    values.flat[7] = np.nan
    with pytest.raises(InputError, match="must be finite"):
        estimate_noise(replace(r, **{name: values}))


@pytest.mark.parametrize("seed", range(4))
def test_an_effect_that_the_parameters_explain_is_left_out(seed):
    """A free offset per configuration: what a configuration shares cannot be told from it, and
    the estimate is that without shared effects."""
    r = readings(replace(BASE, configurations=4, markers=1), seed, shared=5e-5)
    B = np.zeros((len(r), 3, 12))
    for c in range(4):
        B[r.configuration == c, :, 3 * c : 3 * c + 3] = np.eye(3)
    r = replace(r, B=B @ np.random.default_rng(seed).normal(size=(12, 12)))
    found = estimate_noise(r, "independent+configuration")
    plain = estimate_noise(r, "independent")
    assert not found.fit.common.any()
    assert found.fit.converged
    np.testing.assert_allclose(found.x, plain.x, rtol=1e-8)
    np.testing.assert_allclose(found.covariance.std, plain.covariance.std, rtol=1e-8)


def large(configurations, markers, repeats, p, seed=0):
    rng = np.random.default_rng(seed)
    c, m, _ = np.indices((configurations, markers, repeats)).reshape(3, -1)
    B = rng.normal(size=(configurations, markers, 3, p))[c, m]
    common = rng.normal(size=(configurations, 3))[c]
    e = 1e-5 * rng.normal(size=(len(c), 3)) * [1, 2, 3] + 2e-5 * (markers > 1) * common
    return Readings(B, e, c, 0 * c, m)


@pytest.mark.long
@pytest.mark.parametrize(
    ("table", "kind"),
    [((20000, 1, 1, 46), "axis"), ((1000, 4, 5, 46), "axis+configuration")],
)
def test_twenty_thousand_readings(table, kind):
    r = large(*table)
    tracemalloc.start()
    found = settle(r)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3e9
    finite(found.noise)
    assert found.noise.kind == kind
