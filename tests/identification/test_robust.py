"""Robust fits against statsmodels and a cone solver, and the majority of the readings."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest
import statsmodels.api as sm
from scipy import integrate, stats

from elastocal.identification.outliers import HUBER, L1, HuberFit, majority


@pytest.mark.parametrize("size", range(1, 7))
def test_constants_are_95_percent_efficient(size):
    """By quadrature over the density of χ(size): the efficiency a²/b, with a by Stein's identity
    E div Ψ = E r·Ψ, which needs no derivative of ψ."""
    c = HUBER[size - 1]

    def mean(g):
        parts = [(0, c), (c, 20)]
        values = (integrate.quad(lambda d: g(d) * stats.chi.pdf(d, size), *part) for part in parts)
        return sum(value for value, _ in values)

    a = mean(lambda d: np.minimum(d, c) * d) / size
    b = mean(lambda d: np.minimum(d, c) ** 2) / size
    assert a**2 / b == pytest.approx(0.95, abs=1e-8)


def test_estimate_scale_and_covariance_are_those_of_statsmodels():
    """Columns scaled to unit length for statsmodels, whose pseudo-inverse needs that."""
    rng = np.random.default_rng(1)
    B = rng.normal(size=(120, 4)) * 10.0 ** rng.uniform(-6, 3, 4)
    unit = np.linalg.norm(B, axis=0)
    y = B @ (rng.normal(size=4) / unit) + 0.1 * rng.standard_t(2.5, size=120)
    theirs = sm.RLM(y, B / unit, M=sm.robust.norms.HuberT(1.345))
    reference = theirs.fit(cov="H1", tol=1e-13, maxiter=2000)
    found = HuberFit(B, y, 1, c=1.345)
    np.testing.assert_allclose(found.x * unit, reference.params, rtol=1e-8)
    assert found.scale == pytest.approx(reference.scale, rel=1e-8)
    scaled = found.covariance().matrix * np.outer(unit, unit)
    np.testing.assert_allclose(scaled, reference.bcov_scaled, rtol=1e-8, atol=1e-14)


@pytest.mark.parametrize("size", [2, 3])
def test_the_sum_of_lengths_is_the_cone_programs_optimum(size):
    rng = np.random.default_rng(size)
    B = rng.normal(size=(40 * size, 5))
    y = B @ np.ones(5) + rng.standard_t(2, size=40 * size)
    x = cp.Variable(5)
    lengths = [cp.norm(y[k : k + size] - B[k : k + size] @ x) for k in range(0, len(y), size)]
    problem = cp.Problem(cp.Minimize(cp.sum(cp.hstack(lengths))))
    problem.solve(solver=cp.CLARABEL)
    found = HuberFit(B, y, size, L1)
    total = np.linalg.norm(found.residual.reshape(-1, size), axis=1).sum()
    assert total <= problem.value * (1 + 1e-6)
    np.testing.assert_allclose(found.x, x.value, atol=1e-4)


def test_blunders_that_agree_on_another_answer_at_leverage_points():
    """15 configurations at five levels, 3 markers, 6 repeats; the first five columns are seen at
    one level each.  30 % of the readings lie ten times as far out and fit another x exactly.  The
    other 70 % alone have √(1/0.7) times the standard deviations; 9 parameters stay below 4.5 of
    those with a probability above 0.999; least squares is off by tens."""
    rng = np.random.default_rng(2013)
    configuration, marker = np.repeat(np.arange(15), 18), np.tile(np.repeat(np.arange(3), 6), 15)
    pose = rng.normal(size=(15, 1, 3, 9)) + 0.5 * rng.normal(size=(15, 3, 3, 9))
    B, true = pose[configuration, marker], rng.normal(size=9)
    B[:, :, :5] *= (configuration[:, None] // 3 == np.arange(5))[:, None, :]
    std = np.sqrt(np.diag(np.linalg.inv(np.einsum("nik,nil->kl", B, B))))
    y, bad = B @ true + rng.normal(size=(270, 3)), rng.permutation(270) < 81
    B[bad] *= 10
    y[bad] = B[bad] @ (true + 100)
    good, variance = majority(B, y)
    x = np.linalg.lstsq(B[good].reshape(-1, 9), y[good].ravel())[0]
    assert not good[bad].any() and good.mean() > 0.65
    assert np.abs((x - true) / std).max() < 4.5 * np.sqrt(1 / 0.7)
    assert variance == pytest.approx(1.0, abs=0.2)
