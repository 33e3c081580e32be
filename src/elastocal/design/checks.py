"""Does what the cell asks of a plan fit the robot?  Checked once, before anything is designed."""

from __future__ import annotations

from collections.abc import Sized

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.config import place
from elastocal.errors import InputError, require
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.inputs import LEVEL_TOLERANCE
from elastocal.manipulator.limits import joint_index, joint_limits

Array = NDArray[np.float64]

LIMIT_SLACK = 1e-6  # rad or m: what rounding to printed digits may push over a limit


def check_cell(cell: Cell, chain: Chain) -> None:
    """Numbers of joints, links, and joint values of [workspace] and [design].

    Raises InputError that names the key, what was found and what to do.
    """
    _check_workspace(cell, chain)
    _check_levels(cell, chain)
    _check_motion(cell, chain)
    for k, pose in enumerate(cell.design.test_poses):
        key = place("design", "test_pose", k, "q_deg" if pose.degrees else "q_si")
        check_posture(cell, chain, key, pose.q, pose.degrees)


def check_posture(cell: Cell, chain: Chain, key: str, q: Array, degrees: bool) -> None:
    """A posture q (n,) that `key` states: number of joints, their unit, their limits."""
    _check_count(cell, chain, key, q)
    if degrees:
        _check_revolute(cell, chain, key)
    problem = beyond_limits(cell, chain, q)
    require(
        problem is None,
        f"{cell.path or cell.name}: key {key}: {problem}; correct the posture or the limits",
    )


def beyond_limits(cell: Cell, chain: Chain, q: Array) -> str | None:
    """Which joint of the posture q (n,) lies beyond its limits, as a sentence; None for none."""
    lower, upper = joint_limits(cell, chain)
    beyond = np.flatnonzero((q < lower - LIMIT_SLACK) | (q > upper + LIMIT_SLACK))
    if not len(beyond):
        return None
    j = int(beyond[0])
    low, high = _told(chain, j, lower[j]), _told(chain, j, upper[j])
    return (
        f"joint{j + 1} ({chain.joints[j].name}) at {_told(chain, j, q[j])} is beyond its limits, "
        f"{low} to {high}"
    )


def _told(chain: Chain, j: int, value: float) -> str:
    if chain.kinds[j] == "revolute":
        return f"{np.degrees(value):.6g}°"
    return f"{value:.6g} m"


def _check_count(cell: Cell, chain: Chain, key: str, found: Sized, one: bool = False) -> None:
    """One number per joint, or where `one` allows it a single number for all."""
    n = chain.n_joints
    if len(found) != n and not (one and len(found) == 1):
        raise InputError(
            f"{cell.path or cell.name}: key {key} has {len(found)} numbers, but robot "
            f"'{chain.name}' has {n} joints; give {n} numbers{' or one for all' if one else ''}"
        )


def _check_revolute(cell: Cell, chain: Chain, key: str) -> None:
    sliding = [k for k, kind in enumerate(chain.kinds) if kind == "prismatic"]
    if sliding:
        other = key.replace("deg_per_s", "si").replace("_deg", "_si")
        raise InputError(
            f"{cell.path or cell.name}: key {key} gives degrees, but joint{sliding[0] + 1} "
            f"({chain.joints[sliding[0]].name}) is prismatic; use {other}, in rad and m"
        )


def _check_workspace(cell: Cell, chain: Chain) -> None:
    space, n = cell.workspace, chain.n_joints
    if space.link_radius:
        _check_count(cell, chain, "workspace.link_radius_mm", space.link_radius, one=True)
    if space.torque_limits:
        _check_count(cell, chain, "workspace.torque_limits_Nm", space.torque_limits)
    links = {f"link{i}" for i in range(1, n + 1)}
    for k, body in enumerate(space.bodies):
        if body.on.startswith("link") and body.on not in links:
            raise InputError(
                f"{cell.path or cell.name}: key {place('workspace', 'body', k, 'on')} is "
                f"'{body.on}', but robot '{chain.name}' has {n} moving links, link1 to link{n}"
            )


def _check_levels(cell: Cell, chain: Chain) -> None:
    lower, upper = joint_limits(cell, chain)
    for joint, values in cell.design.levels.items():
        i = joint_index(cell, chain, joint, "[design.levels]")
        split = cell.model.compliance_levels.get(joint)
        for value in values:
            require(
                lower[i] - LIMIT_SLACK <= value <= upper[i] + LIMIT_SLACK,
                f"{cell.path or cell.name}: [design.levels] has {joint} at "
                f"{_told(chain, i, value)}, beyond its limits, {_told(chain, i, lower[i])} to "
                f"{_told(chain, i, upper[i])}; correct the level or the limits",
            )
            require(
                split is None or min(abs(value - s) for s in split) <= LEVEL_TOLERANCE,
                f"{cell.path or cell.name}: [design.levels] has {joint} at "
                f"{_told(chain, i, value)}, which is none of its levels in "
                "[model.compliance_levels]; give both the same levels",
            )


def _check_motion(cell: Cell, chain: Chain) -> None:
    motion = cell.design.motion
    unit = "deg" if motion.degrees else "si"
    if motion.speed is not None:
        key = "design.motion.speed_" + ("deg_per_s" if motion.degrees else "si")
        _check_count(cell, chain, key, motion.speed, one=motion.degrees)
        if motion.degrees:
            _check_revolute(cell, chain, key)
    if motion.home is not None:
        check_posture(cell, chain, f"design.motion.home_{unit}", motion.home, motion.degrees)
