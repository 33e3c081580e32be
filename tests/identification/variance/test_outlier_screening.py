"""The first guess at faulty readings: scale of their own group where there is one."""

import numpy as np
import pytest

from elastocal.identification.noise_choice import outlier_screening
from elastocal.identification.noise_structure import Readings


def table(configurations=10, each=12):
    """Readings whose labels alone matter, and residuals of unit noise (N, 3)."""
    c = np.repeat(np.arange(configurations), each)
    n = len(c)
    r = Readings(np.zeros((n, 3, 1)), np.zeros((n, 3)), c, 0 * c, 0 * c)
    return r, np.random.default_rng(0).normal(size=(n, 3))


@pytest.mark.parametrize("each", [2, 12])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_component_of_eight_deviations_is_suspected(each, axis):
    r, e = table(120 // each, each)
    e[7, axis] = 8.0
    assert not outlier_screening(r, e)[7]


def test_clean_noise_is_seldom_suspected():
    """Five robust deviations of 12 readings: fewer than one reading in fifty, of the whole table
    fewer than one in a thousand."""
    r, e = table(300, 12)
    assert outlier_screening(r, e).mean() > 0.98
    r, e = table(1500, 2)
    assert outlier_screening(r, e).mean() > 0.999


def test_what_a_configuration_shares_is_not_suspected():
    """Its median is taken out, where it holds enough readings to have one."""
    r, e = table()
    e[r.configuration == 4] += 30.0
    assert outlier_screening(r, e)[r.configuration == 4].mean() > 0.9
    few, e = table(60, 2)
    e[few.configuration == 4] += 30.0
    assert not outlier_screening(few, e)[few.configuration == 4].any()


def test_a_noisy_configuration_is_measured_by_its_own_scale():
    r, e = table()
    e[r.configuration == 4] *= 20
    assert outlier_screening(r, e)[r.configuration == 4].mean() > 0.8


def test_readings_that_agree_by_luck_do_not_accuse_one_that_differs_a_little():
    """Half a deviation of the table is no fault, be the others ever so equal."""
    r, e = table()
    e[r.configuration == 4] = 0.0
    e[5 + 4 * 12] = 0.5
    assert outlier_screening(r, e)[r.configuration == 4].all()


def test_loads_are_groups_of_their_own():
    r, e = table(4, 40)
    load = np.tile([0, 1], 80)
    r = Readings(r.B, r.e, r.configuration, load, r.marker)
    shifted = e + np.where(load == 1, 25.0, 0.0)[:, None]
    assert outlier_screening(r, shifted).mean() > 0.95


def test_unit_and_order_do_not_matter():
    r, e = table()
    e[::13] += 9
    usual = outlier_screening(r, e)
    assert not usual.all()
    np.testing.assert_array_equal(outlier_screening(r, 1e-6 * e), usual)
    order = np.random.default_rng(1).permutation(len(r))
    np.testing.assert_array_equal(outlier_screening(r.take(order), e[order]), usual[order])
