"""Whole arms: every joint with a gear of many lines, sag, compliance, play and scatter at once.

All sizes are drawn from RANGES, log-uniform unless said otherwise; angles of the drives are those
of a heavy arm's cycloidal gears times `ArmSpec.gear` (2 for strain-wave gears).

| what | range | where it comes from |
|---|---|---|
| eccentricity, once per turn of the joint | 50 to 150 µrad × gear | Nabtesco, RV-E catalogue: angular transmission error 50 to 80″ (240 to 390 µrad from peak to peak, all lines together); Harmonic Drive, CSG and CSF: transmission accuracy 0.5 to 1.5′; and the runout of encoder and shaft |
| a family of lines: teeth, balls, pins | first order 10 to 50 per turn, a real number; two or three multiples up to 100; 20 to 60 µrad × gear, each multiple 0.3 to 0.7 of the one before | Ghorbel, Gandhi and Alpeter 2001, J. Mech. Des. 123, 90: lines at multiples of the wave generator's turn; Jia et al. 2021, Mech. Mach. Theory 155, 104122: their beats |
| direction of the last move | half width 10 to 60 µrad × gear | RV-E: lost motion up to 1′, backlash up to 1′, at standstill under friction a part of it |
| joint scatter, one draw per visit | 3 to 10 µrad × gear | data sheets by ISO 9283: 20 to 80 µm at a reach of 0.9 to 2.8 m |
| compliances | those of the arm ± 20 %, uniform | `arm_data.py`; Klimchik et al. 2013 for the heavy arm |
| weights | masses of the URDF × 0.7 to 1.4, centres moved by 0.02 of the reach, rms per axis | cables, motors and covers that no CAD file has; the tool is told none of them |
| creep of base against tracker | 10 to 40 µm and 5 to 20 µrad rms per axis, correlated over 20 to 90 min | Muralikrishnan, Phillips and Sawyer 2016, Precis. Eng. 44, 13: tripods and floors in a workshop |
| noise of the tracker | 10 to 60 µm rms of a coordinate | the same: 10 µm + 5 to 12 µm/m across the beam |
"""  # noqa: E501

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from arm_data import ARMS, ArmSpec, draw_specimen
from draw import Plan, Told, World, draw_poses, draw_visits
from inside import POSE
from instrument import draw_noise
from places import Values, log_uniform
from skeleton import Array, Skeleton
from world import Effect, Hooks, Visits

# How the effects act, several at every joint.  Their names are not those of elastocal, which is
# asked for sizes and causes here, not for a name.
LINES, WEIGHTS, LAST_MOVE, CREEP = "gear_lines", "unknown_weights", "last_move", "slow_creep"


def gear_error(e: Effect, v: Visits) -> Array:
    """Error (n,) rad of a gear at its joint's angle q: lines of any order, each
    a sin(order q) + b cos(order q)."""
    q = v.q[:, e.index]
    error = np.zeros(len(q))
    for line, order in e.settings.items():
        a, b = e.vector(f"{line}_sin", f"{line}_cos")
        error += a * np.sin(order * q) + b * np.cos(order * q)
    return error


def last_move(e: Effect, v: Visits) -> Array:
    """Where a joint stops (n,) rad: beyond its target, or before it, by the side it came from."""
    return e.values["half_width"] * v.approach[:, e.index]


def creep(e: Effect, time: Array) -> Array:
    """Shift and turn of the base (n, 6) m, rad: waves whose frequencies are drawn from the
    spectrum of a Gaussian process of squared exponential covariance."""
    moved = np.zeros((len(time), 6))
    frequencies = [w for key, w in e.settings.items() if key.startswith("frequency")]
    for k, frequency in enumerate(frequencies):
        for wave, name in ((np.cos, "cos"), (np.sin, "sin")):
            size = e.vector(*[f"{axis}_{name}{k}" for axis in POSE])
            moved += np.outer(wave(frequency * time), size)
    return moved


def weights(e: Effect) -> tuple[Array, Array]:
    """Masses (J,) kg of the links and their centres (J, 3) m in the joints' frames."""
    J = len(e.values) // 4
    masses = e.vector(*[f"mass{j + 1}" for j in range(J)])
    centres = [e.vector(*[f"com{j + 1}_{axis}" for axis in "xyz"]) for j in range(J)]
    return masses, np.array(centres)


@dataclass(frozen=True)
class Ranges:
    """Of whole arms, in SI units; angles of drives for a heavy arm."""

    eccentricity: tuple[float, float] = (50e-6, 150e-6)
    order: tuple[float, float] = (10.0, 50.0)
    highest_order: float = 100.0
    line: tuple[float, float] = (20e-6, 60e-6)
    next_line: tuple[float, float] = (0.3, 0.7)
    half_width: tuple[float, float] = (10e-6, 60e-6)
    scatter: tuple[float, float] = (3e-6, 10e-6)
    mass: tuple[float, float] = (0.7, 1.4)
    centre: float = 0.02
    shift: tuple[float, float] = (10e-6, 40e-6)
    turn: tuple[float, float] = (5e-6, 20e-6)
    correlated: tuple[float, float] = (1200.0, 5400.0)
    noise: tuple[float, float] = (10e-6, 60e-6)


