"""Elastic compliance of a joint about (or along) its own axis."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.errors import require
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Symbols, index, joints
from elastocal.manipulator.effects.torque import TorqueEffect, add_deflection
from elastocal.manipulator.parameter import ParameterSpec


def nominal_compliance(chain: Chain, cell: Cell) -> tuple[float, ...] | None:
    """The cell's nominal compliances, one per joint; InputError where their number is another."""
    given = cell.model.nominal.joint_compliance
    require(
        given is None or len(given) == chain.n_joints,
        f"[model.nominal] joint_compliance has {len(given or ())} values, "
        f"but the arm has {chain.n_joints} joints; give one per joint",
    )
    return given


class JointCompliance(TorqueEffect):
    """δq_j = k_j τ_j, k_j in rad/(N m) (m/N for a prismatic joint).

    τ_j is the load's torque about the joint axis, either computed at the deflected pose from
    the load, link weights and compensator, or taken from the table (`torque = "measured"`:
    the torque that the load exerts on the joint, positive along +q).

    Where the cell splits a joint by levels (`[model.compliance_levels]`), the compliance is
    one independent value k_ji per level, as in Klimchik et al. 2013, section 5.
    """

    name = "joint_compliance"
    stage = "compliance"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return joints(chain)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        i = index(place)
        unit = "rad/(N*m)" if chain.kinds[i] == "revolute" else "m/N"
        given = nominal_compliance(chain, cell)
        nominal = 0.0 if given is None else float(given[i])
        typical = abs(nominal) or None
        levels = cell.model.compliance_levels.get(place)
        if levels is None:
            return (ParameterSpec("compliance", unit, nominal, typical, lower=0.0),)
        return tuple(
            ParameterSpec(f"compliance_level{n + 1}", unit, nominal, typical, lower=0.0)
            for n in range(len(levels))
        )

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        i = index(place)
        levels = arm.cell.model.compliance_levels.get(place)
        if levels is None:
            k = p["compliance"]
        else:
            chosen = arm.input(f"level:{place}", len(levels))
            values = ca.vertcat(*[p[f"compliance_level{n + 1}"] for n in range(len(levels))])
            k = ca.dot(chosen, values)
        add_deflection(arm, i, place, lambda tau: k * tau)
