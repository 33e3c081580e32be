"""Where the markers (or the tool centre point) sit on the flange."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Effect, Symbols
from elastocal.manipulator.parameter import ParameterSpec


class MarkerPosition(Effect):
    """Position (x, y, z) in m of each marker in the flange frame, absolute values.

    For distances this is the cable's or ball-bar's attachment point.
    """

    name = "marker_position"
    stage = "tool"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return tuple(f"marker:{name}" for name in cell.tool.markers)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        nominal = cell.tool.markers[place.removeprefix("marker:")]
        return tuple(
            ParameterSpec(k, "m", float(v), 3e-3) for k, v in zip("xyz", nominal, strict=True)
        )

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        arm.markers[place.removeprefix("marker:")] = ca.vertcat(p["x"], p["y"], p["z"])
