"""How the measured target is turned on the flange, for full-pose measurements."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator import rigid
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Effect, Symbols
from elastocal.manipulator.parameter import ParameterSpec


class MarkerOrientation(Effect):
    """R_flange_target = exp([rx, ry, rz]×), rotation vector in rad; nominal: as the flange."""

    name = "marker_orientation"
    stage = "tool"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return tuple(f"marker:{name}" for name in cell.tool.markers)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return tuple(ParameterSpec(k, "rad", 0.0, 3e-3) for k in ("rx", "ry", "rz"))

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        vector = ca.vertcat(p["rx"], p["ry"], p["rz"])
        name = place.removeprefix("marker:")
        arm.marker_rotation[name] = rigid.rotation_from_vector(vector)
