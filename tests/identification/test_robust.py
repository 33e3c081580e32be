"""Robust fits, the majority and the report of faulty readings, on a problem like the arm's."""

from __future__ import annotations

from dataclasses import dataclass

import cvxpy as cp
import numpy as np
import pytest
import statsmodels.api as sm
from scipy import integrate, stats

from elastocal.identification.outliers import (
    HUBER,
    L1,
    covariance_of,
    huber,
    majority,
)


@dataclass(frozen=True)
class ArmLike:
    """y = B x + noise of unit variance; the first five columns are seen at one level each."""

    B: np.ndarray  # (810, 9)
    x: np.ndarray
    configuration: np.ndarray  # (270,)
    marker: np.ndarray
    size: int = 3

    @property
    def n(self) -> int:
        return len(self.configuration)

    def errors(self, rng, share=0.0, low=1.0, high=10.0):
        """Unit noise (n, 3); a share of the readings off by `low` to `high` in each component,
        in units where the noise is 1, and which ones."""
        noise = rng.normal(size=(self.n, 3))
        bad = rng.permutation(self.n)[: round(share * self.n)]
        sign = rng.choice([-1.0, 1.0], (len(bad), 3))
        noise[bad] += sign * rng.uniform(low, high, (len(bad), 3))
        return noise, bad

    def observed(self, noise):
        return self.B @ self.x + noise.ravel()


@pytest.fixture(scope="module")
def arm() -> ArmLike:
    """15 configurations at five levels, 3 markers, 6 repeats: 270 readings, 9 columns.

    Lengths are in units of the noise: 10 µm, so that 1 to 10 mm are 100 to 1000.
    """
    rng = np.random.default_rng(2013)
    configuration = np.repeat(np.arange(15), 18)
    marker = np.tile(np.repeat(np.arange(3), 6), 15)
    pose = rng.normal(size=(15, 1, 3, 9)) + 0.5 * rng.normal(size=(15, 3, 3, 9))
    B = pose[configuration, marker]
    level = configuration // 3
    B[:, :, :5] *= (level[:, None] == np.arange(5))[:, None, :]
    return ArmLike(B.reshape(-1, 9), rng.normal(size=9), configuration, marker)


# Huber and the sum of lengths.


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
    found = huber(B, y, 1, c=1.345)
    np.testing.assert_allclose(found.x * unit, reference.params, rtol=1e-8)
    assert found.scale == pytest.approx(reference.scale, rel=1e-8)
    scaled = covariance_of(found, B).matrix * np.outer(unit, unit)
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
    found = huber(B, y, size, L1)
    total = np.linalg.norm(found.residual.reshape(-1, size), axis=1).sum()
    assert total <= problem.value * (1 + 1e-6)
    np.testing.assert_allclose(found.x, x.value, atol=1e-4)
    assert found.converged


# The majority and the report.


def test_blunders_that_agree_on_another_answer_at_leverage_points(arm):
    """30 % of the readings lie ten times as far out and fit another x exactly.  The other 70 %
    alone have √(1/0.7) times the standard deviations; 9 parameters stay below 4.5 of those with a
    probability above 0.999; least squares is off by tens."""
    rng = np.random.default_rng(0)
    y = arm.observed(arm.errors(rng)[0])
    bad = rng.permutation(270) < 81
    rows = np.repeat(bad, 3)
    B = np.where(rows[:, None], 10 * arm.B, arm.B)
    y[rows] = (B @ (arm.x + 100))[rows]
    good, variance = majority(B.reshape(270, 3, -1), y.reshape(270, 3))
    x = np.linalg.lstsq(B[np.repeat(good, 3)], y[np.repeat(good, 3)])[0]
    std = np.sqrt(np.diag(np.linalg.inv(arm.B.T @ arm.B)))
    assert not good[bad].any() and good.mean() > 0.65
    assert np.abs((x - arm.x) / std).max() < 4.5 * np.sqrt(1 / 0.7)
    assert variance == pytest.approx(1.0, abs=0.2)
