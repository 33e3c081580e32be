"""A payload that is not what was declared."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator import rigid
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Effect, Symbols
from elastocal.manipulator.parameter import ParameterSpec


class PayloadError(Effect):
    """The row's force f acts as (1 + s) f at `load_point_m` + d; s (1), d (3,) m, flange frame.

    The weight was not weighed, or the hook hangs elsewhere than drawn.  Adds to the declared
    load's potential −f·p(θ) what is missing: V = −f·(s p + (1 + s) R d), R the flange's rotation.
    """

    name = "payload_error"
    stage = "load"
    needs = ("load",)

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return ("load",)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return (
            ParameterSpec("payload_scale", "1", 0.0, 0.02),
            *(ParameterSpec(f"load_point_{k}", "m", 0.0, 0.01) for k in "xyz"),
        )

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        force, T = arm.input("force", 3), arm.T_tracker_flange
        scale = p["payload_scale"]
        shift = ca.vertcat(*[p[f"load_point_{k}"] for k in "xyz"])
        arm.add_force(rigid.point(T, rigid.constant(arm.cell.tool.load_point)), scale * force)
        arm.add_potential(-(1 + scale) * ca.dot(force, T[:3, :3] @ shift))
