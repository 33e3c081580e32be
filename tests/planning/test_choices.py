"""Where markers, hook and tracker stand and which loads hang: chosen by the relaxed optimum."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.cells import DOWN, kr270_chain
from support.design_cells import plan_cell
from support.design_commands import DEFLECTION, design, write_cell

from elastocal.cell.arm_description import PolarNoise
from elastocal.cell.plan_wishes import Freedom, TargetPose
from elastocal.cell.work_cell import Cell
from elastocal.model.manipulator import Model
from elastocal.planning import choices
from elastocal.planning import test_poses as target_poses
from elastocal.planning.choices import Choice
from elastocal.planning.information import Known
from elastocal.planning.plan import Chosen

CHAIN = kr270_chain()
ONE = (TargetPose(np.radians([0.0, -90, 90, 0, 30, 0])),)


def cell_with(freedom: Freedom, loads: np.ndarray = DOWN[None], **more: object) -> Cell:
    return plan_cell(loads=loads, test_poses=ONE, poses=6, choose=freedom, **more)


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"STARTS": 1, "SEARCHED": 40, "COMPARED": 60, "ROUNDS": 3}.items():
        monkeypatch.setattr(choices, name, value)


def search(cell: Cell) -> Choice:
    targets = target_poses.test_poses(cell, CHAIN)
    model = Model.assembled(CHAIN, cell)
    return Choice(model, targets, None, Known(), 0, lambda message: None)


def best(cell: Cell) -> Chosen:
    return search(cell).best()


def test_the_tracker_goes_where_its_noise_is_least() -> None:
    """Nearer is better where noise grows with the range."""
    noise = PolarNoise(5e-6, 20e-6, 5e-6, 20e-6)
    box = np.array([[3.0, -2.0, 0.5], [12.0, -2.0, 0.5]])
    cell = plan_cell(
        noise=noise, loads=DOWN[None], test_poses=ONE, poses=6, choose=Freedom(tracker=box)
    )
    far = replace(cell, tracker=replace(cell.tracker, position=np.array([11.0, -2.0, 0.5])))
    found = best(far)
    assert found.places["tracker"][1, 0] == pytest.approx(3.0, abs=0.05)
    assert found.before is not None and found.after < 0.6 * found.before


CHOOSE = """
[design.choose]
load_point_m = [[0.1, -0.1, 0.2], [0.3, 0.1, 0.3]]

[design.choose.markers_m]
M2 = [[-0.2, 0.1, 0.1], [-0.1, 0.3, 0.2]]
"""


def test_the_command_plans_for_what_it_chose_and_writes_the_cell(tmp_path: Path) -> None:
    cell = write_cell(tmp_path, DEFLECTION + CHOOSE)
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
