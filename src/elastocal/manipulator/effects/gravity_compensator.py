"""A spring that balances the arm's weight: between two anchor points across one joint."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Effect, Symbols, index, joints
from elastocal.manipulator.parameter import ParameterSpec

# Rough geometry of a KR 270 compensator: an example to start from, to be identified.
EXAMPLE: dict[str, Any] = {
    "stiffness_N_per_m": 0.0,
    "anchor_m": (0.686, 0.120),
    "arm_m": 0.185,
    "free_length_m": 0.458,
}


class GravityCompensator(Effect):
    """Spring of stiffness K_c and free length s₀ acting at arm L, anchored at (a_x, a_y).

    s² = a² + L² + 2 a L cos(α − q), a = |(a_x, a_y)|, α = atan2(a_y, a_x), V = ½ K_c (s − s₀)²,
    hence the torque M = −K_c (1 − s₀/s) a L sin(α − q) about the joint, taken at the deflected
    angle (Klimchik et al. 2013, section 5).  Geometry comes from `[model.nominal]
    gravity_compensator`; without it an example geometry and zero stiffness are the start.
    """

    name = "gravity_compensator"
    stage = "load"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        given = cell.model.nominal.gravity_compensator
        return joints(chain)[1:2] if given is None else (str(given["joint"]),)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        given = EXAMPLE | (cell.model.nominal.gravity_compensator or {})
        anchor_x, anchor_y = given["anchor_m"]
        stiffness = float(given["stiffness_N_per_m"])
        return (
            ParameterSpec("compensator_stiffness", "N/m", stiffness, abs(stiffness) or None),
            ParameterSpec("compensator_anchor_x", "m", float(anchor_x), 1e-2),
            ParameterSpec("compensator_anchor_y", "m", float(anchor_y), 1e-2),
            ParameterSpec("compensator_arm", "m", float(given["arm_m"]), 1e-2),
            ParameterSpec("compensator_free_length", "m", float(given["free_length_m"]), 1e-2),
        )

    def starts(self, place: str, chain: Chain, cell: Cell) -> tuple[dict[str, float], ...]:
        if cell.model.nominal.gravity_compensator is not None:
            return ()
        x, y = EXAMPLE["anchor_m"]
        turns = np.radians(np.arange(0, 360, 30))
        return tuple(
            {
                "compensator_anchor_x": float(np.cos(t) * x - np.sin(t) * y),
                "compensator_anchor_y": float(np.sin(t) * x + np.cos(t) * y),
            }
            for t in turns
        )

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        q = arm.joint_angle(index(place))
        ax, ay, L = p["compensator_anchor_x"], p["compensator_anchor_y"], p["compensator_arm"]
        s = ca.sqrt(ax**2 + ay**2 + L**2 + 2 * L * (ax * ca.cos(q) + ay * ca.sin(q)))
        stretch = s - p["compensator_free_length"]
        arm.add_potential(p["compensator_stiffness"] * stretch**2 / 2)
