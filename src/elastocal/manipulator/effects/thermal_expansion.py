"""Lengths that grow as the arm warms up."""

from __future__ import annotations

import casadi as ca
import numpy as np

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Symbols, links
from elastocal.manipulator.effects.driven import DrivenEffect
from elastocal.manipulator.effects.entry import LinkLength
from elastocal.manipulator.effects.in_time import TIME_CONSTANT, warm_up
from elastocal.manipulator.effects.link_ends import SHORTEST, link_ends
from elastocal.manipulator.parameter import ParameterSpec, Setting

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
