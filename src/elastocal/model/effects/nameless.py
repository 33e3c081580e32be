"""What corrects an arm and names no cause: steps in time, and what joints and links make of loads.

Where something acts that the catalogue lacks, these take it up as far as it goes with a moment, a
joint's torque, its last motion, or the force and moment of the load.  All are `shrunk`: what the
readings do not show stays at zero.  They are no explanation, as `smooth.ResidualField` is none.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import casadi as ca
import numpy as np

from elastocal.cell.work_cell import Cell
from elastocal.model.arm import Arm, ParameterSpec, Setting, Spring
from elastocal.model.chain import Chain
from elastocal.model.effects.base import LinkFrame, Symbols, index, links
from elastocal.model.effects.compliances import LoadedEffect, TorqueEffect, add_deflection
from elastocal.model.effects.gears import BY_ORDER, came_from
from elastocal.model.effects.placements import JUMP_TIME, KEYS, Jump
from elastocal.model.effects.smooth import AnyMotion
from elastocal.model.evaluate import BatchFunction
from elastocal.units import Array


class ResidualStep(AnyMotion, Jump):
    """A place moves by u for t ≥ T, and nobody knows why: a knock, a clamp that slipped.

    Of "jointN" its angle, of "linkN" its end frame along and about its axes, of "base" the base, of
    "marker:NAME" the marker; u in rad and m with the prior size `step_size`, T = `step_time_s`.
    """

    name = "residual_step"
    together = True
    family = "time"
    sized_by = "step_size"
    constants = (
        replace(JUMP_TIME, key="step_time_s"),
        Setting("step_size", "range", 1e-4, 0.0, 1.0),
    )

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        size = self.stated(place, chain, cell)[self.sized_by]
        return tuple(
            ParameterSpec(f"step_{k}", unit, 0.0, size, shrunk=True)
            for k, unit in enumerate(self.entry_at(place).units, start=1)
        )


class JointResponse(TorqueEffect):
    """δq = Σ_k c_k φ_k(u, a): what a joint makes of its torque, and nobody knows how.

    u = τ/τ_m is the torque of the loads on the joint over the largest that was measured, a = ±1 the
    direction of the joint's last motion.  The c_k in rad share a prior size.
    """

    nameless = together = True
    stage = "transmission"
    at = "turning joints"
    count: ClassVar[int]

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        return (
            Setting(self.sized_by, "range", 1e-4, 0.0, 1.0),
            Setting(f"{self.name}_Nm", "range", 100.0, 1e-9, 1e9),
        )

    def laws(self, u: ca.SX, side: ca.SX) -> ca.SX:
        """φ (count,) at u and a."""
        raise NotImplementedError

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        size = self.stated(place, chain, cell)[self.sized_by]
        keys = (f"{self.name}_{k}" for k in range(1, self.count + 1))
        return tuple(ParameterSpec(key, "rad", 0.0, size, shrunk=True) for key in keys)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        i, largest = index(place), p[f"{self.name}_Nm"]
        c = ca.vertcat(*(p[f"{self.name}_{k}"] for k in range(1, self.count + 1)))
        side = came_from(arm)[i] if "approach" in self.needs else ca.SX(1)
        add_deflection(
            arm, i, f"{place}.{self.name}", lambda tau: ca.dot(c, self.laws(tau / largest, side))
        )

    def at_rows(self, u: Array, side: Array) -> Array:
        """φ (n, count) at u and a (n,)."""
        symbols = [ca.SX.sym("u"), ca.SX.sym("a")]
        laws = BatchFunction(symbols, [self.laws(*symbols)])
        return np.asarray(laws(u[:, None], side[:, None])[0][..., 0])


SHARP = 1e-2  # of the largest torque: |u| and the sign of u turn over within it


class TorqueResponse(JointResponse):
    """δq = c₁ u + c₂ u³ + c₃ tanh(u/u_s) + c₄ |u| + c₅ u², u = τ/τ_m.

    Play, friction and springs that harden or soften, to either side or alike: τ is the torque of
    the loads on the joint, τ_m = `torque_response_Nm` the largest that was measured, u_s a
    hundredth of it, |u| = √(u² + u_s²) − u_s.  `torque_response_rad` is the prior size of the c_k.
    """

    name = "torque_response"
    family = "torque"
    count = 5
    sized_by = "torque_response_rad"

    def laws(self, u: ca.SX, side: ca.SX) -> ca.SX:
        return ca.vertcat(u, u**3, ca.tanh(u / SHARP), _magnitude(u), u**2)


class ApproachResponse(JointResponse):
    """δq = a (c₁ + c₂ |u|), a = ±1 the direction of the joint's last motion, u = τ/τ_m.

    Friction that holds what the last motion left, with and without load.  τ_m =
    `approach_response_Nm` is the largest torque of the loads on the joint that was measured,
    `approach_response_rad` the prior size of the c_k.
    """

    name = "approach_response"
    family = "move"
    needs = ("approach",)
    count = 2
    sized_by = "approach_response_rad"

    def needed(self, cell: Cell) -> tuple[str, ...]:
        return () if cell.model.approach == BY_ORDER else self.needs

    def laws(self, u: ca.SX, side: ca.SX) -> ca.SX:
        return side * ca.vertcat(1, _magnitude(u))


def _magnitude(u: ca.SX) -> ca.SX:
    return ca.sqrt(u**2 + SHARP**2) - SHARP


class LoadResponse(LoadedEffect):
    """A place gives way to the load: u_a = c_a F_a / F_m and φ_a = d_a M_a / M_m about each axis a.

    F and M are force and moment of the loads at the base, or at a link's end, along the axes there;
    F_m = `load_response_N` and M_m = `load_response_Nm` the largest that were measured, and
    `load_response_size` the prior size of the c_a in m and d_a in rad.
    """

    name = "load_response"
    nameless = together = True
    stage = "compliance"
    family = "load"
    sized_by = "load_response_size"
    constants = (
        Setting(sized_by, "range", 1e-4, 0.0, 1.0),
        Setting("load_response_N", "range", 1000.0, 1e-9, 1e9),
        Setting("load_response_Nm", "range", 1000.0, 1e-9, 1e9),
    )

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return ("base", *links(chain))

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        size = self.stated(place, chain, cell)[self.sized_by]
        return tuple(
            ParameterSpec(f"load_response_{key}", unit, 0.0, size, shrunk=True)
            for key, unit in zip(KEYS, LinkFrame.units, strict=True)
        )

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        for k, key in enumerate(KEYS):
            kind, largest = ("prismatic", "N") if k < 3 else ("revolute", "Nm")
            compliance = p[f"load_response_{key}"] / p[f"load_response_{largest}"]
            name, axis = f"{place}.{self.name}_{key}", np.eye(3)[k % 3]
            arm.add_spring(Spring.linear(name, place, kind, axis, compliance))
