"""Parameters as YAML and JSON, and the cost of what a format cannot hold."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import strategies as st
from support.exports import write_result
from support.robots import KR270

from elastocal.export.export import Wish, export
from elastocal.export.exportable import Conditions
from elastocal.model.calibrated import read_calibrated
from elastocal.model.urdf import read_urdf

ROBOT = f'urdf = "{KR270}"'

FINITE = st.none() | st.booleans() | st.integers() | st.floats(
    allow_nan=False, allow_infinity=False
) | st.text(st.characters(codec="utf-8"))  # fmt: skip


def test_temperature_is_frozen_into_the_lengths_where_it_is_stated(tmp_path: Path) -> None:
    written = write_result(
        tmp_path,
        ROBOT,
        ["thermal_expansion:all"],
        'thermal_driver = "temperature"',
        value=lambda p: 12e-6,
    )
    calibrated = read_calibrated(*written)
    without = export(calibrated, Wish("urdf", poses=20))
    (entry,) = without.cost.effects
    assert entry.difference is None and "`temperature_c`" in entry.note
    warm = export(calibrated, Wish("urdf", conditions=Conditions(temperature=30.0), poses=20))
    assert not warm.cost.effects and warm.cost.total.flange_max == 0.0
    (tmp_path / "warm.urdf").write_text(warm.text)
    forearm = read_urdf(tmp_path / "warm.urdf").joints[2].placement
    assert forearm[0, 3] == pytest.approx(1.25 * (1 + 12e-6 * 10), rel=1e-15)
    assert "at 30 °C" in warm.text
