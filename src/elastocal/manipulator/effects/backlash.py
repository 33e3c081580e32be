"""Play between the teeth: the load decides on which flank they rest."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Symbols, index, turning_joints
from elastocal.manipulator.effects.rated_torque import torque_scale
from elastocal.manipulator.effects.torque import TorqueEffect, add_deflection
from elastocal.manipulator.parameter import ParameterSpec


class Backlash(TorqueEffect):
    """δq = (β/2) tanh(τ/τ_s): the joint rests at the end of its play that the load τ drives it to.

    β in rad is the whole play.  tanh is sgn with the dead zone |τ| < τ_s in which friction and
    the balance of the teeth leave the joint between both flanks: a thousandth of its rated
    torque.  τ is the torque of all loads that the model has; where the links' weights decide the
    side, switch `link_gravity` on.
    """

    name = "backlash"
    stage = "transmission"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return turning_joints(chain)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return (ParameterSpec("backlash", "rad", 0.0, 2e-4, lower=0.0),)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        i = index(place)
        scale = torque_scale(arm.chain, arm.cell, i)
        play = p["backlash"]
        add_deflection(arm, i, f"{place}.backlash", lambda tau: play / 2 * ca.tanh(tau / scale))
