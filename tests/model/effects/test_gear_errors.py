"""Errors of the transmission that follow the joint's angle."""

from __future__ import annotations

import numpy as np
import pytest
from model.effects.stick import model, positions, rows, stick

from elastocal.errors import InputError

Q = np.radians([-170.0, -90.0, -20.0, 0.0, 35.0, 90.0, 160.0])


@pytest.mark.parametrize("orders, second", [((40.0,), 40.0), ((10.0, 20.0), 20.0)])
def test_ripple_orders_are_one_for_all_or_one_each(
    orders: tuple[float, ...], second: float
) -> None:
    m = model(stick("zz", (1.0, 1.0)), "gear_ripple:joint2", gear_ripple_orders=orders)
    q = np.column_stack([np.zeros_like(Q), Q])
    y = positions(m, rows(q), ripple_sin=1e-3)[:, 1]
    expected = np.sin(Q + 1e-3 * np.sin(second * Q))
    np.testing.assert_allclose(y, expected, atol=1e-14)


def test_another_number_of_ripple_orders_is_refused() -> None:
    with pytest.raises(InputError, match=r"gear_ripple_orders has 3 values.*has 2 joints"):
        model(stick("zz", (1.0, 1.0)), "gear_ripple", gear_ripple_orders=(1.0, 2.0, 3.0))


LINES = {"order_1": 12.5, "order_3": 80.25, "order_sd_3": 0.2, "spectrum_centre_rad": 0.4}


def test_a_spectrum_has_the_lines_that_the_cell_names() -> None:
    m = model(stick("z"), "gear_spectrum", settings={"joint1": LINES})
    keys = ["line_1_sin", "line_1_cos", "line_3_sin", "line_3_cos", "line_3_sin_shift",
            "line_3_cos_shift"]  # fmt: skip
    assert [name.partition(".")[2] for name in m.names] == keys
    assert [p.typical for p in m.parameters] == [5e-5] * 4 + [5e-5 * 0.2] * 2
    assert all(p.shrunk for p in m.parameters)
    x, y, _ = positions(m, rows(Q), line_1_sin=2e-4, line_3_cos=-3e-4).T
    found = np.arctan2(np.sin(np.arctan2(y, x) - Q), np.cos(np.arctan2(y, x) - Q))
    np.testing.assert_allclose(
        found, 2e-4 * np.sin(12.5 * Q) - 3e-4 * np.cos(80.25 * Q), atol=1e-15
    )


def test_beside_a_line_stands_its_derivative_by_the_order() -> None:
    """A line of an order a little off, turned about the middle of the angles, is their sum."""
    m = model(stick("z"), "gear_spectrum", settings={"joint1": LINES})
    off, a, b = 1e-4, 2e-4, 3e-4
    phase = 80.25 * Q + off * (Q - 0.4)
    expected = a * np.sin(phase) + b * np.cos(phase)
    shifts = {"line_3_sin_shift": a * off, "line_3_cos_shift": b * off}
    x, y, _ = positions(m, rows(Q), line_3_sin=a, line_3_cos=b, **shifts).T
    found = np.arctan2(np.sin(np.arctan2(y, x) - Q), np.cos(np.arctan2(y, x) - Q))
    np.testing.assert_allclose(found, expected, atol=1e-3 * a * off + 1e-11)
