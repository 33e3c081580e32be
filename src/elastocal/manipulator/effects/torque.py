"""Deflections that follow the load's torque, and when there is one."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm, Spring
from elastocal.manipulator.effects.base import Effect


class LoadedEffect(Effect):
    """An effect that shows only under load: the table's force, or the links' weights."""

    def needed(self, cell: Cell) -> tuple[str, ...]:
        return self.needs if cell.model.link_gravity else (*self.needs, "load")


class TorqueEffect(LoadedEffect):
    """A `LoadedEffect` about a joint's own axis, by `add_deflection`: a measured torque will do."""

    def needed(self, cell: Cell) -> tuple[str, ...]:
        return self.needs if cell.model.torque == "measured" else super().needed(cell)


def add_deflection(arm: Arm, i: int, name: str, law: Callable[[ca.SX], ca.SX]) -> None:
    """Joint i (0-based) yields along its own axis by law(τ), τ the load's torque on it.

    With `torque = "measured"` τ is the table's and the deflection is explicit; else it is a
    spring of the equilibrium.
    """
    if arm.cell.model.torque == "measured":
        arm.q[i] += law(arm.input("torque", arm.chain.n_joints)[i])
        return
    joint = arm.chain.joints[i]
    x, y, z = (float(a) for a in joint.axis)
    arm.add_spring(Spring(name, f"joint{i + 1}", joint.kind, (x, y, z), law))
