"""Rigid transforms as URDF writes them."""

from __future__ import annotations

import math

from elastocal.manipulator.chain import Array
from elastocal.simulation.mjcf import numbers


def rpy(R: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw in rad with R = Rz(yaw) Ry(pitch) Rx(roll), the URDF's convention.

    Yaw is taken first and undone in the other two, so that all three are exact to rounding at
    pitch = ±π/2 as well, where the textbook formula divides 0 by 0.
    """
    yaw = math.atan2(R[1, 0], R[0, 0])
    c, s = math.cos(yaw), math.sin(yaw)
    pitch = math.atan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = math.atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return roll, pitch, yaw


def origin_attributes(T: Array) -> dict[str, str]:
    """xyz and rpy of an <origin> for a transform (4, 4)."""
    return {"xyz": numbers(T[:3, 3]), "rpy": numbers(rpy(T[:3, :3]))}
