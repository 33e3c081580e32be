"""Intervals under constraints: closed forms, definition, coverage near a bound."""

import numpy as np
import pytest
from scipy import stats
from support.calibration import binomial_band
from support.constrained import CHI2, ends, non_negative, solve

from elastocal.identification.knowledge import (
    Bounds,
    Constraints,
    LinearEquality,
    SemidefiniteMatrix,
)

NAMES = ("a", "b", "c")
SIZES = np.array([1e-7, 1e-6, 1e-3])
RNG = np.random.default_rng(3)
B = RNG.normal(size=(30, 3)) @ np.array([[1, 0.6, 0], [0, 1, 0.4], [0, 0, 1]]) / SIZES
COFACTOR = np.linalg.inv(B.T @ B * np.outer(SIZES, SIZES)) * np.outer(SIZES, SIZES)
STD = np.sqrt(np.diag(COFACTOR))
NOISE = RNG.normal(size=30)


def readings(*truth_in_std: float) -> np.ndarray:
    return B @ (STD * truth_in_std) + NOISE


def test_one_bound_in_closed_form():
    # With one bound S(v) = rss + (v − x̂)²/V still, and Ŝ is its value at the bound.
    y = readings(-2.0, 5.0, 5.0)
    free = SIZES * np.linalg.lstsq(B * SIZES, y)[0]
    assert free[0] < 0
    low, high = ends(B, y, NAMES, non_negative("a"), "a")
    assert low == 0.0
    upper = free[0] + np.sqrt(CHI2 * STD[0] ** 2 + free[0] ** 2)
    assert high == pytest.approx(upper, abs=1e-7 * STD[0])


def test_ends_are_where_the_least_objective_has_risen_as_far_as_allowed():
    y = readings(-1.0, 0.5, 2.0)
    K = SemidefiniteMatrix("K", (
        ({"a": 1 / STD[0]}, {"b": 1 / STD[1]}), ({"b": 1 / STD[1]}, {"c": 1 / STD[2]}),
    ))  # fmt: skip
    stated = Constraints((Bounds("c", upper=2.2 * STD[2]),), matrices=(K,))
    best = solve(B, y, NAMES, stated).objective
    for i, name in enumerate(NAMES):
        for end in ends(B, y, NAMES, stated, name):
            held = Constraints(equalities=(LinearEquality({name: 1.0}, end * (1 - 1e-9)),))
            rise = solve(B, y, NAMES, stated + held).objective - best
            # Or there is no further to go: beyond, the constraints contradict each other.
            at_end = end in (2.2 * STD[2],) or abs(end) < 1e-6 * STD[i]
            assert rise == pytest.approx(CHI2, abs=1e-5) or (at_end and rise < CHI2)


@pytest.mark.parametrize(("truth", "exact"), [(0.0, 0.975), (1.0, None)])
def test_coverage_near_a_bound(truth, exact):
    # On the bound the likelihood ratio is ½χ²₀ + ½χ²₁: 97.5 % exactly; near it at least 95 %.
    rng = np.random.default_rng(int(10 * truth) + 1)
    x = STD * [truth, 2.0, -1.0]
    n, held = 60, 0
    for _ in range(n):
        low, high = ends(B, B @ x + rng.normal(size=30), NAMES, non_negative("a"), "a")
        held += low <= x[0] <= high
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
    held = sum(ends(columns, y, ("a", "b"), stated, "a")[0] == 0.0 for y in draws)
    low, high = binomial_band(n, 0.975 - stats.chi2.sf(CHI2, 2) * (degrees - 90) / 360)
    assert low <= held <= high
