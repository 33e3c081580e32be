"""The profile interval of where a line crosses zero is Fieller's set (1954), in closed form."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import sparse, stats

from elastocal.identification.knowledge import Bounds, Constraints
from elastocal.identification.least_squares import KnownFit, PriorRows, Problem, fit, profile_end
from elastocal.identification.weighted_problem import Weights
from elastocal.model.manipulator import Regression
from elastocal.model.observations import Observations

X = np.linspace(-1, 2, 12)
F = stats.f.ppf(0.95, 1, 10)
TABLE = SimpleNamespace(source="data")


class Crossing:
    """y = b (x − θ), which stands in the fit in the place of an arm: parameters θ and b."""

    names = ("theta", "b")
    shrunk = np.zeros(2, dtype=bool)

    def predict(self, table, x, observed):
        return x[1] * (X - x[0])

    def regressor(self, table, x, columns, observed):
        B = np.column_stack([np.full(12, -x[1]), X - x[0]])
        return Regression(B[:, columns], self.predict(table, x, observed), observed)


def line(seed, slope):
    return 0.8 + slope * X + 0.3 * np.random.default_rng(seed).normal(size=12)


def profile(y, constraints=()):
    """θ, and the ends of its 95 % interval."""
    (b1, b0), (rss,), *_ = np.polyfit(X, y, 1, full=True)
    observed = Observations("distance", y, sparse.eye_array(12, format="csr"), np.arange(12), TABLE)
    start = np.array([-b0 / b1, b1])
    weights = Weights("none", None, False, "")
    problem = Problem(Crossing(), observed, weights, start, np.arange(2)), np.arange(2)
    sigma = float(np.sqrt(rss / 10))
    stated = Crossing.names, np.arange(2), start, Constraints(constraints), None, sigma
    known = PriorRows.stated(*stated)
    found = KnownFit(fit(*problem, start, np.ones(2), known=known), known, sigma)
    return found.fit.x[0], [profile_end(found, 0, F * sigma**2, side) for side in (-1, 1)]


def fieller(y):
    """(b₀ + θ b₁)² ≤ F (v₀₀ + 2θ v₀₁ + θ² v₁₁)"""
    B = np.column_stack([np.ones(12), X])
    (b0, b1), (rss,), *_ = np.linalg.lstsq(B, y)
    v = np.linalg.inv(B.T @ B) * F * rss / 10
    return np.sort(np.roots([b1**2 - v[1, 1], 2 * (b0 * b1 - v[0, 1]), b0**2 - v[0, 0]]))


def test_equals_fieller():
    y = line(3, 0.8)
    theta, ends = profile(y)
    np.testing.assert_allclose(ends, fieller(y), rtol=1e-5)
    assert not np.isclose(sum(ends) / 2, theta, rtol=0.02)


def test_a_flat_side_is_unbounded():
    """A slope that may be zero: the set is the outside of its roots."""
    y = line(1, 0.12)
    theta, ends = profile(y)
    roots = fieller(y)
    assert np.iscomplexobj(roots) or theta < roots[0] or theta > roots[1]
    assert np.isinf(ends).any()


def test_bounds_end_the_interval():
    y = line(3, 0.8)
    low = fieller(y)[0] / 2 + profile(y)[0] / 2
    _, ends = profile(y, (Bounds("theta", low),))
    assert ends == pytest.approx([low, fieller(y)[1]], rel=1e-5)
