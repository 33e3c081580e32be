"""Where the robot's base stands in the tracker's frame."""

from __future__ import annotations

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from elastocal.cell import Cell
from elastocal.manipulator import rigid
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Effect, Symbols
from elastocal.manipulator.parameter import ParameterSpec

KEYS = ("x", "y", "z", "rx", "ry", "rz")


class BaseFrame(Effect):
    """T_tracker_base = Trans(x, y, z) · exp([rx, ry, rz]×), absolute values.

    Position in m, rotation vector in rad, both in the tracker frame.  The rotation vector is
    regular up to a full turn, so the tracker may be turned any way.
    """

    name = "base_frame"
    stage = "tracker"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return ("base",)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        nominal = cell.model.nominal
        position = np.zeros(3) if nominal.base_position is None else nominal.base_position
        rotation = np.eye(3) if nominal.base_rotation is None else nominal.base_rotation
        vector = Rotation.from_matrix(rotation).as_rotvec()
        values = [*position, *vector]
        sizes = [3e-3] * 3 + [3e-3] * 3
        units = ["m"] * 3 + ["rad"] * 3
        return tuple(
            ParameterSpec(k, u, float(v), s)
            for k, u, v, s in zip(KEYS, units, values, sizes, strict=True)
        )

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        position = ca.vertcat(p["x"], p["y"], p["z"])
        vector = ca.vertcat(p["rx"], p["ry"], p["rz"])
        arm.T_tracker_base = rigid.transform(rigid.rotation_from_vector(vector), position)
