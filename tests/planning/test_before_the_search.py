"""What is told or set apart before candidates are drawn."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.cells import DOWN, kr270_chain, random_poses
from support.design_cells import plan_cell, setup_of

from elastocal.cell.plan_wishes import Motion
from elastocal.cell.work_cell import Solid, Workspace
from elastocal.errors import InputError
from elastocal.planning.checkpoint import Checkpoint
from elastocal.planning.design import DesignOptions, _Design

HOME = np.radians([0.0, -90, 90, 0, 0, 0])


def begun(cell: Any, **options: Any) -> _Design:
    return _Design(cell, DesignOptions(**options), Checkpoint(), lambda text: None)


def test_a_home_in_collision_is_named_at_once() -> None:
    everywhere = Solid("pillar", "box", np.full(3, 6.0), np.eye(4))
    space = Workspace(obstacles=(everywhere,), link_radius=(0.1,) * 6, self_collision=False)
    cell = replace(plan_cell(loads=DOWN[None], motion=Motion(home=HOME)), workspace=space)
    with pytest.raises(InputError, match=r"\[design.motion\] home brings .*pillar.* too close"):
        begun(cell)


def test_a_cell_with_a_drift_can_be_planned_for_and_what_is_held_is_said() -> None:
    cell = plan_cell(("joint_compliance", "base_drift"), loads=DOWN[None])
    found = begun(cell, fixed=("base_drift", "joint1"))
    assert [choice.name for choice in found.model.cell.model.effects] == ["joint_compliance"]
    assert found.options.fixed == ("joint1",)
    (told,) = found.warnings
    assert "time and order alone show base_drift" in told
    assert found.conditions is not None and found.conditions[1] == ("base_drift", "joint1")
    warm = plan_cell(
        ("joint_compliance", "thermal_expansion"), model={"thermal_driver": "temperature"},
        loads=DOWN[None],
    )  # fmt: skip
    (told,) = begun(warm).warnings
    assert "holds thermal_expansion at nominal" in told and "reference poses" in told


def test_parameters_that_no_load_shows_are_told_of_once() -> None:
    cell = plan_cell(("base_frame", "joint_offset", "joint_compliance"), "position")
    (told,) = setup_of(cell, random_poses(kr270_chain(), 40, seed=1)).warnings
    assert "joint1.compliance" in told and "state a load" in told
