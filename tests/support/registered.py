"""Effects of one's own that tests register, and a catalogue that forgets them again."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects import CATALOGUE, register
from elastocal.manipulator.effects.base import Effect, Symbols
from elastocal.manipulator.effects.driven import DrivenEffect, JointMotion
from elastocal.manipulator.parameter import ParameterSpec, Setting


class SettlingJoint(DrivenEffect):
    """δq = d (1 − exp(−(t − t₀)/T)) from t₀ on: a joint that gives way at once and creeps on."""

    name = "settling_joint"
    stage = "transmission"
    entry = JointMotion()

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        return (ParameterSpec("settled", "rad", 0.0, 1e-4),)

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        return (
            Setting("settling_from_s", "change_time", None, 0.0, 1e9),
            Setting("settling_time_s", "time_constant", 600.0, 30.0, 1e6),
        )

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        since = ca.fmax(arm.input("time", 1) - p["settling_from_s"], 0)
        return p["settled"] * (1 - ca.exp(-since / p["settling_time_s"]))


@contextmanager
def catalogue_with(*effects: Effect) -> Iterator[None]:
    """The catalogue with these effects, as it was before when left."""
    before = dict(CATALOGUE)
    try:
        for effect in effects:
            register(effect)
        yield
    finally:
        CATALOGUE.clear()
        CATALOGUE.update(before)
