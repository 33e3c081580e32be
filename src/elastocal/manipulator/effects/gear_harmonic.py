"""A gear error that repeats with the joint's angle: one harmonic of it."""

from __future__ import annotations

from typing import ClassVar

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Symbols, index, turning_joints
from elastocal.manipulator.effects.driven import DrivenEffect
from elastocal.manipulator.effects.entry import JointMotion
from elastocal.manipulator.parameter import ParameterSpec


class GearHarmonic(DrivenEffect):
    """δq = a sin Nq + b cos Nq with the commanded joint angle q; a and b in rad.

    A subclass states the order N, the prefix of its two parameters' keys and their typical size.
    """

    stage = "transmission"
    entry = JointMotion()
    prefix: ClassVar[str]
    typical: ClassVar[float]

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return turning_joints(chain)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return tuple(
            ParameterSpec(f"{self.prefix}_{part}", "rad", 0.0, self.typical)
            for part in ("sin", "cos")
        )

    def order(self, p: Symbols) -> ca.SX:
        """N: periods of the error in one turn of the joint."""
        raise NotImplementedError

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        phase = self.order(p) * arm.q_commanded[index(place)]
        return p[f"{self.prefix}_sin"] * ca.sin(phase) + p[f"{self.prefix}_cos"] * ca.cos(phase)
