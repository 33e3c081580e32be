"""Profile-likelihood intervals: exact cases (t, transformed t, Fieller), ends, a real model."""

import numpy as np
import pytest
from scipy import stats

from elastocal.errors import ElastocalError
from elastocal.identification.intervals import profile_interval


def least(B, y):
    """(x, rss) of the least-squares fit."""
    x = np.linalg.lstsq(B, y, rcond=None)[0]
    return x, float(np.sum((y - B @ x) ** 2))


def line(seed, slope=1.0, n=12):
    rng = np.random.default_rng(seed)
    B = np.column_stack([np.ones(n), np.linspace(-1, 2, n)])
    return B, B @ [0.8, slope] + 0.3 * rng.normal(size=n)


@pytest.mark.parametrize("level", [0.5, 0.999])
def test_a_linear_model_has_its_t_interval(level):
    B, y = line(0)
    x, rss = least(B, y)

    def objective(value):
        return least(B[:, :1], y - value * B[:, 1])[1]

    std = np.sqrt(rss / 10 * np.linalg.inv(B.T @ B)[1, 1])
    half = stats.t.ppf((1 + level) / 2, 10) * std
    found = profile_interval(objective, x[1], 1.7 * std, 10, level)  # std only sets the scale
    np.testing.assert_allclose(found, [x[1] - half, x[1] + half], atol=1e-5 * half)


def test_follows_any_transformation():
    """A stiffness is the reciprocal of a compliance, and so is its interval; far from symmetric."""

    def objective(compliance):
        return 5.0 + ((compliance - 1.0) / 0.3) ** 2

    direct = profile_interval(objective, 1.0, 0.3, 5)
    lower, upper = profile_interval(lambda k: objective(1 / k), 1.0, 0.3, 5)
    assert upper - 1 > 2 * (1 - lower)
    np.testing.assert_allclose([1 / upper, 1 / lower], direct, rtol=1e-5)


def ratio(seed, slope):
    """Where a line crosses zero, θ = −b₀/b₁, by its profile, and Fieller's set (low, high)."""
    B, y = line(seed, slope)
    (b0, b1), rss = least(B, y)
    s2, v = rss / 10, np.linalg.inv(B.T @ B)
    F = stats.f.ppf(0.95, 1, 10) * s2
    # (b₀ + θ b₁)² ≤ F (v₀₀ + 2θ v₀₁ + θ² v₁₁)
    roots = np.roots([b1**2 - F * v[1, 1], 2 * (b0 * b1 - F * v[0, 1]), b0**2 - F * v[0, 0]])
    theta = -b0 / b1
    gradient = np.array([-1 / b1, b0 / b1**2])
    std = np.sqrt(s2 * gradient @ v @ gradient)

    def objective(value):
        return least((B[:, 1] - value)[:, None], y)[1]

    return profile_interval(objective, theta, std, 10), np.sort(roots), theta


def test_equals_fieller():
    """The profile interval of a ratio is Fieller's (1954), in closed form."""
    found, fieller, theta = ratio(3, slope=0.8)
    np.testing.assert_allclose(found, fieller, rtol=1e-5)
    assert not np.isclose(fieller.sum() / 2, theta, rtol=0.02)


def test_a_flat_side_is_unbounded():
    """A slope that may be zero: Fieller's set is the outside of its roots, so one side of the
    crossing runs to infinity."""
    found, fieller, theta = ratio(1, slope=0.12)
    assert np.iscomplexobj(fieller) or theta < fieller[0] or theta > fieller[1]
    assert np.isinf(found).any()


def parabola(value):
    return 10.0 + (value - 1.0) ** 2


def test_bounds_end_the_interval():
    t = stats.t.ppf(0.975, 10)
    lower, upper = profile_interval(parabola, 1.0, 1.0, 10, lower=0.5, upper=1 + 2 * t)
    assert lower == 0.5 and upper == pytest.approx(1 + t, abs=1e-5)
    assert profile_interval(parabola, 1.0, 1.0, 10, lower=1.0)[0] == 1.0


@pytest.mark.parametrize("fails", ["raises", "infinite"])
def test_where_no_fit_exists_the_interval_ends(fails):
    """Also far below the quantile, and without disturbing a crossing on the other side."""

    def objective(value):
        if value > 1.6:
            if fails == "raises":
                raise ElastocalError("no equilibrium")
            return np.inf
        return parabola(value)

    lower, upper = profile_interval(objective, 1.0, 1.0, 10)
    assert upper == pytest.approx(1.6, abs=1e-5)
    assert lower == pytest.approx(1 - stats.t.ppf(0.975, 10), abs=1e-5)
