"""Commands take an arm in MuJoCo, which shares no mechanics with the model, to its targets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cells import COMPLIANCE, DOWN, LOAD_POINT, kr270_cell, kr270_chain
from support.commands import calibrated
from support.elastic_arms import MujocoArm

from elastocal.compensation.commands import targets_at
from elastocal.compensation.compensate import compensate
from elastocal.model.calibrated import tool_point
from elastocal.model.rigid import nominal_flanges

POSTURES = np.radians(
    [[10, -80, 90, 30, 50, -20], [-60, -60, 60, -80, 60, 100], [80, -110, 100, 120, -70, -150]]
)
TOOL = np.array([0.25, 0.0, 0.0])


def test_the_tool_of_another_simulator_goes_to_the_target() -> None:
    pytest.importorskip("mujoco")
    chain = kr270_chain()
    cell = kr270_cell(("joint_offset", "joint_compliance"))
    arm = calibrated(chain, cell)
    offset = 1e-3 * np.array([0.5, -1.0, 0.8, -0.7, 1.2, 0.4])
    x = arm.x.copy()
    for i, value in enumerate(offset):
        x[arm.model.names.index(f"joint{i + 1}.offset")] = value
    found = compensate(
        replace(arm, x=x),
        targets_at("t", None, None, "base", DOWN, q=POSTURES),
        tool_point(cell, "M1"),
    )
    assert found.reached.all()
    T = nominal_flanges(chain, POSTURES)
    wanted = T[:, :3, 3] + T[:, :3, :3] @ TOOL
    real = MujocoArm(chain, COMPLIANCE, LOAD_POINT, {"M1": TOOL})

    def error(q: np.ndarray) -> np.ndarray:
        rest = [real.equilibrium(pose + offset, DOWN) for pose in q]
        return np.linalg.norm([real.markers(r)["M1"] for r in rest] - wanted, axis=1)

    assert error(POSTURES).min() > 1e-3
    assert error(found.q).max() < 1e-7
