"""A base that settles or warms up while one measures."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Symbols
from elastocal.manipulator.effects.base_frame import KEYS
from elastocal.manipulator.effects.driven import DrivenEffect
from elastocal.manipulator.effects.entry import BaseMotion
from elastocal.manipulator.effects.in_time import TIME_CONSTANT, pose_change, warm_up
from elastocal.manipulator.parameter import ParameterSpec, Setting


class BaseDrift(DrivenEffect):
    """The base moves by d (1 − exp(−t/T)), d = (drift_x … drift_rz) in m and rad.

    Along the axes of the tracker frame and about the base's origin; T is `time_constant_s`.  A
    pedestal that warms up or settles on its grout, or a tracker whose tripod does the same: only
    fixed reflectors beside the arm can tell the two apart.
    """

    name = "base_drift"
    stage = "tracker"
    needs = ("time",)
    entry = BaseMotion()

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return pose_change("drift", 5e-5, 5e-5)

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        return (TIME_CONSTANT,)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        return ca.vertcat(*[p[f"drift_{k}"] for k in KEYS]) * warm_up(arm, p)
