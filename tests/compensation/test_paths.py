"""Along a path neighbours have neighbouring joints, and a change of branch is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from support.cells import DOWN, kr270_cell, kr270_chain
from support.commands import calibrated

from elastocal.compensation.commands import nominal_path, targets_at
from elastocal.compensation.compensate import compensate
from elastocal.model.calibrated import tool_point
from elastocal.model.chain import joint_limits
from elastocal.model.rigid import nominal_flanges

HOME = np.radians([0, -90, 90, 0, 40, 0])
PLACE = np.array([0.1, 0.0, 0.2])


def circle(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A circle of 0.3 m about where the tool is at home, with the tool's rotation kept."""
    T = nominal_flanges(kr270_chain(), HOME[None])[0]
    angle = np.linspace(0, 2 * np.pi, n)
    ring = 0.3 * np.column_stack([0 * angle, np.cos(angle), np.sin(angle)])
    return T[:3, 3] + T[:3, :3] @ PLACE + ring, np.tile(T[:3, :3], (n, 1, 1))


def test_a_closed_path_is_followed_in_one_posture() -> None:
    chain = kr270_chain()
    cell = kr270_cell(("joint_compliance",))
    position, rotation = circle(2000)
    arm = calibrated(chain, cell)
    targets = targets_at("path", position, rotation, "base", DOWN)
    found = compensate(arm, targets, tool_point(cell, "0.1,0,0.2"), near=HOME)
    assert found.reached.all()
    assert np.abs(np.diff(found.q, axis=0)).max() < 0.01
    assert np.abs(found.q[-1] - found.q[0]).max() < 1e-9
    assert not found.warnings


def test_given_joints_that_jump_are_told() -> None:
    chain = kr270_chain()
    cell = kr270_cell(("joint_compliance",))
    position, rotation = circle(40)
    arm = calibrated(chain, cell)
    point = tool_point(cell, "0.1,0,0.2")
    targets = targets_at("path", position, rotation, "base", DOWN)
    smooth = compensate(arm, targets, point, near=HOME)
    q = smooth.nominal.copy()
    # The other posture of the wrist: q4 + 180°, −q5, q6 + 180° is the same pose.
    q[20:] = q[20:] * [1, 1, 1, 1, -1, 1] + np.array([0, 0, 0, np.pi, 0, -np.pi])
    found = compensate(arm, replace(targets, q=q), point)
    assert found.reached.all()
    told = [text for text in found.warnings if "solution branch changes" in text]
    assert len(told) == 1 and told[0].startswith("path, line 21:")


def test_scattered_places_are_reached_in_the_nearest_posture() -> None:
    chain = kr270_chain()
    limits = joint_limits(kr270_cell(), chain)
    q = HOME + np.radians([[0, 0, 0, 0, 0, 0], [50, 20, -30, 10, 20, 60], [-60, -10, 20, 5, 10, 0]])
    T = nominal_flanges(chain, q)
    position = T[:, :3, 3] + T[:, :3, :3] @ PLACE
    found, reached = nominal_path(chain, position, T[:, :3, :3], PLACE, limits, HOME)
    assert reached.all()
    assert np.allclose(found, q, atol=1e-5)


def test_a_place_out_of_reach_does_not_stop_the_path() -> None:
    chain = kr270_chain()
    limits = joint_limits(kr270_cell(), chain)
    position, rotation = circle(30)
    position[10] = [9.0, 0.0, 0.0]
    q, reached = nominal_path(chain, position, rotation, PLACE, limits, HOME)
    assert np.flatnonzero(~reached).tolist() == [10]
    assert np.abs(q[11] - q[9]).max() < 0.2
