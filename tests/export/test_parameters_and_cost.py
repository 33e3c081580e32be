"""Parameters as YAML and JSON, and the cost of what a format cannot hold."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.exports import exported, write_result
from support.robots import KR270

from elastocal.export.export import Wish, export, to_yaml
from elastocal.export.exportable import Conditions
from elastocal.model.calibrated import read_calibrated
from elastocal.model.urdf import read_urdf

ROBOT = f'urdf = "{KR270}"'

FINITE = st.none() | st.booleans() | st.integers() | st.floats(
    allow_nan=False, allow_infinity=False
) | st.text(st.characters(codec="utf-8"))  # fmt: skip


@given(
    st.recursive(
        FINITE,
        lambda inner: (
            st.lists(inner, max_size=4)
            | st.dictionaries(st.text(st.characters(codec="utf-8")), inner, max_size=4)
        ),
        max_leaves=12,
    )
)
def test_a_yaml_reader_finds_what_was_written(data: object) -> None:
    yaml = pytest.importorskip("yaml")
    assert yaml.safe_load(to_yaml(data)) == data


def test_what_the_data_did_not_determine_is_listed_with_its_value(tmp_path: Path) -> None:
    cell, result = write_result(tmp_path, ROBOT)
    content = json.loads(result.read_text())
    entry = content["parameters"][7]
    entry |= {"value": None, "std": None, "ci95": None, "identifiable": False}
    result.write_text(json.dumps(content))
    _, done = exported(cell, result, "urdf")
    assert done.held == {entry["name"]: entry["held"]}


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
