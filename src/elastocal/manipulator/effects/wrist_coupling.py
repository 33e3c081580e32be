"""Motion of one wrist joint that turns the next ones."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Symbols, joints
from elastocal.manipulator.effects.driven import DrivenEffect
from elastocal.manipulator.effects.entry import JointMotion
from elastocal.manipulator.parameter import ParameterSpec


class WristCoupling(DrivenEffect):
    """δq₅ = a q₄, δq₆ = b q₄ + c q₅ of six joints; of n, the last three.

    Drives of a wrist sit in the forearm and reach their joints through hollow shafts, so that
    turning one joint turns those behind it, which the controller undoes with its coupling
    ratios.  a, b and c (dimensionless) are the errors of those ratios.
    """

    name = "wrist_coupling"
    stage = "transmission"
    entry = JointMotion()

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        turning = chain.n_joints >= 6 and set(chain.kinds[-3:]) == {"revolute"}
        return ("wrist",) if turning else ()

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return tuple(ParameterSpec(f"coupling_{k}", "1", 0.0, 2e-4) for k in "abc")

    def entered_at(self, place: str, chain: Chain) -> tuple[str, ...]:
        return joints(chain)[-2:]

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        n = arm.chain.n_joints
        first, second = arm.q_commanded[n - 3], arm.q_commanded[n - 2]
        return ca.vertcat(
            p["coupling_a"] * first, p["coupling_b"] * first + p["coupling_c"] * second
        )
