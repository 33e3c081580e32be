"""M-estimates agree with independent solvers."""

import cvxpy as cp
import numpy as np
import pytest
import statsmodels.api as sm
from scipy import optimize
from scipy.spatial.transform import Rotation

from elastocal.identification.robust import covariance_of, huber, least_absolute


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


@pytest.mark.parametrize("fit", [huber, least_absolute], ids=["huber", "l1"])
def test_the_axes_of_a_reading_do_not_matter(arm, fit):
    """Each reading turned by its own rotation, as another tracker frame would: same x, weights."""
    rng = np.random.default_rng(9)
    y = arm.observed(arm.errors(rng, 0.1)[0])
    turn = Rotation.random(270, random_state=1).as_matrix()
    B2 = (turn @ arm.B.reshape(270, 3, 9)).reshape(-1, 9)
    y2 = (turn @ y.reshape(270, 3, 1)).ravel()
    one, two = fit(arm.B, y, 3), fit(B2, y2, 3)
    np.testing.assert_allclose(one.x, two.x, atol=1e-7)
    np.testing.assert_allclose(one.weights, two.weights, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_l1_is_the_linear_programs_optimum(seed):
    """The primal program, Σ(u + v) with Bx + u − v = y."""
    B, y = regression(seed, n=80)
    unit = np.linalg.norm(B, axis=0)
    n, p = B.shape
    cost = np.concatenate([np.zeros(p), np.ones(2 * n)])
    equations = np.hstack([B / unit, np.eye(n), -np.eye(n)])
    bounds = [(None, None)] * p + [(0, None)] * (2 * n)
    lp = optimize.linprog(cost, A_eq=equations, b_eq=y, bounds=bounds)
    found = least_absolute(B, y, 1)
    assert np.abs(found.residual).sum() == pytest.approx(lp.fun, rel=1e-5)
    np.testing.assert_allclose(found.x * unit, lp.x[:p], atol=1e-3 * found.scale)
    assert found.converged
    assert (found.distance < 1e-3).sum() == p  # a vertex


@pytest.mark.parametrize("size", [2, 3])
def test_the_sum_of_lengths_is_the_cone_programs_optimum(size):
    rng = np.random.default_rng(size)
    B = rng.normal(size=(40 * size, 5))
    y = B @ np.ones(5) + rng.standard_t(2, size=40 * size)
    x = cp.Variable(5)
    lengths = [cp.norm(y[k : k + size] - B[k : k + size] @ x) for k in range(0, len(y), size)]
    problem = cp.Problem(cp.Minimize(cp.sum(cp.hstack(lengths))))
    problem.solve(solver=cp.CLARABEL)
    found = least_absolute(B, y, size)
    total = np.linalg.norm(found.residual.reshape(-1, size), axis=1).sum()
    assert total <= problem.value * (1 + 1e-6)
    np.testing.assert_allclose(found.x, x.value, atol=1e-4)
    assert found.converged
