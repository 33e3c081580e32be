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
