"""Losses are what they claim, and their constants give the efficiency and breakdown claimed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from statsmodels.robust import norms

from elastocal.errors import InputError
from elastocal.identification import (
    Absolute,
    Bisquare,
    Huber,
    StudentT,
    bisquare,
    breakdown_bisquare,
    efficiency,
    huber,
    normal_mean,
    normal_moments,
)

LOSSES = [Huber(3, 1.5), Bisquare(3, 4.0), Absolute(3), StudentT(3, 4.0)]


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.name)
@settings(deadline=None)
@given(d=st.floats(0.01, 20.0))
def test_psi_and_slope_are_the_derivatives_of_rho(loss, d):
    """Central differences, away from the kink at the tuning constant."""
    h = 1e-5
    if abs(d - getattr(loss, "c", -1.0)) < 2 * h:
        return
    low, at, high = (np.array(v) for v in (d - h, d, d + h))
    assert loss.psi(at) == pytest.approx((loss.rho(high) - loss.rho(low)) / (2 * h), abs=1e-8)
    assert loss.slope(at) == pytest.approx((loss.psi(high) - loss.psi(low)) / (2 * h), abs=1e-8)
    assert loss.weight(at) * d == pytest.approx(float(loss.psi(at)), rel=1e-12)
    assert loss.rho(np.array(0.0)) == 0


def test_per_row_the_losses_are_those_of_statsmodels():
    r = np.linspace(-9, 9, 301)
    for ours, theirs in (
        (Huber(1, 1.345), norms.HuberT(1.345)),
        (Bisquare(1, 4.685), norms.TukeyBiweight(4.685)),
    ):
        for name, reference in (
            ("psi", "psi"), ("weight", "weights"), ("slope", "psi_deriv"),
        ):  # fmt: skip
            np.testing.assert_allclose(
                getattr(ours, name)(r), getattr(theirs, reference)(r), rtol=1e-12, atol=1e-14
            )
        at_zero = theirs.rho(np.zeros(1))  # statsmodels lets Tukey's ρ start below zero
        np.testing.assert_allclose(ours.rho(r), theirs.rho(r) - at_zero, rtol=1e-9, atol=1e-12)


def test_constants_for_single_rows_are_the_published_ones():
    """Huber 1.345 and bisquare 4.685 for 95 %, 1.547 for a breakdown point of one half."""
    assert huber(1).c == pytest.approx(1.345, abs=5e-4)
    assert bisquare(1).c == pytest.approx(4.685, abs=5e-4)
    assert breakdown_bisquare(1).c == pytest.approx(1.5476, abs=5e-5)


@pytest.mark.parametrize("size", [1, 2, 3, 6])
def test_constants_give_the_efficiency_and_breakdown_they_are_for(size):
    """By Stein's identity E div Ψ = E r·Ψ, which needs no derivative of ψ, over 400 000 normal
    vectors: the standard errors of a and b are below 0.3 %, so 1 % is four of them."""
    rng = np.random.default_rng(size)
    d = np.linalg.norm(rng.normal(size=(400_000, size)), axis=1)
    for loss in (huber(size), bisquare(size)):
        a = (loss.psi(d) * d).mean() / size
        b = (loss.psi(d) ** 2).mean() / size
        assert a**2 / b == pytest.approx(0.95, abs=0.01)
        assert efficiency(loss) == pytest.approx(0.95, abs=1e-9)
        exact = normal_mean(lambda t, f=loss: f.psi(t) * t, size, loss.c) / size
        assert normal_moments(loss)[0] == pytest.approx(exact, rel=1e-9)
    s = breakdown_bisquare(size)
    assert s.rho(d).mean() / s.largest == pytest.approx(0.5, abs=0.005)


@pytest.mark.parametrize(
    "call",
    [
        lambda: Huber(1, 0.0),
        lambda: Bisquare(0, 4.0),
        lambda: StudentT(1, -1.0),
        lambda: huber(1, 1.0),
        lambda: huber(1, 0.3),
        lambda: breakdown_bisquare(1, 0.6),
    ],
)
def test_impossible_constants_are_refused(call):
    with pytest.raises(InputError):
        call()
