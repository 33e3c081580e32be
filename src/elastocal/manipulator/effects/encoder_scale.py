"""Scale error of a joint's encoder or gear ratio."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Symbols, index
from elastocal.manipulator.effects.driven import DrivenEffect
from elastocal.manipulator.effects.entry import JointMotion
from elastocal.manipulator.parameter import ParameterSpec


class EncoderScale(DrivenEffect):
    """δq = a·q with the commanded joint value q; a is dimensionless."""

    name = "encoder_scale"
    stage = "transmission"
    entry = JointMotion()

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return (ParameterSpec("encoder_scale", "1", 0.0, 3e-4),)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        return p["encoder_scale"] * arm.q_commanded[index(place)]
