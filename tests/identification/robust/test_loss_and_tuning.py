"""Losses are what they claim, and their constants give the efficiency and breakdown claimed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats

from elastocal.identification.robust import (
    HALF,
    absolute,
    bisquare,
    huber,
    t_loss,
)

LOSSES = [huber(3, 1.5), bisquare(3, 4.0), absolute(3), t_loss(3, 4.0)]


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.name)
@settings(deadline=None)
@given(d=st.floats(0.01, 20.0))
def test_psi_and_slope_are_the_derivatives_of_rho(loss, d):
    """Central differences, away from the kink at the tuning constant."""
    h = 1e-5
    if abs(d - loss.constant) < 2 * h:
        return
    low, at, high = (np.array(v) for v in (d - h, d, d + h))
    assert loss.psi(at) == pytest.approx((loss.rho(high) - loss.rho(low)) / (2 * h), abs=1e-8)
    assert loss.slope(at) == pytest.approx((loss.psi(high) - loss.psi(low)) / (2 * h), abs=1e-8)
    assert loss.weight(at) * d == pytest.approx(float(loss.psi(at)), rel=1e-12)
    assert loss.rho(np.array(0.0)) == 0


@pytest.mark.parametrize("size", range(1, 7))
def test_constants_give_the_efficiency_and_breakdown_they_are_for(size):
    """By quadrature over the density of χ(size): the efficiency a²/b, with a by Stein's identity
    E div Ψ = E r·Ψ, which needs no derivative of ψ, and E ρ of the bisquare of one half."""

    def mean(g, kink):
        parts = [(0, kink), (kink, 20)]
        values = (integrate.quad(lambda d: g(d) * stats.chi.pdf(d, size), *part) for part in parts)
        return sum(value for value, _ in values)

    for loss in (huber(size), bisquare(size)):
        a = mean(lambda d, f=loss: f.psi(d) * d, loss.constant) / size
        b = mean(lambda d, f=loss: f.psi(d) ** 2, loss.constant) / size
        assert a**2 / b == pytest.approx(0.95, abs=1e-8)
    half = bisquare(size, HALF[size - 1])
    assert mean(half.rho, half.constant) == pytest.approx(half.constant**2 / 12, rel=1e-8)