RANGES = Ranges()
WAVES = 40  # of the creep: enough for a Gaussian process of any length above
NOTHING = 1e-9  # kg, of a link whose weight is an effect


@dataclass(frozen=True)
class WholeRecipe:
    """What a whole arm is drawn from; the approach is recorded in every other world."""

    name: str
    seed: tuple[int, ...]
    poses: int
    effects: tuple[str, ...] = ()
    factor: float | None = None

    def draw(self) -> World:
        return draw_whole(self.seed, self.name, self.poses, approach=self.seed[-1] % 2 == 0)


def draw_whole(
    seed: Sequence[int],
    name: str,
    poses: int = 60,
    *,
    approach: bool = True,
    arm: str | None = None,
) -> World:
    """A whole arm measured unloaded and loaded at `poses` poses, in the order of its times; joints
    come from the pose before.  `approach`: whether the readings state from which side.  The same
    arm for any number of poses."""
    rng = np.random.default_rng((*seed, 0))
    drawn = list(ARMS)[rng.integers(len(ARMS))]
    spec = ARMS[drawn if arm is None else arm]
    specimen = draw_specimen(spec, rng)
    true = specimen.true
    J = spec.skeleton.n_joints
    distance = float(np.linalg.norm(specimen.base_position))
    noise = draw_noise("as_modelled", J, distance, rng, log_uniform(RANGES.noise, rng))
    scatter = np.array([log_uniform(RANGES.scatter, rng) for _ in range(J)]) * spec.gear
    effects = [
        *(_gear(spec, j, rng) for j in range(J)),
        *(_last_move(spec, j, rng) for j in range(J)),
        _weights(spec, rng),
        _creep(rng),
    ]
    plan: Plan = "interleaved" if rng.random() < 0.5 else "blocks"
    visits = draw_visits(spec, draw_poses(spec, poses, rng), plan, True, rng)
    light = replace(true.skeleton, mass=np.full(J, NOTHING), com=np.zeros((J, 3)))
    bare = replace(true, skeleton=light)
    return World(
        name, tuple(seed), spec, replace(specimen, true=bare), tuple(effects), np.zeros(0),
        visits, plan, True, replace(noise, repeatability=scatter),
        Told(weights=False, approach=approach),
    )  # fmt: skip


def _line(name: str, amplitude: float, rng: np.random.Generator) -> Values:
    phase = rng.uniform(0, 2 * np.pi)
    return {
        f"{name}_sin": float(amplitude * np.cos(phase)),
        f"{name}_cos": float(amplitude * np.sin(phase)),
    }


def _gear(spec: ArmSpec, j: int, rng: np.random.Generator) -> Effect:
    values = _line("eccentricity", spec.gear * log_uniform(RANGES.eccentricity, rng), rng)
    settings = {"eccentricity": 1.0}
    first = log_uniform(RANGES.order, rng)
    amplitude = spec.gear * log_uniform(RANGES.line, rng)
    for multiple in range(1, int(rng.integers(2, 4)) + 1):
        if multiple * first <= RANGES.highest_order:
            settings[f"line{multiple}"] = multiple * first
            values |= _line(f"line{multiple}", amplitude, rng)
        amplitude *= rng.uniform(*RANGES.next_line)
    return Effect(LINES, f"joint{j + 1}", values, settings, hooks=Hooks(drive=gear_error))


def _last_move(spec: ArmSpec, j: int, rng: np.random.Generator) -> Effect:
    half = {"half_width": spec.gear * log_uniform(RANGES.half_width, rng)}
    return Effect(LAST_MOVE, f"joint{j + 1}", half, hooks=Hooks(drive=last_move))


def _weights(spec: ArmSpec, rng: np.random.Generator) -> Effect:
    values: Values = {}
    for j, (mass, centre) in enumerate(zip(spec.skeleton.mass, spec.skeleton.com, strict=True)):
        moved = centre + rng.normal(0.0, RANGES.centre * spec.reach, 3)
        values[f"mass{j + 1}"] = float(mass) * log_uniform(RANGES.mass, rng)
        values |= {f"com{j + 1}_{axis}": float(c) for axis, c in zip("xyz", moved, strict=True)}

    def weigh(e: Effect, skeleton: Skeleton) -> Skeleton:
        masses, centres = weights(e)
        return replace(skeleton, mass=masses, com=centres)

    return Effect(WEIGHTS, "all", values, hooks=Hooks(weigh=weigh))


def _creep(rng: np.random.Generator) -> Effect:
    length = log_uniform(RANGES.correlated, rng)
    frequencies = rng.normal(0.0, 1 / length, WAVES)
    values: Values = {}
    for axis in POSE:
        size = log_uniform(RANGES.turn if axis.startswith("r") else RANGES.shift, rng)
        for name in ("cos", "sin"):
            drawn = size / np.sqrt(WAVES) * rng.normal(size=WAVES)
            values |= {f"{axis}_{name}{k}": float(a) for k, a in enumerate(drawn)}
    settings = {f"frequency{k}": float(w) for k, w in enumerate(frequencies)}
    settings["length_s"] = length
    return Effect(CREEP, "base", values, settings, hooks=Hooks(base=lambda e, v: creep(e, v.time)))
