"""Tilt of the pedestal under load."""

from __future__ import annotations

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm, Spring
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Symbols
from elastocal.manipulator.effects.joint_compliance import nominal_compliance
from elastocal.manipulator.effects.torque import LoadedEffect
from elastocal.manipulator.parameter import ParameterSpec

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0)}


class BaseCompliance(LoadedEffect):
    """Tilt of the base about its x and y axes, θ = k M, M the load's moment at the base origin.

    Pedestals, anchor bolts and floors give way under the overturning moment; k in rad/(N m).
    Typical: 10 % of the compliance of joint 1.
    """

    name = "base_compliance"
    stage = "compliance"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return ("base",)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        given = nominal_compliance(chain, cell)
        typical = 0.1 * given[0] or None if given and chain.kinds[0] == "revolute" else None
        return tuple(
            ParameterSpec(f"tilt_compliance_{a}", "rad/(N*m)", 0.0, typical, lower=0.0)
            for a in AXES
        )

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        for name, axis in AXES.items():
            k = p[f"tilt_compliance_{name}"]
            arm.add_spring(Spring.linear(f"base.{name}", "base", "revolute", axis, k))
