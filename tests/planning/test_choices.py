"""Where markers, hook and tracker stand, which loads hang, how many poses fit a time."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.cells import DOWN, kr270_chain
from support.design_cells import plan_cell
from support.design_commands import DEFLECTION, design, write_cell

import elastocal as ec
from elastocal.cell import Cell
from elastocal.cell_tables import Freedom, Motion, PolarNoise, TargetPose
from elastocal.messages import InputError, InsufficientDataError
from elastocal.model.manipulator import Model
from elastocal.planning import poses as target_poses
from elastocal.planning import setup
from elastocal.planning.information import Known
from elastocal.planning.plan import TimedSize
from elastocal.planning.setup import Choice, _minutes, _sizes, at_stops

ONE = (TargetPose(np.radians([0.0, -90, 90, 0, 30, 0])),)
MOTION = Motion(speed=np.ones(6), dwell=10.0, reading=2.0, load_change=120.0, extra_time=0.0)
FEW = {"loads": DOWN[None], "test_poses": ONE, "candidates": 60}


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    few = {"STARTS": 1, "COMPARED": 60, "ROUNDS": 3, "REPEATS": (1, 6)}
    for name, value in few.items():
        monkeypatch.setattr(setup, name, value)
    monkeypatch.setattr(setup.Choice.draw, "__defaults__", (150,))


def choice_of(cell: Cell) -> Choice:
    targets = target_poses.test_poses(cell, kr270_chain())
    model = Model.assembled(kr270_chain(), cell)
    return Choice(model, targets, None, Known(), 0, lambda message: None)


def sizes(cell: Cell, minutes: float) -> tuple[tuple[TimedSize, ...], TimedSize]:
    found, best = _sizes(choice_of(cell), cell, minutes)
    return found, best.size


def test_the_tracker_goes_where_its_noise_is_least() -> None:
    """Nearer is better where noise grows with the range."""
    noise = PolarNoise(5e-6, 20e-6, 5e-6, 20e-6)
    box = np.array([[3.0, -2.0, 0.5], [12.0, -2.0, 0.5]])
    cell = plan_cell(
        noise=noise, loads=DOWN[None], test_poses=ONE, poses=6, choose=Freedom(tracker=box)
    )
    far = replace(cell, tracker=replace(cell.tracker, position=np.array([11.0, -2.0, 0.5])))
    found = choice_of(far).best()
    assert found.places["tracker"][1, 0] == pytest.approx(3.0, abs=0.05)
    assert found.before is not None and found.after < 0.6 * found.before


CHOOSE = """
[design.choose]
load_point_m = [[0.1, -0.1, 0.2], [0.3, 0.1, 0.3]]

[design.choose.markers_m]
M2 = [[-0.2, 0.1, 0.1], [-0.1, 0.3, 0.2]]
"""


def test_the_command_plans_for_what_it_chose_and_writes_the_cell(tmp_path: Path) -> None:
    few = DEFLECTION.replace("candidates = 60", "candidates = 25")
    cell = write_cell(tmp_path, few + CHOOSE)
    again = tmp_path / "chosen.toml"
    result = design(cell, "--cell-out", again)
    assert result.exit_code == 0, result.stderr
    assert "M2 at [" in result.stdout and "best possible value of any plan from" in (
        " ".join(result.stdout.split())
    )
    found = json.loads((tmp_path / "plan.json").read_text())["chosen"]
    placed = Cell.read(again)
    assert placed.design.choose is None
    assert placed.tool.load_point.tolist() == found["cell"]["tool"]["load_point_m"]
    assert placed.tool.markers["M2"].tolist() == found["cell"]["tool"]["markers_m"]["M2"]
    assert placed.tool.markers["M1"].tolist() == [0.25, 0.0, 0.05]
    for at, low, high in (
        (placed.tool.load_point, [0.1, -0.1, 0.2], [0.3, 0.1, 0.3]),
        (placed.tool.markers["M2"], [-0.2, 0.1, 0.1], [-0.1, 0.3, 0.2]),
    ):
        assert (at >= np.array(low) - 1e-9).all() and (at <= np.array(high) + 1e-9).all()
    assert found["relaxed"]["after"] < found["relaxed"]["before"]
    # Nothing is chosen any more.
    assert design(again, "--cell-out", tmp_path / "no.toml").exit_code == 2


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
    plan = ec.design(cell, minutes=24, effort="batch")
    took = plan.execution.total / 60  # and a pose more would not fit
    assert took <= 24 < took * (1 + 1 / len(plan))
    size = len(plan), plan.model.cell.design.repeats
    (own,) = (s for s in plan.timed if (s.poses, s.repeats) == size)
    assert own.minutes == pytest.approx(took, rel=0.2) and plan.to_json()["minutes"] == took
    with pytest.raises(InputError, match="asks for the number of poses"):
        ec.design(cell, minutes=20, poses=5)


def test_time_is_planned_for_a_cell_as_a_diagnosis_writes_it() -> None:
    """With smooth functions, which a plan holds at zero, and the markers that its data name."""
    curved = ("base_frame", "joint_compliance", "joint_curve:joint2")
    cell = plan_cell(curved, "position", motion=MOTION, **FEW)
    plan = ec.design(replace(cell, tool=replace(cell.tool, markers={})), minutes=20, effort="quick")
    assert plan.execution.total <= 20 * 60 and "holds the smooth functions" in plan.warnings[0]


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
