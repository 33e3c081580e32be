"""A joint's reference that creeps while the arm warms up."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Symbols, motion_unit
from elastocal.manipulator.effects.driven import DrivenEffect
from elastocal.manipulator.effects.entry import JointMotion
from elastocal.manipulator.effects.in_time import TIME_CONSTANT, warm_up
from elastocal.manipulator.parameter import ParameterSpec, Setting


class JointDrift(DrivenEffect):
    """δq = d (1 − exp(−t/T)): the joint's reference has moved by d (rad or m) once warm.

    Gears and encoder mounts warm up with the motor beside them and shift the joint's zero; t is
    the table's time from its origin, T the setting `time_constant_s`.  Measurements that begin
    warm leave a drift that a constant offset takes up.
    """

    name = "joint_drift"
    stage = "transmission"
    needs = ("time",)
    entry = JointMotion()

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return (ParameterSpec("drift", motion_unit(place, chain), 0.0, 1e-4),)

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        return (TIME_CONSTANT,)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        return p["drift"] * warm_up(arm, p)
