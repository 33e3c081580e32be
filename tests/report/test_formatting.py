"""Units people think in, and digits that fit the uncertainty."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from elastocal.messages import length, rounded, significant
from elastocal.report.blocks import estimate, plain, with_ends, with_uncertainty


@pytest.mark.parametrize(
    ("value", "half", "shown"),
    [
        (0.28712, 0.0031, ("0.287", "0.003")),
        (0.28712, 0.0014, ("0.2871", "0.0014")),
        (12345.0, 320.0, ("12300", "300")),
        (5.0, 123.0, ("0", "120")),
        (1.0, 0.0, ("1", "0")),
        (1.0, math.inf, ("1", "–")),
        (1.23456789012, 2e-14, ("1.234567890120000e+00", "2.0e-14")),
    ],
)
def test_digits_fit_the_uncertainty(value: float, half: float, shown: tuple[str, str]) -> None:
    assert with_uncertainty(value, half) == shown


@given(st.floats(-1e3, 1e3), st.floats(0, 1e3), st.floats(1e-3, 1e3))
def test_ends_are_rounded_by_a_twentieth_of_the_interval_at_most(
    value: float, below: float, above: float
) -> None:
    low, high = value - below, value + above
    text, ends, _ = with_ends(value, low, high)
    shown = [float(text), *map(float, ends.strip("[]").split(", "))]
    for number, exact in zip(shown, (value, low, high), strict=True):
        assert abs(number - exact) <= 0.051 * (high - low) + 1e-9


def test_other_numbers() -> None:
    assert with_ends(2.77, -math.inf, 2.8412)[:2] == ("2.770", "[-∞, 2.841]")
    assert with_ends(3.50897, -math.inf, math.inf)[:2] == ("3.50897", "[-∞, ∞]")
    assert estimate(2.87e-7, 3.2e-9, "rad/(N*m)") == ("0.287", "0.003", "µrad/(N·m)")
    assert estimate(5.0, 0.3, "kg*m^2") == ("5.0", "0.3", "kg·m²")
    for metres, text in (
        (84.3e-6, "84.3 µm"), (999.4e-6, "999 µm"), (999.9e-6, "1.00 mm"), (4.705e-3, "4.71 mm"),
        (1.5, "1.50 m"), (2e-11, "0 µm"), (math.inf, "not available"),
    ):  # fmt: skip
        assert length(metres) == text
    assert [*map(significant, (0.99996, 0.00062449, 4e-9))] == ["1.00", "0.000624", "4e-09"]
    assert [*map(rounded, (-0.0, 1834.6, 26e3, 1.2e-4))] == ["0", "1830", "26000", "0.00012"]
    assert (plain(-0.0), plain(1e6), plain(math.nan)) == ("0", "1000000", "–")
