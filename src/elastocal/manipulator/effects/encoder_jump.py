"""A joint's reference that jumps once."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Symbols, motion_unit
from elastocal.manipulator.effects.driven import DrivenEffect
from elastocal.manipulator.effects.entry import JointMotion
from elastocal.manipulator.effects.in_time import after, change_time
from elastocal.manipulator.parameter import ParameterSpec, Setting


class EncoderJump(DrivenEffect):
    """δq = d for t ≥ T: the joint's reference jumps by d (rad or m) at T = `jump_time_s`.

    A belt that skips a tooth, a coupling that slips, an encoder that loses counts or is
    referenced anew in the middle of a campaign.
    """

    name = "encoder_jump"
    stage = "transmission"
    needs = ("time",)
    entry = JointMotion()

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return (ParameterSpec("jump", motion_unit(place, chain), 0.0, 1e-4),)

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        return (change_time("jump_time_s"),)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        return p["jump"] * after(arm, p["jump_time_s"])
