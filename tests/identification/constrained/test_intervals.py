"""Intervals under constraints: closed forms, coverage near a bound, bootstrap, posterior."""

import numpy as np
import pytest
from scipy import stats
from support.calibration import binomial_band
from support.constrained import profile, profiles, solve

from elastocal.errors import InputError
from elastocal.identification.knowledge import (
    Bounds,
    Constraints,
    GaussianPrior,
    LinearEquality,
    SemidefiniteMatrix,
    non_negative,
)
from elastocal.identification.linear_solver import solve_weighted

NAMES = ("a", "b", "c")
SIZES = np.array([1e-7, 1e-6, 1e-3])
RNG = np.random.default_rng(3)
B = RNG.normal(size=(30, 3)) @ np.array([[1, 0.6, 0], [0, 1, 0.4], [0, 0, 1]]) / SIZES
COFACTOR = solve_weighted(B, np.zeros(30)).cofactor
STD = np.sqrt(np.diag(COFACTOR))
NOISE = RNG.normal(size=30)


def readings(*truth_in_std: float) -> np.ndarray:
    return B @ (STD * truth_in_std) + NOISE


def ends(interval) -> np.ndarray:
    return np.array([interval.lower, interval.upper])


def test_without_active_constraints_it_is_the_normal_interval():
    y = readings(10.0, 10.0, 10.0)
    linear = solve_weighted(B, y)
    half = stats.norm.ppf(0.9) * STD
    found = profiles(B, y, NAMES, non_negative("a", "b"), level=0.8)
    for i, interval in enumerate(found):
        np.testing.assert_allclose(
            ends(interval), linear.x[i] + half[i] * np.array([-1, 1]), atol=1e-5 * STD[i]
        )
        assert interval.ends == ("crossing", "crossing")


def test_one_bound_in_closed_form():
    # With one bound S(v) = rss + (v − x̂)²/V still, and Ŝ is its value at the bound.
    y = readings(-2.0, 5.0, 5.0)
    free = solve_weighted(B, y)
    assert free.x[0] < 0
    found = profile(B, y, NAMES, non_negative("a"), "a")
    upper = free.x[0] + np.sqrt(stats.chi2.ppf(0.95, 1) * STD[0] ** 2 + free.x[0] ** 2)
    assert found.lower == 0.0 and found.ends == ("bound", "crossing")
    assert found.upper == pytest.approx(upper, abs=1e-5 * STD[0])


def test_intervals_end_where_other_constraints_end():
    # a + b = 3 of their sizes and b ≥ 0 leave a at most there, though a itself has no bound.
    total = 3.0 * STD[0]
    stated = non_negative("b") + Constraints(
        equalities=(LinearEquality({"a": 1.0, "b": STD[0] / STD[1]}, total),)
    )
    found = profile(B, readings(2.5, 0.5, 1.0), NAMES, stated, "a")
    assert found.ends[1] == "bound"
    assert found.upper == pytest.approx(total, abs=1e-4 * STD[0])
    assert found.lower < total - 0.5 * STD[0]


def test_intervals_respect_a_matrix():
    y = readings(1.0, 0.0, 2.0)
    unit = {n: {n: 1 / s} for n, s in zip(NAMES, STD, strict=True)}
    K = SemidefiniteMatrix("K", ((unit["a"], unit["b"]), (unit["b"], unit["c"])))
    a, b, _ = profiles(B, y, NAMES, Constraints(matrices=(K,)))
    assert a.lower >= -1e-5 * STD[0]
    free = profile(B, y, NAMES, Constraints(), "b")
    inside = ends(b)
    assert free.lower - 1e-4 * STD[1] < inside[0] < inside[1] < free.upper + 1e-4 * STD[1]


def test_a_value_that_equalities_fix_is_its_interval():
    stated = Constraints((Bounds("b", STD[1], STD[1]),))
    found = profile(B, readings(1, 1, 1), NAMES, stated, "b")
    np.testing.assert_allclose(ends(found), STD[1], rtol=1e-12)


def test_a_prior_gives_posterior_intervals():
    prior = GaussianPrior.independent(("a",), [0.0], [STD[0]])
    y = readings(1.0, 1.0, 1.0)
    found = profiles(B, y, NAMES, Constraints(), prior=prior)
    fit = solve(B, y, NAMES, prior=prior)
    half = stats.norm.ppf(0.975) * np.sqrt(np.diag(fit.cofactor))
    for i, interval in enumerate(found):
        np.testing.assert_allclose(
            ends(interval), fit.x[i] + half[i] * np.array([-1, 1]), atol=1e-5 * STD[i]
        )


@pytest.mark.parametrize(("truth", "exact"), [(0.0, 0.975), (1.0, None), (6.0, 0.95)])
def test_coverage_near_a_bound(truth, exact):
    # On the bound the likelihood ratio is ½χ²₀ + ½χ²₁: 97.5 % exactly; far from it 95 %;
    # in between at least 95 %.
    rng = np.random.default_rng(int(10 * truth) + 1)
    x = STD * [truth, 2.0, -1.0]
    n, held = 60, 0
    for _ in range(n):
        y = B @ x + rng.normal(size=30)
        found = profile(B, y, NAMES, non_negative("a"), "a")
        held += found.lower <= x[0] <= found.upper
    low, high = binomial_band(n, 0.95 if exact is None else exact)
    assert low <= held
    assert exact is None or held <= high


@pytest.mark.long
@pytest.mark.parametrize("degrees", [90, 150, 175])
def test_coverage_with_the_truth_on_two_bounds(degrees):
    # The likelihood ratio is χ²₁ on two quadrants, |x|² ~ χ²₂ on an angle of α − 90°, else 0.
    angle = np.radians(degrees)
    columns = np.array([[1.0, np.cos(angle)], [0.0, np.sin(angle)]])
    rng = np.random.default_rng(degrees)
    n, stated = 2000, non_negative("a", "b")
    draws = rng.normal(size=(n, 2))
    held = sum(profile(columns, y, ("a", "b"), stated, "a").lower == 0.0 for y in draws)
    low, high = binomial_band(n, 0.975 - stats.chi2.sf(3.8415, 2) * (degrees - 90) / 360)
    assert low <= held <= high


def test_a_name_that_is_no_parameter_is_refused():
    with pytest.raises(InputError, match="'d' is not a parameter"):
        profile(B, NOISE, NAMES, Constraints(), "d")
