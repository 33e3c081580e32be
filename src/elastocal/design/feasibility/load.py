"""Whether the load may hang: rope angle and static joint torques."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.design.feasibility.frames import Poses
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.loads import GravityCompensator
from elastocal.manipulator.symbolic import SymbolicArm
from elastocal.manipulator.tape import Tape

Array = NDArray[np.float64]


def rope_angle(poses: Poses, axis: Array) -> Array:
    """Angle (N,) in rad between the vertical and `axis` (3,), the direction in the flange frame
    in which the rope leaves the tool."""
    turned = poses.flange[:, :3, :3] @ (np.asarray(axis) / np.linalg.norm(axis))
    return np.asarray(np.arctan2(np.hypot(turned[:, 0], turned[:, 1]), -turned[:, 2]))


class StaticTorque:
    """τ = ∂V/∂q (N, n) in N m (N for a prismatic joint): what the joints bear at rest.

    V is the potential of the model's own loads at the rigid pose: the force at the load point,
    the links' weights where `link_gravity` is on, the gravity compensator where the cell has one
    among its effects, at its nominal values.
    """

    def __init__(self, cell: Cell, chain: Chain) -> None:
        kept = tuple(e for e in cell.model.effects if e.name == GravityCompensator.name)
        markers = {"tool": np.zeros(3)}
        symbolic = SymbolicArm(
            chain,
            replace(
                cell,
                tool=replace(cell.tool, markers=markers),
                model=replace(cell.model, effects=kept, observe="position"),
            ),
        )
        arm = symbolic.arm
        torque = ca.gradient(arm.potential, arm.q_commanded)
        self._nominal = np.array([p.nominal for p in symbolic.parameters])
        self._tape = Tape([arm.inputs["q"], arm.inputs["force"], symbolic.p], [torque])

    def __call__(self, poses: Poses) -> Array:
        return self._tape(poses.q, poses.force, self._nominal)[0][..., 0]
