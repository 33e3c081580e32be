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

FRICTION = 3.0  # times τ_s: the load's torque that friction holds up


class Backlash(TorqueEffect):
    """δq = (β/2) tanh(τ/τ_s): the joint rests at the end of its play that the load τ drives it to.

    β in rad is the whole play.  tanh is sgn with the dead zone |τ| < τ_s in which friction and
    the balance of the teeth leave the joint between both flanks: a thousandth of its rated torque.
    Where the table says from which side a joint came ([model] play_side = "load_and_approach"),
    δq = (β/2) tanh((τ − a τ_f)/τ_s): a load below the friction τ_f = 3 τ_s does not turn the
    teeth, and the joint lags behind its last motion a = ±1.  τ is the torque of all loads that the
    model has; where the links' weights decide the side, switch `link_gravity` on.
    """

    name = "backlash"
    stage = "transmission"

    def needed(self, cell: Cell) -> tuple[str, ...]:
        sided = cell.model.play_side == "load_and_approach"
        return (*super().needed(cell), "approach") if sided else super().needed(cell)

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return turning_joints(chain)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return (ParameterSpec("backlash", "rad", 0.0, 2e-4, lower=0.0),)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        i = index(place)
        scale = torque_scale(arm.chain, arm.cell, i)
        play = p["backlash"]
        held: ca.SX | float = 0.0
        if arm.cell.model.play_side == "load_and_approach":
            held = FRICTION * scale * arm.input("approach", arm.chain.n_joints)[i]

        def law(tau: ca.SX) -> ca.SX:
            return play / 2 * ca.tanh((tau - held) / scale)

        add_deflection(arm, i, f"{place}.backlash", law)
