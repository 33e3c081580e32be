"""Effects that the catalogue does not have, each with its true location.

`stage` and `where` are in the words of the diagnosis; `driver` says what the disturbance follows:
a joint's commanded angle "q2", its load "torque2" or direction "approach1", "time", "load",
"position" of the marker, "view" (the angle it is seen under), or a product of two.  Each function
draws one of its kind from site and factor.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from inside import SPREAD, settled, time_constant
from mechanics import Spring
from places import Site, log_uniform, sign, spread
from skeleton import Array
from world import Effect, Hooks, Motion, Sight, TrueArm, Visits

XYZ, TURNS = ("x", "y", "z"), ("rx", "ry", "rz")


def draw_outside(
    name: str, site: Site, rng: np.random.Generator, factor: float | None = None
) -> Effect:
    """The named effect at a random place; factor over its size, log-uniform where none is given."""
    drawn = log_uniform(SPREAD, rng)
    return OUTSIDE[name](site, drawn if factor is None else factor, rng)


# --- transmission -----------------------------------------------------------------------------


def cable_drag(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """Cables along the arm pull one joint as a joint before it turns."""
    j, by = int(rng.choice(site.joints[2:-1])), int(rng.integers(2))
    values = spread(("sin", "cos"), f * site.spec.gear * 1e-4, rng)

    def drive(e: Effect, v: Visits) -> Array:
        return e.values["sin"] * np.sin(v.q[:, by]) + e.values["cos"] * np.cos(v.q[:, by])

    settings, where = {"by_joint": by + 1.0}, f"joint{j + 1}"
    hooks = Hooks(drive=drive)
    return Effect("cable_drag", where, values, settings, "transmission", f"q{by + 1}", hooks)


def worn_gear(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """A worn stretch of the gear, where the joint mostly worked: a bump over some 40 degrees."""
    j = int(rng.choice(site.joints))
    s = site.arm.skeleton
    centre = s.lower[j] + (s.upper[j] - s.lower[j]) * rng.uniform(0.3, 0.7)
    settings = {"centre": float(centre), "width": 0.3}
    values = {"height": sign(rng) * f * site.spec.gear * 2e-4}

    def drive(e: Effect, v: Visits) -> Array:
        away = (v.q[:, j] - settings["centre"]) / settings["width"]
        return e.values["height"] * np.exp(-0.5 * away**2)

    where, hooks = f"joint{j + 1}", Hooks(drive=drive)
    return Effect("worn_gear", where, values, settings, "transmission", f"q{j + 1}", hooks)


def saw_tooth(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """A reference that creeps and is set back at regular times."""
    j = int(rng.choice(site.joints))
    period = float(site.duration * rng.uniform(0.2, 0.35))
    settings = {"period_s": period, "phase": float(rng.random())}
    values = {"height": sign(rng) * f * site.spec.gear * 3e-4}

    def drive(e: Effect, v: Visits) -> Array:
        return e.values["height"] * ((v.time / period + settings["phase"]) % 1.0 - 0.5)

    where, hooks = f"joint{j + 1}", Hooks(drive=drive)
    return Effect("saw_tooth", where, values, settings, "transmission", "time", hooks)


# --- compliance -------------------------------------------------------------------------------


def softening(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """A drive that softens as it warms up."""
    j = int(rng.choice(site.at_work))
    values = {"compliance": 0.15 * f * float(site.arm.compliance[j])}
    hooks = Hooks(slack=lambda e, v, load: e.values["compliance"] * load[:, j] * settled(v, e))
    where, driver, settings = f"joint{j + 1}", f"torque{j + 1} x time", time_constant(rng)
    return Effect("softening", where, values, settings, "compliance", driver, hooks)


def lopsided_stiffness(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """A joint that is softer under torque of one sign."""
    j = int(rng.choice(site.two_sided))
    values = {"compliance": 0.2 * f * float(site.arm.compliance[j])}
    hooks = Hooks(slack=lambda e, v, load: e.values["compliance"] * np.maximum(load[:, j], 0.0))
    where, driver = f"joint{j + 1}", f"torque{j + 1}"
    return Effect("lopsided_stiffness", where, values, {}, "compliance", driver, hooks)


def uneven_stiffness(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """A gear whose stiffness changes over its turn: twice, as a bent cage makes it."""
    j = int(rng.choice(site.at_work))
    values = {"compliance": 0.12 * f * float(site.arm.compliance[j])}
    settings = {"order": 2.0, "phase": float(rng.uniform(0, 2 * np.pi))}

    def slack(e: Effect, v: Visits, load: Array) -> Array:
        share = np.sin(settings["order"] * v.q[:, j] + settings["phase"])
        return e.values["compliance"] * load[:, j] * share

    where, driver = f"joint{j + 1}", f"torque{j + 1} x q{j + 1}"
    hooks = Hooks(slack=slack)
    return Effect("uneven_stiffness", where, values, settings, "compliance", driver, hooks)


def coupled_housing(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """The housing between two drives: the torque of one twists the other."""
    j = int(rng.choice([j for j in site.at_work if j - 1 in site.at_work]))
    values = {"compliance": sign(rng) * 0.1 * f * float(site.arm.compliance[j - 1])}
    hooks = Hooks(slack=lambda e, v, load: e.values["compliance"] * load[:, j - 1])
    where = f"joint{j + 1}"
    return Effect("coupled_housing", where, values, {}, "compliance", f"torque{j}", hooks)


def axial_stretch(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """A loose flange that lets a link grow and shrink along itself: 40 µm at the payload."""
    j = int(rng.choice([i for i in site.long_links if i > 0]))
    values = {"compliance": f * 4e-5 / site.spec.payload}

    def springs(e: Effect, arm: TrueArm) -> list[Spring]:
        along = arm.skeleton.rotation[j + 1].T @ arm.skeleton.link_vector(j)
        return [Spring(j + 2, along / np.linalg.norm(along), e.values["compliance"], "slide")]

    where, hooks = f"link{j + 1}", Hooks(springs=springs)
    return Effect("axial_stretch", where, values, {}, "compliance", "load", hooks)


# --- base, load and tool ----------------------------------------------------------------------


def sliding_foot(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """Loose anchor bolts: the foot slides back and forth as joint 1 brakes."""
    values = spread(XYZ, f * 4e-5, rng) | spread(TURNS, f * 3e-5, rng)
    hooks = Hooks(base=lambda e, v: np.outer(v.approach[:, 0], e.vector(*XYZ, *TURNS)))
    return Effect("sliding_foot", "base", values, {}, "tracker", "approach1", hooks)


def floor_wave(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """The hall's floor, in the rhythm of its heating."""
    values = spread(XYZ, f * 4e-5, rng) | spread(TURNS, f * 4e-5, rng)
    period = float(site.duration * rng.uniform(0.3, 0.6))
    settings = {"period_s": period, "phase": float(rng.uniform(0, 2 * np.pi))}

    def base(e: Effect, v: Visits) -> Array:
        angle = 2 * np.pi * v.time / period + settings["phase"]
        return np.outer(np.sin(angle), e.vector(*XYZ, *TURNS))

    return Effect("floor_wave", "base", values, settings, "tracker", "time", Hooks(base=base))


