"""Drifts, jumps, slips and warm-up: what the table's time (or temperature) does."""

from __future__ import annotations

import pytest
from model.effects.stick import model, rows, stick

from elastocal.errors import InputError


@pytest.mark.parametrize(
    "driver, column", [("time", "time_s or time_min"), ("temperature", "temperature_C")]
)
def test_a_table_without_the_driver_is_refused(driver: str, column: str) -> None:
    m = model(stick("z"), "thermal_expansion:all", thermal_driver=driver)
    with pytest.raises(InputError, match=column):
        m.predict(rows([0.0]))
