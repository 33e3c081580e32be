"""Robust scales: consistent, equivariant, and blind to almost half of the readings."""

import numpy as np
import pytest
from statsmodels.robust import scale

from elastocal.identification import breakdown_bisquare, m_scale
from elastocal.identification.robust_core import median_scale

ESTIMATORS = {
    "median": median_scale,
    "m": lambda length, size: m_scale(length, breakdown_bisquare(size)),
}


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("name", ESTIMATORS)
def test_consistent_at_the_normal_and_equivariant(name, size):
    """The least efficient has 37 % efficiency: standard error 1/√(2·0.37·n), n = 40 000; four."""
    d = np.linalg.norm(np.random.default_rng(1).normal(size=(40_000, size)), axis=1)
    found = ESTIMATORS[name](d, size)
    assert found == pytest.approx(1.0, abs=4 / np.sqrt(2 * 0.37 * 40_000))
    assert ESTIMATORS[name](7 * d, size) == pytest.approx(7 * found, rel=1e-12)


@pytest.mark.parametrize("name", ["median", "m"])
def test_almost_half_of_the_readings_cannot_carry_it_away(name):
    d = np.abs(np.random.default_rng(2).normal(size=1000))
    d[:450] = 1e9
    assert ESTIMATORS[name](d, 1) < 10


def test_median_scale_is_the_mad_about_zero():
    r = np.random.default_rng(3).normal(size=40)
    assert median_scale(np.abs(r), 1) == pytest.approx(scale.mad(r, center=0), rel=1e-12)


def test_m_scale_solves_its_equation_and_is_zero_where_half_is_exact():
    d = np.abs(np.random.default_rng(5).normal(size=101))
    loss = breakdown_bisquare(1)
    s = m_scale(d, loss, 5)
    assert loss.rho(d / s).sum() / loss.largest == pytest.approx((101 - 5) / 2, rel=1e-9)
    d[:60] = 0.0
    assert m_scale(d, loss) == 0.0
