"""Zero offset of a joint's encoder."""

from __future__ import annotations

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Effect, Symbols, index, joints, motion_unit
from elastocal.manipulator.parameter import ParameterSpec


class JointOffset(Effect):
    """δq = a: the joint's zero differs from nominal by a (rad, or m for a prismatic joint)."""

    name = "joint_offset"
    stage = "transmission"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return joints(chain)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return (ParameterSpec("offset", motion_unit(place, chain), 0.0, 1e-3),)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        arm.q[index(place)] += p["offset"]
