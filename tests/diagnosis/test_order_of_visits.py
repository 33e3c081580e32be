"""What goes with the last move: found alone, by the order of the rows or what is recorded of it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

import elastocal as ec
from elastocal import Measurements

CELL = Path(__file__).parents[1] / "cases" / "jump_untimed" / "cell.toml"
LAG = {"joint2.move_lag": 6e-4}


def lagging() -> ec.Model:
    plain = ec.Model(CELL)
    return plain.with_effects((*plain.cell.model.effects, "move_lag:joint2"))


@cache
def campaign() -> Measurements:
    """Joint 2 lags behind its last move, in the order of the rows; 30 µm of noise."""
    q = np.random.default_rng(5).uniform(-1.0, 1.0, (60, 6))
    return ec.simulate(lagging(), q, values=LAG, seed=6)


def sided() -> Measurements:
    """The same with the side that each joint came from recorded."""
    table = campaign()
    return replace(table, approach=np.where(table.move < 0, -1.0, 1.0))


def shuffled(table: Measurements) -> Measurements:
    order = np.random.default_rng(7).permutation(table.configuration.max() + 1)
    rows = np.argsort(order[table.configuration], kind="stable")
    return replace(table.take(rows), move=None, direction=None)


def test_sides_that_contradict_the_order_are_told_and_nothing_rests_on_it() -> None:
    why = ec.diagnose(CELL, shuffled(sided()))
    assert not any("move" in e.effect for e in why.effects)
    assert any("the order is not that of the campaign" in text for text in why.warnings)


def test_a_joint_that_lags_is_found_alone() -> None:
    in_order = ec.diagnose(CELL, sided())
    assert in_order.verdict == "explained"
    assert ("move_lag", "joint2") in {(e.effect, e.where) for e in in_order.effects}
    assert in_order.gap.explained < 0.6 * in_order.gap.calibrated
    assert not any("campaign" in text for text in in_order.warnings)


def test_identify_says_that_the_order_of_test_rows_is_another() -> None:
    fit = ec.identify(lagging(), sided(), test=shuffled(sided()))
    assert any("the order is not that of the campaign" in text for text in fit.warnings)


def test_the_joints_of_the_pose_before_tell_the_moves_in_any_order(tmp_path: Path) -> None:
    table = campaign()
    mixed = shuffled(replace(table, before=table.q - table.move))
    mixed.save(tmp_path / "data.csv")
    read = ec.Model(CELL).read(tmp_path / "data.csv")
    moves = dict(zip(table.row, table.move, strict=True))
    np.testing.assert_allclose(read.move, [moves[row] for row in mixed.row], atol=1e-9)
