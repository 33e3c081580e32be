"""What corrects an arm and names no cause: smooth functions without a formula (the error curve of
a joint, the residual field), steps in time, and what joints and links make of loads.

A function f of one quantity x (a joint's angle, the time) over [low, high] is a sum of waves,

    f(x) = Σ_k [a_k cos ω_k(x − low) + b_k sin ω_k(x − low)],   ω_k = 2πk/P,   k = 1 … K,

whose coefficients have the prior a_k, b_k ~ N(0, s² S_k) with the spectrum of a Matérn process of
smoothness 5/2, S_k ∝ (5/ℓ² + ω_k²)⁻³ and Σ S_k = 1: a Gaussian process of standard deviation s
and correlation length ℓ in a basis of fixed size (Solin and Särkkä 2020, Stat. Comput. 30, 419).
A joint that turns all the way is periodic, P = 2π; else P is longer than the range by so much that
its ends do not know of each other.  Such parameters are `shrunk`: what the readings do not show
stays at zero, so that the function takes as many parameters as the data pay for.

Beyond its range a function that is not periodic ends, and the arm is that of the model without it:

    w f(x) + (1 − w) g,   w = (1 − t)² (1 + 2t),

t the distance from the range over ℓ, 1 at most, so that value and slope have no step: beyond a
length the readings at the end say next to nothing.  g ~ N(0, s²) is what the function may be there:
no reading within the range tells of it, so that it stays at zero and the uncertainty is the
function's whole size.

A smooth function corrects the arm and explains nothing.  Where something acts that the catalogue
lacks, the others take it up as far as it goes with a moment, a joint's torque, its last motion, or
the force and moment of the load; all are `shrunk`.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import casadi as ca
import numpy as np

from elastocal.cell import Cell
from elastocal.model.chain import Chain
from elastocal.model.effects.base import (
    Arm,
    BaseMotion,
    DrivenEffect,
    Entry,
    JointMotion,
    LinkFrame,
    MarkerMotion,
    ParameterSpec,
    Setting,
    Spring,
    Symbols,
    index,
    joints,
    links,
    turning_joints,
)
from elastocal.model.effects.geometry import BY_ORDER, JUMP_TIME, KEYS, Jump, came_from, magnitude
from elastocal.model.effects.statics import LoadedEffect, TorqueEffect, add_deflection
from elastocal.model.evaluate import ONCE, BatchFunction
from elastocal.units import Array

# Waves up to this many times 1/ℓ: what is beyond has 0.2 % of the variance.
HIGHEST = 6.0
MOST_WAVES = 160
MARGIN, LENGTHS = 0.25, 3.0  # of the range, or in lengths, that the ends are apart
FULL_TURN = 0.98  # of 2π: a range from which on a joint's curve is periodic


@dataclass(frozen=True)
class Waves:
    """The waves of a smooth function: `frequency` ω (K,) in 1/x, of x − `low`.

    They fade to zero within `fade` of either end of the range, `span` long; infinite where the
    function is periodic.
    """

    low: float
    frequency: Array
    span: float = math.inf
    fade: float = math.inf

    @classmethod
    def over(cls, low: float, high: float, length: float, turns: bool) -> Waves:
        """Those of functions over [low, high] that vary over `length`; `turns` says whether x is an
        angle, and the function periodic where it goes all the way round."""
        span = max(high - low, 1e-9)
        period, fade = span + max(MARGIN * span, LENGTHS * length), length
        if turns and span >= FULL_TURN * 2 * math.pi:
            period, fade = 2 * math.pi, math.inf
        count = math.ceil(HIGHEST / length * period / (2 * math.pi))
        order = np.arange(1, min(max(count, 1), MOST_WAVES) + 1)
        return cls(low, np.asarray(2 * np.pi * order / period, dtype=np.float64), span, fade)

    @property
    def count(self) -> int:
        return 2 * len(self.frequency) + math.isfinite(self.fade)

    def variances(self, size: float, length: float) -> Array:
        """Prior variances (count,) of the coefficients: cosines, sines, what is beyond."""
        spectrum = (5 / length**2 + self.frequency**2) ** -3.0
        shares = [*np.tile(spectrum / spectrum.sum(), 2), 1.0]
        return np.asarray(size**2 * np.array(shares[: self.count]))

    def slopes(self, length: float) -> Array:
        """(count,): those of the variances' logarithms in log ℓ."""
        spectrum, bend = self.variances(1.0, length), 5 / length**2 + self.frequency**2
        slope = np.tile(30 / length**2 / bend, 2)
        own = spectrum[: len(slope)]
        return np.append(slope - (own @ slope) / own.sum(), np.zeros(self.count - len(slope)))

    def values(self, x: ca.SX) -> list[ca.SX]:
        """cos ω_k(x − low), then sin ω_k(x − low), then what is beyond: `count` expressions."""
        x = x - self.low
        phases = [float(w) * x for w in self.frequency]
        waves = [*(ca.cos(phase) for phase in phases), *(ca.sin(phase) for phase in phases)]
        if math.isinf(self.fade):
            return waves
        t = ca.fmin(ca.fmax(ca.fmax(-x, x - self.span), 0) / self.fade, 1)
        w = (1 - t) ** 2 * (1 + 2 * t)
        return [*(w * wave for wave in waves), 1 - w]

    def at(self, x: Array) -> Array:
        """The same numbers (n, count) at x (n,)."""
        symbol = ca.SX.sym("x")
        waves = BatchFunction([symbol], [ca.vertcat(*self.values(symbol))], ONCE)
        return np.asarray(waves(x[:, None])[0][..., 0])


