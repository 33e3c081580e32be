"""Huber's estimate agrees with an independent solver, whatever the axes."""

import numpy as np
import pytest
import statsmodels.api as sm
from scipy.spatial.transform import Rotation

from elastocal.identification.robust import covariance_of, huber


def regression(seed, n=120, p=4):
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(n, p)) * 10.0 ** rng.uniform(-6, 3, p)
    x = rng.normal(size=p) / np.linalg.norm(B, axis=0)
    return B, B @ x + 0.1 * rng.standard_t(2.5, size=n)


def test_estimate_scale_and_covariance_are_those_of_statsmodels():
    """Columns scaled to unit length for statsmodels, whose pseudo-inverse needs that."""
    B, y = regression(1)
    unit = np.linalg.norm(B, axis=0)
    theirs = sm.RLM(y, B / unit, M=sm.robust.norms.HuberT(1.345))
    reference = theirs.fit(cov="H1", tol=1e-13, maxiter=2000)
    found = huber(B, y, 1, c=1.345)
    np.testing.assert_allclose(found.x * unit, reference.params, rtol=1e-8)
    assert found.scale == pytest.approx(reference.scale, rel=1e-8)
    scaled = covariance_of(found, B).matrix * np.outer(unit, unit)
    np.testing.assert_allclose(scaled, reference.bcov_scaled, rtol=1e-8, atol=1e-14)


def test_the_axes_of_a_reading_do_not_matter(arm):
    """Each reading turned by its own rotation, as another tracker frame would: same x, weights."""
    rng = np.random.default_rng(9)
    y = arm.observed(arm.errors(rng, 0.1)[0])
    turn = Rotation.random(270, random_state=1).as_matrix()
    B2 = (turn @ arm.B.reshape(270, 3, 9)).reshape(-1, 9)
    y2 = (turn @ y.reshape(270, 3, 1)).ravel()
    one, two = huber(arm.B, y, 3), huber(B2, y2, 3)
    np.testing.assert_allclose(one.x, two.x, atol=1e-7)
    np.testing.assert_allclose(one.weights, two.weights, rtol=1e-5, atol=1e-8)
