"""Friction wind-up: where a joint stops depends on where it came from."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Effect, Symbols, index, turning_joints
from elastocal.manipulator.effects.rated_torque import rated_torque, torque_scale
from elastocal.manipulator.effects.torque import add_deflection
from elastocal.manipulator.parameter import ParameterSpec


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
