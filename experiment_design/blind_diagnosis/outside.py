"""Effects that the catalogue does not have, each with its true location.

`stage` and `where` are in the words of the diagnosis; `driver` says what the disturbance follows:
a joint's commanded angle "q2", its load "torque2" or direction "approach1", "time", "load",
"position" of the marker, "view" (the angle it is seen under), or a product of two.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from inside import SPREAD, settled, time_constant
from mechanics import Spring
from places import Site, log_uniform, sign, spread
from skeleton import Array
from world import Effect, Hooks, Motion, Sight, TrueArm, Visits

Maker = Callable[[Site, float, np.random.Generator], Effect]


@dataclass(frozen=True)
class Outside:
    """How the effect acts, and make(site, factor, rng) → one of its kind."""

    hooks: Hooks
    make: Maker


def draw_outside(
    name: str, site: Site, rng: np.random.Generator, factor: float | None = None
) -> Effect:
    """The named effect at a random place; factor over its size, log-uniform where none is given."""
    drawn = log_uniform(SPREAD, rng)
    made = OUTSIDE[name].make(site, drawn if factor is None else factor, rng)
    return replace(made, hooks=OUTSIDE[name].hooks)


# --- transmission -----------------------------------------------------------------------------


def _cable(e: Effect, v: Visits, m: Motion) -> None:
    q = v.q[:, int(e.settings["by_joint"]) - 1]
    m.drive[:, e.index] += e.values["sin"] * np.sin(q) + e.values["cos"] * np.cos(q)


def _make_cable(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """Cables along the arm pull one joint as a joint before it turns."""
    j, by = int(rng.choice(site.joints[2:-1])), int(rng.integers(2))
    values = spread(("sin", "cos"), f * site.spec.gear * 1e-4, rng)
    settings = {"by_joint": by + 1.0}
    return Effect("cable_drag", f"joint{j + 1}", values, settings, "transmission", f"q{by + 1}")


def _tooth(e: Effect, v: Visits, m: Motion) -> None:
    s = e.settings
    away = (v.q[:, e.index] - s["centre"]) / s["width"]
    m.drive[:, e.index] += e.values["height"] * np.exp(-0.5 * away**2)


def _make_tooth(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """A worn stretch of the gear, where the joint mostly worked: a bump over some 40 degrees."""
    j = int(rng.choice(site.joints))
    s = site.arm.skeleton
    centre = s.lower[j] + (s.upper[j] - s.lower[j]) * rng.uniform(0.3, 0.7)
    settings = {"centre": float(centre), "width": 0.3}
    values = {"height": sign(rng) * f * site.spec.gear * 2e-4}
    where = f"joint{j + 1}"
    return Effect("worn_gear", where, values, settings, "transmission", f"q{j + 1}")


def _saw(e: Effect, v: Visits, m: Motion) -> None:
    turns = v.time / e.settings["period_s"] + e.settings["phase"]
    m.drive[:, e.index] += e.values["height"] * (turns % 1.0 - 0.5)


def _make_saw(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """A reference that creeps and is set back at regular times."""
    j = int(rng.choice(site.joints))
    period = float(site.duration * rng.uniform(0.2, 0.35))
    settings = {"period_s": period, "phase": float(rng.random())}
    values = {"height": sign(rng) * f * site.spec.gear * 3e-4}
    return Effect("saw_tooth", f"joint{j + 1}", values, settings, "transmission", "time")


# --- compliance -------------------------------------------------------------------------------


def _creep(e: Effect, v: Visits, load: Array, free: Array) -> None:
    free[:, e.index] += e.values["compliance"] * load[:, e.index] * settled(v, e)


def _make_creep(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """A drive that softens as it warms up."""
    j = int(rng.choice(site.at_work))
    values = {"compliance": 0.15 * f * float(site.arm.compliance[j])}
    where, driver = f"joint{j + 1}", f"torque{j + 1} x time"
    return Effect("softening", where, values, time_constant(rng), "compliance", driver)


def _lopsided(e: Effect, v: Visits, load: Array, free: Array) -> None:
    free[:, e.index] += e.values["compliance"] * np.maximum(load[:, e.index], 0.0)


def _make_lopsided(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """A joint that is softer under torque of one sign."""
    j = int(rng.choice(site.two_sided))
    values = {"compliance": 0.2 * f * float(site.arm.compliance[j])}
    return Effect("lopsided_stiffness", f"joint{j + 1}", values, {}, "compliance", f"torque{j + 1}")


def _uneven(e: Effect, v: Visits, load: Array, free: Array) -> None:
    share = np.sin(e.settings["order"] * v.q[:, e.index] + e.settings["phase"])
    free[:, e.index] += e.values["compliance"] * load[:, e.index] * share


def _make_uneven(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """A gear whose stiffness changes over its turn: twice, as a bent cage makes it."""
    j = int(rng.choice(site.at_work))
    values = {"compliance": 0.12 * f * float(site.arm.compliance[j])}
    settings = {"order": 2.0, "phase": float(rng.uniform(0, 2 * np.pi))}
    where, driver = f"joint{j + 1}", f"torque{j + 1} x q{j + 1}"
    return Effect("uneven_stiffness", where, values, settings, "compliance", driver)


def _coupled(e: Effect, v: Visits, load: Array, free: Array) -> None:
    free[:, e.index] += e.values["compliance"] * load[:, e.index - 1]


def _make_coupled(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """The housing between two drives: the torque of one twists the other."""
    pairs = [j for j in site.at_work if j - 1 in site.at_work]
    j = int(rng.choice(pairs))
    values = {"compliance": sign(rng) * 0.1 * f * float(site.arm.compliance[j - 1])}
    where = f"joint{j + 1}"
    return Effect("coupled_housing", where, values, {}, "compliance", f"torque{j}")


def _stretch(e: Effect, arm: TrueArm) -> list[Spring]:
    j = e.index
    along = arm.skeleton.rotation[j + 1].T @ arm.skeleton.link_vector(j)
    return [Spring(j + 2, along / np.linalg.norm(along), e.values["compliance"], "slide")]


def _make_stretch(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """A loose flange that lets a link grow and shrink along itself: 40 µm at the payload."""
    j = int(rng.choice([i for i in site.long_links if i > 0]))
    values = {"compliance": f * 4e-5 / site.spec.payload}
    return Effect("axial_stretch", f"link{j + 1}", values, {}, "compliance", "load")


# --- base, load and tool ----------------------------------------------------------------------


def _foot(e: Effect, v: Visits, m: Motion) -> None:
    m.base += np.outer(v.approach[:, 0], e.vector("x", "y", "z", "rx", "ry", "rz"))


def _make_foot(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """Loose anchor bolts: the foot slides back and forth as joint 1 brakes."""
    values = spread(("x", "y", "z"), f * 4e-5, rng) | spread(("rx", "ry", "rz"), f * 3e-5, rng)
    return Effect("sliding_foot", "base", values, {}, "tracker", "approach1")


def _wave(e: Effect, v: Visits, m: Motion) -> None:
    angle = 2 * np.pi * v.time / e.settings["period_s"] + e.settings["phase"]
    m.base += np.outer(np.sin(angle), e.vector("x", "y", "z", "rx", "ry", "rz"))


def _make_wave(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """The hall's floor, in the rhythm of its heating."""
    values = spread(("x", "y", "z"), f * 4e-5, rng) | spread(("rx", "ry", "rz"), f * 4e-5, rng)
    period = float(site.duration * rng.uniform(0.3, 0.6))
    settings = {"period_s": period, "phase": float(rng.uniform(0, 2 * np.pi))}
    return Effect("floor_wave", "base", values, settings, "tracker", "time")


