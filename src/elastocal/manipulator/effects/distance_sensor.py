"""A draw-wire encoder or ball-bar: anchor point and length offset."""

from __future__ import annotations

import casadi as ca
import numpy as np

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Effect, Symbols
from elastocal.manipulator.parameter import ParameterSpec


class DistanceSensor(Effect):
    """reading = |p_marker − p_anchor| + offset; anchor (x, y, z) and offset in m.

    The anchor is in the frame of the data (the robot's base frame unless `base_frame` is fitted
    or given).
    """

    name = "distance_sensor"
    stage = "tracker"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return ("tracker",)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        nominal = cell.tracker.anchor if cell.tracker.anchor is not None else np.zeros(3)
        anchor = [
            ParameterSpec(f"anchor_{k}", "m", float(v), 3e-3)
            for k, v in zip("xyz", nominal, strict=True)
        ]
        return (*anchor, ParameterSpec("length_offset", "m", 0.0, 3e-3))

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        arm.anchor = ca.vertcat(p["anchor_x"], p["anchor_y"], p["anchor_z"])
        arm.length_offset = p["length_offset"]
