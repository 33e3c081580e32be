"""How the arm came to a visit: by the order of times or rows, kept with rows that are taken."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from model.effects.stick import model, positions, rows, stick
from support.cells import kr270_cell, kr270_chain, random_table

from elastocal.errors import InputError
from elastocal.measurements import read_measurements, with_moves
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import Model

Q = np.array([[0.0, 0.0], [0.5, 0.0], [0.2, -0.4], [0.2, 0.1]])
MOVE = np.array([[0.0, 0.0], [0.5, 0.0], [-0.3, -0.4], [0.0, 0.5]])
DIRECTION = np.array([[0, 0], [1, 0], [-1, -1], [-1, 1]])


def test_a_move_is_from_one_visit_to_the_next_and_a_joint_keeps_its_last_direction() -> None:
    table = with_moves(rows(Q))
    np.testing.assert_allclose(table.move, MOVE, atol=1e-15)
    np.testing.assert_array_equal(table.direction, DIRECTION)


def test_rows_that_are_taken_from_a_table_that_was_read_keep_their_moves(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    lines = [f"{a},{b},0,0,0" for a, b in Q]
    path.write_text("\n".join(["q1_rad,q2_rad,x_m,y_m,z_m", *lines]) + "\n")
    table = read_measurements(path, joint_kinds=("revolute", "revolute"))
    np.testing.assert_allclose(table.take([3, 1]).move, MOVE[[3, 1]], atol=1e-15)
    np.testing.assert_array_equal(table.take([3, 1]).direction, DIRECTION[[3, 1]])
    assert "move" not in "".join(table.columns())


def test_an_arm_lags_by_its_share_of_the_longest_way() -> None:
    m = model(stick("zz", (1.0, 1.0)), "move_lag:joint2")
    lag, sign = (
        positions(m, rows(Q), **{key: 1e-3}) - positions(m, rows(Q))
        for key in ("move_lag", "move_lag_sign")
    )
    far = np.linalg.norm(lag, axis=1)
    np.testing.assert_allclose(far, 1e-3 * np.array([0.0, 0.0, 1.0, 1.0]), rtol=1e-6, atol=1e-12)
    ahead = np.cross(positions(m, rows(Q)) - np.column_stack(
        [np.cos(Q[:, 0]), np.sin(Q[:, 0]), np.zeros(4)]), sign)[:, 2]  # fmt: skip
    np.testing.assert_allclose(ahead, 1e-3 * np.sign(MOVE[:, 1]), atol=1e-9)


@pytest.mark.parametrize("effect", ["move_lag", "move_hysteresis"])
def test_what_came_before_the_first_visit_has_an_error_of_its_own(effect: str) -> None:
    m = model(stick("zz", (1.0, 1.0)), f"{effect}:joint1")
    campaign, first = with_moves(rows(Q)), {f"{effect}_first": 1e-3}
    moved = positions(m, campaign, **first) - positions(m, campaign)
    unknown = DIRECTION[:, 0] == 0
    assert unknown[0] and not unknown.all()
    np.testing.assert_array_equal(np.linalg.norm(moved, axis=1) > 1e-9, unknown)
    # Poses that are no campaign's, targets say, have no such error.
    np.testing.assert_array_equal(positions(m, rows(Q), **first), positions(m, rows(Q)))


@pytest.mark.parametrize("effect", ["hysteresis", "backlash"])
def test_the_order_of_visits_says_what_a_missing_column_would(effect: str) -> None:
    chain, side = kr270_chain(), "load_and_approach"
    table = replace(random_table(chain, 6, seed=1), approach=None)
    by_order = Model.assembled(chain, kr270_cell([effect], play_side=side, approach="order"))
    by_column = Model.assembled(chain, kr270_cell([effect], play_side=side))
    x = np.array([p.typical or 1e-8 for p in by_column.parameters])
    told = replace(table, approach=with_moves(table).direction)
    np.testing.assert_array_equal(by_order.predict(table, x), by_column.predict(told, x))
    with pytest.raises(InputError, match="needs the column approach_1"):
        by_column.predict(table, x)
    assert "approach" not in CATALOGUE[effect].needed(by_order.cell)
    assert "approach" in CATALOGUE[effect].needed(by_column.cell)