def _rope(e: Effect, v: Visits, m: Motion) -> None:
    m.hook += np.outer(np.sin(v.q[:, 0]), e.vector("x", "y", "z"))


def _make_rope(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """The load swings round in its hook as joint 1 turns."""
    values = spread(("x", "y", "z"), f * 0.015, rng)
    return Effect("swinging_rope", "load", values, {}, "load", "load x q1")


def _plate(e: Effect, arm: TrueArm, v: Visits, sight: Sight) -> None:
    force = np.einsum("nji,nj->ni", sight.flange, v.force)
    moved = force * e.vector("x", "y", "z")
    sight.points = sight.points + np.einsum("nij,nj->ni", sight.flange, moved)[:, None]


def _make_plate(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """The plate that carries the markers gives way to the payload, each direction its own way."""
    drawn = spread(("x", "y", "z"), f * 5e-5 / site.spec.payload, rng)
    values = {key: abs(compliance) for key, compliance in drawn.items()}
    return Effect("yielding_plate", "tool", values, {}, "tool", "load")


# --- instrument -------------------------------------------------------------------------------


def _oblique(e: Effect, arm: TrueArm, v: Visits, sight: Sight) -> None:
    k = arm.marker_names.index(e.where.removeprefix("marker:"))
    p = sight.points[:, k]
    toward = -p / np.linalg.norm(p, axis=1, keepdims=True)
    normal = sight.flange @ e.vector("x", "y", "z")
    across = normal - np.einsum("ni,ni->n", normal, toward)[:, None] * toward
    sight.points = sight.points.copy()
    sight.points[:, k] += across


def _make_oblique(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """A reflector off the centre of its ball: it wanders across the beam as it is turned."""
    name = str(rng.choice(site.arm.marker_names))
    values = spread(("x", "y", "z"), f * 8e-5, rng)
    return Effect("oblique_reflector", f"marker:{name}", values, {}, "tool", "view")


def _warp(e: Effect, arm: TrueArm, v: Visits, sight: Sight) -> None:
    direction = e.vector("toward_x", "toward_y", "toward_z")
    along = (sight.points - arm.base_position) @ direction / e.settings["length_m"]
    sight.points = sight.points + along[..., None] ** 2 * e.vector("x", "y", "z")


def _make_warp(site: Site, f: float, rng: np.random.Generator) -> Effect:
    """Air of uneven temperature bends the beam: a field quadratic in the working volume."""
    toward = rng.normal(size=3)
    toward /= np.linalg.norm(toward)
    keys = ("toward_x", "toward_y", "toward_z")
    values = spread(("x", "y", "z"), f * 8e-5, rng) | dict(zip(keys, toward.tolist(), strict=True))
    settings = {"length_m": site.spec.reach}
    return Effect("warped_volume", "tracker", values, settings, "tracker", "position")


OUTSIDE: dict[str, Outside] = {
    "cable_drag": Outside(Hooks(move=_cable), _make_cable),
    "worn_gear": Outside(Hooks(move=_tooth), _make_tooth),
    "saw_tooth": Outside(Hooks(move=_saw), _make_saw),
    "softening": Outside(Hooks(slack=_creep), _make_creep),
    "lopsided_stiffness": Outside(Hooks(slack=_lopsided), _make_lopsided),
    "uneven_stiffness": Outside(Hooks(slack=_uneven), _make_uneven),
    "coupled_housing": Outside(Hooks(slack=_coupled), _make_coupled),
    "axial_stretch": Outside(Hooks(springs=_stretch), _make_stretch),
    "sliding_foot": Outside(Hooks(move=_foot), _make_foot),
    "floor_wave": Outside(Hooks(move=_wave), _make_wave),
    "swinging_rope": Outside(Hooks(move=_rope), _make_rope),
    "yielding_plate": Outside(Hooks(see=_plate), _make_plate),
    "oblique_reflector": Outside(Hooks(see=_oblique), _make_oblique),
    "warped_volume": Outside(Hooks(see=_warp), _make_warp),
}
