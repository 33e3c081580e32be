"""Poses that show only some of the markers: what they tell, and what becomes of them in files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planning.feasibility.small_cells import NOTHING, gantry_at, gantry_rules, sphere
from planning.test_information import AXIS, cell_for, gathered, information_of, relative
from support.cells import DOWN, TABLE_2

import elastocal as ec
from elastocal.cell.arm_description import Tool, Tracker
from elastocal.cell.work_cell import Visibility, Workspace
from elastocal.model.observations import observe
from elastocal.planning.information import observed_weights

STATES = np.array([[0.0, 0, 0], DOWN])
Q = TABLE_2[:6]


def test_a_marker_is_seen_in_range_turned_to_the_tracker_and_behind_nothing() -> None:
    markers = {"L": np.array([0, -1.0, 0]), "C": np.zeros(3), "R": np.array([0, 1.0, 0])}
    sight = Visibility({"L": np.array([-1.0, 0, 0])}, np.radians(30), (1.0, 3.1), min_markers=1)
    space = Workspace(obstacles=(sphere("ball", 0.2, (1.6, 0.5, 0.0)),), visibility=sight)
    eye = Tracker(position=np.array([3.0, 0.0, 0.0]))

    def rules(least: int) -> ec.Feasibility:
        seen = replace(sight, min_markers=least)
        return gantry_rules(replace(space, visibility=seen), Tool(markers=markers), eye)

    # L is turned away; R is behind the ball, then out of range as well as C; then C behind it.
    q = gantry_at((0.2, 0, 0), (-0.05, 0, 0), (0.2, 1.0, 0), (-2, 0, 0))
    one = rules(1)
    assert one.partial
    assert one.seen(q[:2], NOTHING).tolist() == [[False, True, False]] * 2
    assert one.feasible(q, NOTHING).tolist() == [True, True, False, False]
    assert not rules(2).feasible(q, NOTHING).any()
    assert not rules(3).partial
    assert "min_markers" in rules(2).advice(rules(2).check(q, NOTHING))


@pytest.mark.parametrize("observed", ["position", "deflection"])
@pytest.mark.parametrize("tau", [0.0, 30e-6])
def test_information_is_that_of_the_readings_that_are_made(observed: str, tau: float) -> None:
    """With what an arm does not repeat, which the markers of a visit share."""
    whole = information_of(cell_for(observed, AXIS, loads=STATES, repeatability=tau))
    model, x = whole.model, whole.x
    rng = np.random.default_rng(3)
    shown = {tuple(f): rng.random((len(Q), 3)) < 0.7 for f in STATES}
    part = replace(whole, sight=lambda q, force: shown[tuple(force)])
    seen = part.seen(Q)
    assert 0 < seen.mean() < 1
    read = observe(part.rows(Q).take(seen.reshape(-1)), observed)
    B = observed_weights(model, read, x).apply(model.regressor(read.table, x, None, read).B)
    assert relative(gathered(part, Q), B.T @ B) < 1e-9