@dataclass(frozen=True)
class SmoothFunction:
    """What shrunk parameters of an effect make up: a smooth function of one quantity of a row.

    `follows` is a joint, "joint2", or "time", or "" where they are no function; `starts`
    (components,) are what the keys of each component's coefficients begin with, and `units` those
    of its values.  `size` and `length` are the standard deviation and the correlation length of its
    prior; between `low` and `high` it was measured (rad or s).
    """

    follows: str
    starts: tuple[str, ...]
    units: tuple[str, ...]
    size: float
    length: float = math.nan
    low: float = math.nan
    high: float = math.nan

    @property
    def lasting(self) -> bool:
        return self.follows != "time"

    @property
    def whole_turn(self) -> bool:
        return math.isinf(self.waves.fade)

    @property
    def waves(self) -> Waves:
        return Waves.over(self.low, self.high, self.length, self.lasting)

    @property
    def keys(self) -> list[list[str]]:
        """Of its parameters (components, waves)."""
        return [[f"{start}_{k + 1}" for k in range(self.waves.count)] for start in self.starts]


class SmoothEffect(DrivenEffect):
    """u = Σ_c f_c(x_c) in every component of the motion at a place; `functions` says the f_c."""

    together = True

    @abstractmethod
    def functions(self, place: str, chain: Chain, cell: Cell) -> tuple[SmoothFunction, ...]: ...

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        found: list[ParameterSpec] = []
        for f in self.functions(place, chain, cell):
            sizes = np.sqrt(f.waves.variances(f.size, f.length)).tolist()
            for keys, unit in zip(f.keys, f.units, strict=True):
                known = zip(keys, sizes, strict=True)
                found += [ParameterSpec(key, unit, 0.0, sd, shrunk=True) for key, sd in known]
        return tuple(found)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        u = ca.SX.zeros(self.entry_at(place).size)
        for f in self.functions(place, arm.chain, arm.cell):
            x = arm.q_commanded[index(f.follows)] if f.lasting else arm.input("time", 1)
            waves = ca.vertcat(*f.waves.values(x))
            every = (ca.vertcat(*(p[key] for key in keys)) for keys in f.keys)
            u += ca.vertcat(*(ca.dot(coefficients, waves) for coefficients in every))
        return u


class JointCurve(SmoothEffect):
    """δq = f(q), f a smooth function of the commanded joint angle q.

    The transmission error of a real gear: eccentricities, tooth errors and encoder errors of all
    orders at once.  Settings: the standard deviation `curve_size_rad` and the length
    `curve_length_rad` of the process, and the range from `curve_low_rad` to `curve_high_rad`; a
    diagnosis estimates them.
    """

    name, stage, at = "joint_curve", "transmission", "turning joints"
    family = "angle"
    sized_by = "curve_size_rad"
    entry = JointMotion()
    constants = (
        Setting("curve_size_rad", "range", 2e-4, 0.0, 1.0),
        Setting("curve_length_rad", "range", 0.3, 1e-3, 100.0),
        Setting("curve_low_rad", "range", -math.pi, -100.0, 100.0),
        Setting("curve_high_rad", "range", math.pi, -100.0, 100.0),
    )

    def functions(self, place: str, chain: Chain, cell: Cell) -> tuple[SmoothFunction, ...]:
        return (
            SmoothFunction(place, ("curve",), ("rad",), *self.stated(place, chain, cell).values()),
        )


