"""Scale error of a joint's encoder or gear ratio."""

from __future__ import annotations

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Effect, Symbols, index, joints
from elastocal.manipulator.parameter import ParameterSpec


class EncoderScale(Effect):
    """δq = a·q with the commanded joint value q; a is dimensionless."""

    name = "encoder_scale"
    stage = "transmission"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return joints(chain)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return (ParameterSpec("encoder_scale", "1", 0.0, 3e-4),)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        i = index(place)
        arm.q[i] += p["encoder_scale"] * arm.q_commanded[i]
