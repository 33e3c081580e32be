"""Courses of time that drifts, jumps and slips share."""

from __future__ import annotations

import casadi as ca
import numpy as np

from elastocal.manipulator.arm import Arm
from elastocal.manipulator.effects.base import Symbols
from elastocal.manipulator.effects.base_frame import KEYS
from elastocal.manipulator.parameter import ParameterSpec, Setting

TIME_CONSTANT = Setting("time_constant_s", "time_constant", 1800.0, 60.0, 1e6)


def change_time(key: str) -> Setting:
    """The moment in s at which something changed; nobody knows it beforehand."""
    return Setting(key, "change_time", None, -np.inf, np.inf)


def warm_up(arm: Arm, p: Symbols) -> ca.SX:
    """1 − exp(−t/T) of the row's time t, T = `time_constant_s`: 0 at t = 0, 1 when warm.

    The response of a body with one thermal time constant to a constant source of heat that is
    switched on at t = 0.
    """
    return 1 - ca.exp(-arm.input("time", 1) / p["time_constant_s"])


def after(arm: Arm, moment: ca.SX) -> ca.SX:
    """1 in rows measured at `moment` (s) or later, else 0."""
    return arm.input("time", 1) >= moment


def pose_change(prefix: str, length: float, angle: float) -> tuple[ParameterSpec, ...]:
    """`prefix`_x … `prefix`_rz with typical sizes `length` in m and `angle` in rad."""
    units, sizes = ["m"] * 3 + ["rad"] * 3, [length] * 3 + [angle] * 3
    return tuple(
        ParameterSpec(f"{prefix}_{k}", unit, 0.0, size)
        for k, unit, size in zip(KEYS, units, sizes, strict=True)
    )