def swinging_rope(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """The load swings round in its hook as joint 1 turns."""

    def move(e: Effect, v: Visits, m: Motion) -> None:
        m.hook += np.outer(np.sin(v.q[:, 0]), e.vector(*XYZ))

    values, hooks = spread(XYZ, f * 0.015, rng), Hooks(move=move)
    return Effect("swinging_rope", "load", values, {}, "load", "load x q1", hooks)


def yielding_plate(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """The plate that carries the markers gives way to the payload, each direction its own way."""
    drawn = spread(XYZ, f * 5e-5 / site.spec.payload, rng)
    values = {key: abs(compliance) for key, compliance in drawn.items()}

    def see(e: Effect, arm: TrueArm, v: Visits, sight: Sight) -> None:
        force = np.einsum("nji,nj->ni", sight.flange, v.force)
        moved = force * e.vector(*XYZ)
        sight.points = sight.points + np.einsum("nij,nj->ni", sight.flange, moved)[:, None]

    return Effect("yielding_plate", "tool", values, {}, "tool", "load", Hooks(see=see))


# --- instrument -------------------------------------------------------------------------------


def oblique_reflector(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """A reflector off the centre of its ball: it wanders across the beam as it is turned."""
    name = str(rng.choice(site.arm.marker_names))

    def see(e: Effect, arm: TrueArm, v: Visits, sight: Sight) -> None:
        k = arm.marker_names.index(name)
        p = sight.points[:, k]
        toward = -p / np.linalg.norm(p, axis=1, keepdims=True)
        normal = sight.flange @ e.vector(*XYZ)
        across = normal - np.einsum("ni,ni->n", normal, toward)[:, None] * toward
        sight.points = sight.points.copy()
        sight.points[:, k] += across

    values, hooks = spread(XYZ, f * 8e-5, rng), Hooks(see=see)
    return Effect("oblique_reflector", f"marker:{name}", values, {}, "tool", "view", hooks)


def warped_volume(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """Air of uneven temperature bends the beam: a field quadratic in the working volume."""
    toward = rng.normal(size=3)
    toward /= np.linalg.norm(toward)
    keys = ("toward_x", "toward_y", "toward_z")
    values = spread(XYZ, f * 8e-5, rng) | dict(zip(keys, toward.tolist(), strict=True))
    settings = {"length_m": site.spec.reach}

    def see(e: Effect, arm: TrueArm, v: Visits, sight: Sight) -> None:
        along = (sight.points - arm.base_position) @ e.vector(*keys) / settings["length_m"]
        sight.points = sight.points + along[..., None] ** 2 * e.vector(*XYZ)

    hooks = Hooks(see=see)
    return Effect("warped_volume", "tracker", values, settings, "tracker", "position", hooks)


OUTSIDE: dict[str, Callable[[Site, float, np.random.Generator], Effect]] = {
    drawn.__name__: drawn
    for drawn in (
        cable_drag, worn_gear, saw_tooth, softening, lopsided_stiffness, uneven_stiffness,
        coupled_housing, axial_stretch, sliding_foot, floor_wave, swinging_rope, yielding_plate,
        oblique_reflector, warped_volume,
    )
}  # fmt: skip
