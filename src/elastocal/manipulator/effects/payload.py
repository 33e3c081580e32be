"""The external load of the table: a dead force at the load point."""

from __future__ import annotations

from elastocal.cell import Cell
from elastocal.manipulator import rigid
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Effect, Symbols


class Payload(Effect):
    """f = (force_x, force_y, force_z) of the row, acting at `load_point_m` of the tool.

    The force is constant in the tracker frame (a hanging weight, a rope over a pulley) and its
    point moves with the arm: V = −f·p_load(θ).  No parameters.
    """

    name = "payload"
    stage = "load"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return ("load",)

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        point = rigid.point(arm.T_tracker_flange, rigid.constant(arm.cell.tool.load_point))
        arm.add_force(point, arm.input("force", 3))
