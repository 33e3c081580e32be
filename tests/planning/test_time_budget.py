"""Poses against readings within a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cells import DOWN, kr270_chain
from support.design_cells import plan_cell

import elastocal as ec
from elastocal.cell.plan_wishes import Motion, TargetPose
from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError, InsufficientDataError
from elastocal.model.manipulator import Model
from elastocal.planning import choices
from elastocal.planning import test_poses as target_poses
from elastocal.planning.choices import Choice, _minutes, _sizes, at_stops
from elastocal.planning.information import Known
from elastocal.planning.plan import TimedSize

ONE = (TargetPose(np.radians([0.0, -90, 90, 0, 30, 0])),)
MOTION = Motion(speed=np.ones(6), dwell=10.0, reading=2.0, load_change=120.0, extra_time=0.0)
FEW = {"loads": DOWN[None], "test_poses": ONE, "candidates": 60}


def sizes(cell: Cell, minutes: float) -> tuple[tuple[TimedSize, ...], TimedSize]:
    model = Model.assembled(kr270_chain(), cell)
    targets = target_poses.test_poses(cell, kr270_chain())
    choice = Choice(model, targets, None, Known(), 0, lambda message: None)
    return _sizes(choice, cell, minutes)[:2]


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choices.Choice.draw, "__defaults__", (150,))
    monkeypatch.setattr(choices, "REPEATS", (1, 6))


def test_a_stop_takes_what_its_readings_take() -> None:
    cell = plan_cell(motion=MOTION, repeats=4, **FEW)
    assert at_stops(cell).dwell == 10.0 + 4 * 3 * 2.0
    q = np.zeros((5, 6))
    q[:, 0] = np.arange(5) * 0.6  # a row of poses, 36 s of travel for each load state
    cell = replace(cell, design=replace(cell.design, motion=replace(MOTION, speed=np.full(6, 0.1))))
    # Two load states of five stops, 24 s there and 24 s back each, two changes.
    assert _minutes(cell, q, np.ones((5, 2), dtype=int)) == pytest.approx(
        (10 * 34 + 2 * 48 + 2 * 120) / 60
    )


def one_marker(**design: object) -> Cell:
    """Of which all of a visit's readings share what the arm does not repeat."""
    cell = plan_cell(**(FEW | design))
    return replace(cell, tool=replace(cell.tool, markers={"M1": cell.tool.markers["M1"]}))


def test_what_the_arm_does_not_repeat_calls_for_poses() -> None:
    exact, best = sizes(one_marker(motion=MOTION), 20.0)
    assert [s.repeats for s in exact] == [1, 6] and all(s.minutes <= 20.0 for s in exact)
    assert best == min(exact, key=lambda size: size.value) == exact[1]
    _, fewer = sizes(one_marker(motion=MOTION, repeatability=200e-6), 20.0)
    assert fewer.repeats == 1 and fewer.poses > best.poses
    free = replace(MOTION, reading=0.0)  # nothing says how many readings there may be
    assert [s.repeats for s in sizes(one_marker(motion=free, repeats=5), 20.0)[0]] == [5]
    with pytest.raises(InsufficientDataError, match="takes 3 minutes or less"):
        sizes(one_marker(motion=MOTION), 3.0)


def test_the_plan_keeps_the_time() -> None:
    cell = plan_cell(motion=MOTION, repeatability=20e-6, **FEW)
    plan = ec.design(cell, minutes=20, effort="quick")
    spec = plan.model.cell.design
    assert plan.execution.total <= 20 * 60
    (own,) = (s for s in plan.timed if (s.poses, s.repeats) == (len(plan), spec.repeats))
    assert own.minutes == pytest.approx(plan.execution.total / 60, rel=0.2)
    assert plan.to_json()["minutes"] == plan.execution.total / 60
    with pytest.raises(InputError, match="asks for the number of poses"):
        ec.design(cell, minutes=20, poses=5)


def test_loads_are_chosen_with_poses_and_readings() -> None:
    effects = ("base_frame", "joint_compliance", "marker_position")
    loads = np.array([[0.0, 0, 0], DOWN / 2, DOWN])
    few = FEW | {"loads": loads, "motion": MOTION, "minutes": 20}
    crossed, chosen = (
        ec.design(plan_cell(effects, "position", load_states=states, **few), effort="batch")
        for states in ("all", "chosen")
    )
    assert chosen.execution.total <= 20 * 60 and chosen.reported < 0.95 * crossed.reported
    assert chosen.execution.load_changes < crossed.execution.load_changes
