"""What changes while one measures: references, base, tracker, markers and lengths."""

from __future__ import annotations

import casadi as ca
import numpy as np

from elastocal.cell.work_cell import Cell
from elastocal.model.arm import Arm, ParameterSpec, Setting
from elastocal.model.chain import Chain
from elastocal.model.effects.base import MEASURE_MONUMENTS, Symbols, links, motion_unit
from elastocal.model.effects.driven import (
    BaseMotion,
    DrivenEffect,
    JointMotion,
    LinkLength,
    MarkerMotion,
)
from elastocal.model.effects.placements import KEYS, SHORTEST, link_ends

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


def pose_change(prefix: str, length: float) -> tuple[ParameterSpec, ...]:
    """`prefix`_x … `prefix`_rz with typical sizes `length` in m and 50 µrad."""
    units, sizes = ["m"] * 3 + ["rad"] * 3, [length] * 3 + [5e-5] * 3
    return tuple(
        ParameterSpec(f"{prefix}_{k}", unit, 0.0, size)
        for k, unit, size in zip(KEYS, units, sizes, strict=True)
    )


class JointDrift(DrivenEffect):
    """δq = d (1 − exp(−t/T)): the joint's reference has moved by d (rad or m) once warm.

    Gears and encoder mounts warm up with the motor beside them and shift the joint's zero; t is
    the table's time from its origin, T the setting `time_constant_s`.  Measurements that begin
    warm leave a drift that a constant offset takes up.
    """

    name = "joint_drift"
    stage = "transmission"
    constants = (TIME_CONSTANT,)
    formats = ("rigid", "elastic")
    needs = ("time",)
    entry = JointMotion()

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return (ParameterSpec("drift", motion_unit(place, chain), 0.0, 1e-4),)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        return p["drift"] * warm_up(arm, p)


class EncoderJump(DrivenEffect):
    """δq = d for t ≥ T: the joint's reference jumps by d (rad or m) at T = `jump_time_s`.

    A belt that skips a tooth, a coupling that slips, an encoder that loses counts or is
    referenced anew in the middle of a campaign.
    """

    name = "encoder_jump"
    stage = "transmission"
    constants = (change_time("jump_time_s"),)
    formats = ("rigid", "elastic")
    needs = ("time",)
    entry = JointMotion()

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return (ParameterSpec("jump", motion_unit(place, chain), 0.0, 1e-4),)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        return p["jump"] * after(arm, p["jump_time_s"])


class BaseDrift(DrivenEffect):
    """The base moves by d (1 − exp(−t/T)), d = (drift_x … drift_rz) in m and rad.

    Along the axes of the tracker frame and about the base's origin; T is `time_constant_s`.  A
    pedestal that warms up or settles on its grout, or a tracker whose tripod does the same: only
    fixed reflectors beside the arm can tell the two apart.
    """

    name = "base_drift"
    stage = "tracker"
    constants = (TIME_CONSTANT,)
    remedy = MEASURE_MONUMENTS
    needs = ("time",)
    entry = BaseMotion()
    unknowns = pose_change("drift", 5e-5)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        return ca.vertcat(*[p[f"drift_{k}"] for k in KEYS]) * warm_up(arm, p)


class FrameJump(DrivenEffect):
    """The base, as the tracker sees it, moves by (jump_x … jump_rz) for t ≥ T = `jump_time_s`.

    In m and rad, along the axes of the tracker frame and about the base's origin.  Somebody
    touches the tripod, or the instrument is set up anew and located with an error: every reading
    after T moves rigidly.
    """

    name = "frame_jump"
    stage = "tracker"
    at = "tracker"
    constants = (change_time("jump_time_s"),)
    remedy = MEASURE_MONUMENTS
    needs = ("time",)
    entry = BaseMotion()
    unknowns = pose_change("jump", 1e-4)

    def entered_at(self, place: str, chain: Chain) -> tuple[str, ...]:
        return ("base",)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        jump = ca.vertcat(*[p[f"jump_{k}"] for k in KEYS])
        return jump * after(arm, p["jump_time_s"])


class MarkerSlip(DrivenEffect):
    """One marker moves by (slip_x, slip_y, slip_z) in the flange frame for t ≥ T = `slip_time_s`.

    In m.  A reflector that was taken off its magnetic nest and put back, glue that gives way.
    """

    name = "marker_slip"
    stage = "tool"
    constants = (change_time("slip_time_s"),)
    needs = ("time",)
    entry = MarkerMotion()
    unknowns = tuple(ParameterSpec(f"slip_{k}", "m", 0.0, 1.5e-4) for k in "xyz")

    @property
    def of_the_measurement(self) -> bool:
        return True  # the marker slipped during one campaign

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        slip = ca.vertcat(*[p[f"slip_{k}"] for k in "xyz"])
        return slip * after(arm, p["slip_time_s"])


REFERENCE_C = 20.0  # ISO 1: lengths are stated at this temperature


class ThermalExpansion(DrivenEffect):
    """Lengths of a link (or of all alike: place "all") ← (1 + ε) times themselves.

    ε = e (1 − exp(−t/T)) with the strain e at full warm-up (1) and the time constant T =
    `time_constant_s`; or, with `[model] thermal_driver = "temperature"`, ε = α (T_row − 20 °C)
    with the expansion coefficient α in 1/K (steel 12e-6, aluminium 23e-6) and the table's
    temperature.  Motors and gears heat the castings: 8 K make 0.1 mm per metre of steel.
    """

    name = "thermal_expansion"
    stage = "geometry"
    formats = ("rigid", "elastic")
    needs = ("time",)
    entry = LinkLength()

    def needed(self, cell: Cell) -> tuple[str, ...]:
        return (cell.model.thermal_driver,)

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        lengths = [np.linalg.norm(T[:3, 3]) for T in link_ends(chain)]
        long = [link for link, m in zip(links(chain), lengths, strict=True) if m > SHORTEST]
        return (*long, "all")

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        if cell.model.thermal_driver == "temperature":
            return (ParameterSpec("expansion", "1/K", 0.0, 12e-6),)
        return (ParameterSpec("expansion", "1", 0.0, 1e-4),)

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        return () if cell.model.thermal_driver == "temperature" else (TIME_CONSTANT,)

    def entered_at(self, place: str, chain: Chain) -> tuple[str, ...]:
        return links(chain) if place == "all" else (place,)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        if arm.cell.model.thermal_driver == "temperature":
            course = arm.input("temperature", 1) - REFERENCE_C
        else:
            course = warm_up(arm, p)
        return ca.repmat(p["expansion"] * course, len(self.entered_at(place, arm.chain)))
