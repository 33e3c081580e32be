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


def test_another_table_is_of_another_session() -> None:
    """How the arm came to it nobody knows; it comes after a jump told by lines, with times too."""
    plain = ec.Model(CELL)
    effects = (*plain.cell.model.effects, "move_lag:joint2", "encoder_jump:joint3")
    nominal = replace(plain.cell.model.nominal, settings={"joint3": {"jump_time_s": 31.5}})
    spec = replace(plain.cell.model, effects=effects, nominal=nominal)
    model, values = plain.specified(replace(spec, clock="rows")), LAG | {"joint3.jump": 1e-3}
    q = np.random.default_rng(9).uniform(-1.0, 1.0, (90, 6))
    before = ec.simulate(model, q[:60], values=values, seed=6)
    poses = replace(model.table(q[60:]), time=np.arange(30.0) + 100)
    later = ec.simulate(plain.specified(spec), poses, values=values)
    for test in (later, replace(later, time=None), shuffled(sided())):
        fit = ec.identify(model, before, test=test)
        off = np.linalg.norm(fit.predict(test) - test.position, axis=1)
        np.testing.assert_allclose(fit.test.errors, off, atol=1e-12)
        assert np.sqrt((off[1:] ** 2).mean()) < 1e-4 or test.approach is not None
    assert any("the order is not that of the campaign" in text for text in fit.warnings)


def test_the_joints_of_the_pose_before_tell_the_moves_in_any_order(tmp_path: Path) -> None:
    table = campaign()
    mixed = shuffled(replace(table, before=table.q - table.move))
    mixed.save(tmp_path / "data.csv")
    read = ec.Model(CELL).read(tmp_path / "data.csv")
    moves = dict(zip(table.row, table.move, strict=True))
    np.testing.assert_allclose(read.move, [moves[row] for row in mixed.row], atol=1e-9)
