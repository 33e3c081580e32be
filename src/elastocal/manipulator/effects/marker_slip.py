"""A marker that slips on its mount once."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Symbols
from elastocal.manipulator.effects.driven import DrivenEffect
from elastocal.manipulator.effects.entry import MarkerMotion
from elastocal.manipulator.effects.in_time import after, change_time
from elastocal.manipulator.parameter import ParameterSpec, Setting


class MarkerSlip(DrivenEffect):
    """One marker moves by (slip_x, slip_y, slip_z) in the flange frame for t ≥ T = `slip_time_s`.

    In m.  A reflector that was taken off its magnetic nest and put back, glue that gives way.
    """

    name = "marker_slip"
    stage = "tool"
    needs = ("time",)
    entry = MarkerMotion()

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return tuple(ParameterSpec(f"slip_{k}", "m", 0.0, 1.5e-4) for k in "xyz")

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        return (change_time("slip_time_s"),)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        slip = ca.vertcat(*[p[f"slip_{k}"] for k in "xyz"])
        return slip * after(arm, p["slip_time_s"])
