"""A tracker (or base) that is bumped once."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Symbols
from elastocal.manipulator.effects.base_frame import KEYS
from elastocal.manipulator.effects.driven import DrivenEffect
from elastocal.manipulator.effects.entry import BaseMotion
from elastocal.manipulator.effects.in_time import after, change_time, pose_change
from elastocal.manipulator.parameter import ParameterSpec, Setting


class FrameJump(DrivenEffect):
    """The base, as the tracker sees it, moves by (jump_x … jump_rz) for t ≥ T = `jump_time_s`.

    In m and rad, along the axes of the tracker frame and about the base's origin.  Somebody
    touches the tripod, or the instrument is set up anew and located with an error: every reading
    after T moves rigidly.
    """

    name = "frame_jump"
    stage = "tracker"
    needs = ("time",)
    entry = BaseMotion()

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return ("tracker",)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return pose_change("jump", 1e-4, 5e-5)

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        return (change_time("jump_time_s"),)

    def entered_at(self, place: str, chain: Chain) -> tuple[str, ...]:
        return ("base",)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        jump = ca.vertcat(*[p[f"jump_{k}"] for k in KEYS])
        return jump * after(arm, p["jump_time_s"])
