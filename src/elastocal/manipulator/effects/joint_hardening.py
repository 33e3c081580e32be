"""A joint that stiffens (or softens) with its torque."""

from __future__ import annotations

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Symbols, index, turning_joints
from elastocal.manipulator.effects.joint_compliance import nominal_compliance
from elastocal.manipulator.effects.rated_torque import rated_torque
from elastocal.manipulator.effects.torque import TorqueEffect, add_deflection
from elastocal.manipulator.parameter import ParameterSpec


class JointHardening(TorqueEffect):
    """δq = k₃ τ³ besides the linear k τ; k₃ in rad/(N m)³, negative where the joint stiffens.

    Teeth and bearings carry more of their surface the harder they are pressed (Hertz: the
    contact's deflection grows with a power below one of the load), so that strain-wave and
    cycloidal gears stiffen with torque; the cubic is the first odd term after the linear one.
    Typical: 20 % of the linear deflection at the rated torque.
    """

    name = "joint_hardening"
    stage = "compliance"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return turning_joints(chain)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        given = nominal_compliance(chain, cell)
        rated = rated_torque(chain, cell, index(place))
        typical = 0.2 * given[index(place)] / rated**2 if given and rated else None
        return (ParameterSpec("hardening", "rad/(N*m)^3", 0.0, typical or None),)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        k3 = p["hardening"]
        add_deflection(arm, index(place), f"{place}.hardening", lambda tau: k3 * tau**3)
