"""Joints that come to rest elsewhere: play, and friction behind the encoder."""

from __future__ import annotations

import casadi as ca

from elastocal.cell.work_cell import Cell
from elastocal.model.arm import Arm, ParameterSpec
from elastocal.model.chain import Chain
from elastocal.model.effects.base import Effect, Symbols, index, turning_joints
from elastocal.model.effects.compliances import (
    TorqueEffect,
    add_deflection,
    rated_torque,
    torque_scale,
)

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


class Hysteresis(Effect):
    """δq = a (h + g |τ|), a = ±1 the direction of the joint's last motion.

    h in rad, g in rad/(N m).  Dry friction behind the encoder keeps the drive train wound up
    after it stops; friction grows with the load τ on the teeth and bearings, hence g.  |τ| is
    smooth: √(τ² + τ_s²) − τ_s with τ_s a thousandth of the joint's rated torque.
    """

    name = "hysteresis"
    stage = "transmission"
    needs = ("approach",)

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return turning_joints(chain)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        size = 5e-5
        rated = rated_torque(chain, cell, index(place))
        growth = size / rated if rated else None
        return (
            ParameterSpec("hysteresis", "rad", 0.0, size),
            ParameterSpec("hysteresis_per_torque", "rad/(N*m)", 0.0, growth),
        )

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        i = index(place)
        scale = torque_scale(arm.chain, arm.cell, i)
        direction = arm.input("approach", arm.chain.n_joints)[i]

        def law(tau: ca.SX) -> ca.SX:
            magnitude = ca.sqrt(tau**2 + scale**2) - scale
            return direction * (p["hysteresis"] + p["hysteresis_per_torque"] * magnitude)

        add_deflection(arm, i, f"{place}.hysteresis", law)
