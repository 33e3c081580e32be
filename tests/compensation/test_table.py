"""A correction added to a nominal target leads the real tool to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import DOWN, kr270_cell, kr270_chain
from support.commands import calibrated, erring, tool_errors

from elastocal.compensation.commands import targets_at
from elastocal.compensation.compensate import compensate
from elastocal.compensation.correction_table import (
    EXACT,
    CorrectionGrid,
    correction_table,
    joint_grid,
)
from elastocal.errors import InputError
from elastocal.model.calibrated import tool_point
from elastocal.model.rigid import nominal_flanges

EFFECTS = ("joint_offset", "link_geometry", "joint_compliance")
LOW = np.radians([-30, -110, 60, -20, 40, -20])
HIGH = np.radians([30, -70, 100, 20, 80, 20])


def arm_and_point():
    cell = kr270_cell(EFFECTS)
    arm = calibrated(kr270_chain(), cell)
    arm = replace(arm, x=erring(arm.model, np.random.default_rng(8), 0.5))
    return arm, tool_point(cell, "M1")


def joint_box(counts) -> CorrectionGrid:
    axes = zip(LOW, HIGH, counts, strict=True)
    return CorrectionGrid(tuple(np.linspace(a, b, n) if n > 1 else np.array([(a + b) / 2])
                      for a, b, n in axes), True)  # fmt: skip


def test_corrected_targets_are_reached_by_the_nominal_arm() -> None:
    arm, point = arm_and_point()
    found = correction_table(arm, joint_box((2, 2, 1, 1, 2, 1)), point, DOWN)
    assert set(found.status) == {EXACT}
    T = nominal_flanges(arm.model.chain, found.points)
    place = T[:, :3, 3] + T[:, :3, :3] @ arm.model.cell.tool.markers["M1"]
    turned = Rotation.from_rotvec(found.correction[:, 3:]).as_matrix() @ T[:, :3, :3]
    # A rigid, nominal arm stands for the controller.
    rigid = kr270_cell(())
    controller = compensate(
        calibrated(arm.model.chain, rigid),
        targets_at("t", place + found.correction[:, :3], turned, "base", q=found.points),
        tool_point(rigid, "M1"),
    )
    assert controller.reached.all()
    real = compensate(arm, targets_at("t", None, None, "base", DOWN, q=found.points), point)
    miss, turn = tool_errors(arm, replace(real, q=controller.q))
    assert miss.max() < 1e-7 and turn.max() < 1e-7


@pytest.mark.parametrize(
    ("counts", "told"),
    [((5, 5), "one per joint"), ((0,), "1 or more"), ((30,), "points, and")],
)
def test_a_grid_that_cannot_be_is_refused(counts, told) -> None:
    with pytest.raises(InputError, match=told):
        joint_grid(arm_and_point()[0], counts)


def test_a_grid_in_singular_postures_is_told_with_the_joint_at_fault() -> None:
    arm, point = arm_and_point()
    axes = list(joint_box((2, 2, 2, 1, 1, 1)).axes)
    assert correction_table(arm, CorrectionGrid(tuple(axes), True), point, DOWN).warnings == ()
    axes[4] = np.zeros(1)
    found = correction_table(arm, CorrectionGrid(tuple(axes), True), point, DOWN)
    (told,) = found.warnings
    assert told.startswith("only 0 of 8 grid points are exact")
    assert "singular by the levels of q5_deg = 0;" in told and "q4" not in told and "q6" not in told
