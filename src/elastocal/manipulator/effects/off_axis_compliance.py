"""Compliance of a joint's bearing across its axis."""

from __future__ import annotations

import numpy as np

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm, Spring
from elastocal.manipulator.chain import Array, Chain
from elastocal.manipulator.effects.base import Symbols, index, joints
from elastocal.manipulator.effects.joint_compliance import nominal_compliance
from elastocal.manipulator.effects.torque import LoadedEffect
from elastocal.manipulator.parameter import ParameterSpec


def transverse_axes(axis: Array) -> tuple[Array, Array]:
    """Two unit axes x, y with x × y = axis; the frame's own x and y where the axis is z.

    x is the coordinate axis farthest from the joint axis that comes first, made orthogonal.
    """
    start = np.eye(3)[int(np.argmin(np.abs(axis).round(9)))]
    x = start - axis * (axis @ start)
    x /= np.linalg.norm(x)
    return x, np.cross(axis, x)


class OffAxisCompliance(LoadedEffect):
    """Tilt of the joint about its two transverse axes, θ_x = k_x M_x and θ_y = k_y M_y.

    M_x, M_y are the transverse moments of the load at the joint; the axes are fixed to the
    proximal link (the bearing's housing).  Typical: 5 to 20 % of the drive's compliance.
    """

    name = "off_axis_compliance"
    stage = "compliance"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return joints(chain)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        given = nominal_compliance(chain, cell)
        typical = 0.2 * given[index(place)] if given else None
        return tuple(
            ParameterSpec(f"off_axis_compliance_{a}", "rad/(N*m)", 0.0, typical, lower=0.0)
            for a in "xy"
        )

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        axes = transverse_axes(arm.chain.joints[index(place)].axis)
        for name, axis in zip("xy", axes, strict=True):
            k = p[f"off_axis_compliance_{name}"]
            arm.add_spring(Spring.linear(f"{place}.{name}", place, "revolute", axis, k))
