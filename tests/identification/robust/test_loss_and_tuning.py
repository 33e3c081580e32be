"""Huber's constants give the efficiency that they are for."""

import numpy as np
import pytest
from scipy import integrate, stats

from elastocal.identification.robust import HUBER


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
