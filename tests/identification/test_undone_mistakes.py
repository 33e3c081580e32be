"""A table that fits no arm ends with exit code 1 and the mistakes that undone mend it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from identification.test_far_values import cell, poses

import elastocal as ec


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, ec.Measurements]:
    path = cell(tmp_path_factory.mktemp("made"))
    return path, ec.simulate(path, poses(40, 3), draw=0.3, seed=4)


def refusal(path: Path, table: ec.Measurements) -> str:
    with pytest.raises(ec.InsufficientDataError) as refused:
        ec.identify(path, table)
    return str(refused.value)


def test_pairs_of_mistakes(made):
    path, table = made
    exchanged, offset = table.q.copy(), table.q.copy()
    exchanged[:, [3, 4]] = exchanged[:, [4, 3]]
    exchanged[:, 1] *= -1
    told = "joints 4 and 5 exchanged and with the sign of joint 2 turned"
    assert told in refusal(path, replace(table, q=exchanged))
    offset[:, 1] -= np.pi / 2
    offset[:, 2] *= -1
    told = "with offset_deg 90 at joint 2 and with the sign of joint 3 turned"
    assert told in refusal(path, replace(table, q=offset))


def test_one_row_that_closed_up_lets_markers_change_places(made):
    path, table = made
    left = np.delete(table.position, 31, axis=0)
    found = refusal(path, replace(table.take(np.arange(len(left))), position=left))
    assert "line 33" in found and "one row later" in found


def test_a_column_that_holds_one_value_is_named(made):
    path, table = made
    stuck = table.position.copy()
    stuck[:, 1] = stuck[0, 1]
    found = refusal(path, replace(table, position=stuck))
    assert "column y holds one value in all 120 rows" in found


@pytest.mark.parametrize(
    ("effects", "factor"), [(("base_frame", "marker_position"), 0.97), (None, 1.03)]
)
def test_one_scale_of_all_lengths_is_named_and_not_trusted(tmp_path, effects, factor):
    """Whether the model's lengths follow it, or leave it in the residual."""
    path = cell(tmp_path, **({} if effects is None else {"effects": effects}))
    table = ec.simulate(path, poses(40, 3), draw=0.1, seed=4)
    assert ec.identify(path, table).finding("scale") is None
    fit = ec.identify(path, replace(table, position=factor * table.position))
    assert fit.finding("scale").numbers["readings_over_file"] == pytest.approx(factor, abs=2e-3)
    assert not fit.verdict.trusted and "a scale error" in fit.to_json()["verdict"]["sentence"]


def test_the_cell_of_another_robot_is_named_before_a_scale(made):
    """No target is wrong by a third: the arm of the cell is another one."""
    path, table = made
    fit = ec.identify(path, replace(table, position=1.35 * table.position))
    assert "most likely the cell describes another robot" in fit.to_json()["verdict"]["sentence"]
    assert fit.finding("scale").remedy.startswith("Check that the cell describes the robot")


def test_deflections_are_small_but_their_positions_tell_swapped_columns() -> None:
    campaign = Path(__file__).parents[1] / "golden" / "inputs" / "campaign"
    model = ec.Model(campaign / "deflecting.toml")
    table = model.read(campaign / "data.csv")
    mirrored = replace(table, position=table.position[:, [0, 2, 1]])
    mended = "no deflections of this arm.*the readings fit the nominal arm only to .* they would"
    with pytest.raises(ec.InsufficientDataError, match=mended):
        ec.identify(model, mirrored)