class AnyMotion(DrivenEffect):
    """Without a known cause a place moves: of "jointN" its angle, of "linkN" its end frame along
    and about its axes, of "base" the base, of "marker:NAME" the marker."""

    nameless = True
    stage = "geometry"
    entry = JointMotion()  # at a joint; see `entry_at`

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        markers = tuple(f"marker:{name}" for name in cell.tool.markers)
        return (*joints(chain), *links(chain), "base", *markers)

    def entry_at(self, place: str) -> Entry:
        if place.startswith("joint"):
            return JointMotion()
        if place.startswith("link"):
            return LinkFrame()
        return BaseMotion() if place == "base" else MarkerMotion()


class ResidualField(AnyMotion, SmoothEffect):
    """A place moves smoothly with joint angles or time, and nobody knows why.

    u = Σ_c f_c(x_c) in every component of the motion, x_c the joints' angles and the time.
    Settings for each c, "joint2" or "time": `field_c_size` (rad and m; 0, the default, where the
    field does not follow it), and `field_c_length`, `field_c_low`, `field_c_high` in rad or s.
    What a diagnosis finds and cannot name: it corrects the arm where it was measured, and is no
    explanation.
    """

    name = "residual_field"
    family = "pose"

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        found: list[Setting] = []
        for name in (*turning_joints(chain), "time"):
            half, wide = (3600.0, 1e9) if name == "time" else (math.pi, 100.0)
            found += [
                Setting(f"field_{name}_size", "range", 0.0, 0.0, 1.0),
                Setting(f"field_{name}_length", "range", half / 3, 1e-3, wide),
                Setting(f"field_{name}_low", "range", -half, -wide, wide),
                Setting(f"field_{name}_high", "range", half, -wide, wide),
            ]
        return tuple(found)

    def functions(self, place: str, chain: Chain, cell: Cell) -> tuple[SmoothFunction, ...]:
        given, units = self.stated(place, chain, cell), self.entry_at(place).units
        return tuple(
            SmoothFunction(
                name,
                tuple(f"field_{name}_{c + 1}" for c in range(len(units))),
                units,
                *(given[f"field_{name}_{key}"] for key in ("size", "length", "low", "high")),
            )
            for name in (*turning_joints(chain), "time")
            if given[f"field_{name}_size"] > 0
        )

    def needed(self, cell: Cell) -> tuple[str, ...]:
        timed = any(s.get("field_time_size") for s in cell.model.nominal.settings.values())
        return ("time",) if timed else ()

    def lasting(self, cell: Cell) -> Cell:
        settings = {
            place: {key: value for key, value in given.items() if not key.startswith("field_time_")}
            for place, given in cell.model.nominal.settings.items()
        }
        nominal = replace(cell.model.nominal, settings=settings)
        return replace(cell, model=replace(cell.model, nominal=nominal))


class ResidualStep(AnyMotion, Jump):
    """A place moves by u for t ≥ T, and nobody knows why: a knock, a clamp that slipped.

    u in rad and m with the prior size `step_size`, T = `step_time_s`.
    """

    name = "residual_step"
    together = True
    family = "time"
    sized_by = "step_size"
    constants = (
        replace(JUMP_TIME, key="step_time_s"),
        Setting("step_size", "range", 1e-4, 0.0, 1.0),
    )

    def shrunk_keys(self, place: str, chain: Chain) -> dict[str, str]:
        return {f"step_{k}": unit for k, unit in enumerate(self.entry_at(place).units, start=1)}


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

    def shrunk_keys(self, place: str, chain: Chain) -> dict[str, str]:
        return {f"{self.name}_{k}": "rad" for k in range(1, self.count + 1)}

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        i, largest = index(place), p[f"{self.name}_Nm"]
        c = ca.vertcat(*(p[key] for key in self.shrunk_keys(place, arm.chain)))
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
        return ca.vertcat(u, u**3, ca.tanh(u / SHARP), magnitude(u, SHARP), u**2)


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
        return side * ca.vertcat(1, magnitude(u, SHARP))


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

    def shrunk_keys(self, place: str, chain: Chain) -> dict[str, str]:
        return {f"load_response_{k}": u for k, u in zip(KEYS, LinkFrame.units, strict=True)}

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        for k, key in enumerate(KEYS):
            kind, largest = ("prismatic", "N") if k < 3 else ("revolute", "Nm")
            compliance = p[f"load_response_{key}"] / p[f"load_response_{largest}"]
            name, axis = f"{place}.{self.name}_{key}", np.eye(3)[k % 3]
            arm.add_spring(Spring.linear(name, place, kind, axis, compliance))
