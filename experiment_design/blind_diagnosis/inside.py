"""The effects of the catalogue: how each acts on the simulated arm, where it may sit, and how large
it is drawn there.

A factor, log-uniform in SPREAD where none is given, multiplies the realistic size of the effect.
Sizes are rms of a component: a pair sin, cos has √2 times the size as its amplitude.  Angles of
drives are those of a heavy arm's times `ArmSpec.gear`; compliances go with the arm's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from arm_data import ArmSpec
from mechanics import Spring, Tendon
from places import (
    Places,
    Site,
    Values,
    all_or_one,
    at,
    compensators,
    log_uniform,
    markers,
    only,
    positive,
    sign,
    spread,
)
from skeleton import Array, Skeleton, transverse
from world import Effect, Hooks, Motion, Sight, TrueArm, Visits, reweighed

Draw = Callable[[Site, int, float, np.random.Generator], tuple[Values, Values]]
POSE = ("x", "y", "z", "rx", "ry", "rz")
WRIST = ("coupling_a", "coupling_b", "coupling_c")
OFF_AXIS, TILT = (
    (f"{kind}_compliance_x", f"{kind}_compliance_y") for kind in ("off_axis", "tilt")
)  # fmt: skip
BENDING = ("bending_y", "bending_z", "torsion")
HOOK, MOMENT, SLIP = (
    tuple(f"{what}_{k}" for k in "xyz") for what in ("load_point", "moment", "slip")
)  # fmt: skip

SPREAD = (0.6, 1.7)
TIME_CONSTANT = (900.0, 5400.0)  # s, log-uniform
CHANGE = (0.15, 0.85)  # of the campaign
ORDERS = (20.0, 300.0)  # log-uniform
KNOWN_ORDER = 0.7  # share of ripples whose order the cell lists
COMPENSATOR = {"anchor_x": 0.68, "anchor_y": 0.13, "arm": 0.19, "free_length": 0.46}  # m


@dataclass(frozen=True)
class Kind:
    """Where the effect may sit; draw(site, index, factor, rng) → its values and settings; how it
    acts."""

    places: Places
    draw: Draw
    hooks: Hooks


def _keys(prefix: str) -> tuple[str, ...]:
    return tuple(f"{prefix}_{k}" for k in POSE)


def settled(visits: Visits, effect: Effect) -> Array:
    """1 − exp(−t/τ) (n,)."""
    return -np.expm1(-visits.time / effect.settings["time_constant_s"])


def after(visits: Visits, effect: Effect, key: str) -> Array:
    """1 from the change on, 0 before it (n,)."""
    return (visits.time >= effect.settings[key]).astype(float)


def _harmonic(order: float, prefix: str) -> Hooks:
    def drive(e: Effect, v: Visits) -> Array:
        angle = e.settings.get("ripple_order", order) * v.q[:, e.index]
        a, b = e.vector(f"{prefix}_sin", f"{prefix}_cos")
        return a * np.sin(angle) + b * np.cos(angle)

    return Hooks(drive=drive)


def _wrist_coupling(e: Effect, v: Visits, m: Motion) -> None:
    a, b, c = e.vector(*WRIST)
    m.drive[:, -2] += a * v.q[:, -3]
    m.drive[:, -1] += b * v.q[:, -3] + c * v.q[:, -2]


def _marker_slip(e: Effect, v: Visits, m: Motion) -> None:
    k = int(e.where.removeprefix("marker:M")) - 1
    m.markers[:, k] += np.outer(after(v, e, "slip_time_s"), e.vector(*SLIP))


def _thermal_expansion(e: Effect, v: Visits, m: Motion) -> None:
    strain = e.values["expansion"] * settled(v, e)
    if e.where == "all":
        m.stretch += strain[:, None]
    else:
        m.stretch[:, e.index] += strain


def _payload_error(e: Effect, v: Visits, m: Motion) -> None:
    m.force *= 1 + e.values["payload_scale"]
    m.hook += e.vector(*HOOK)


def _link_mass_error(e: Effect, skeleton: Skeleton) -> Skeleton:
    j = e.index
    mass = skeleton.mass[j] + e.values["mass_error"]
    moment = skeleton.mass[j] * skeleton.com[j] + e.vector(*MOMENT)
    return reweighed(skeleton, j, mass, moment / mass)


def _off_axis(e: Effect, arm: TrueArm) -> list[Spring]:
    axes = transverse(arm.skeleton.axis[e.index])
    k = e.vector(*OFF_AXIS)
    return [Spring(e.index + 1, a, c) for a, c in zip(axes, k, strict=True)]


def _link_bending(e: Effect, arm: TrueArm) -> list[Spring]:
    """At the link's distal end: across its direction, and about it."""
    j = e.index
    along = arm.skeleton.rotation[j + 1].T @ arm.skeleton.link_vector(j)
    axes = (*transverse(along), along / np.linalg.norm(along))
    k = e.vector(*BENDING)
    return [Spring(j + 2, a, c) for a, c in zip(axes, k, strict=True)]


def _pedestal(e: Effect, arm: TrueArm) -> list[Spring]:
    k = e.vector(*TILT)
    return [Spring(0, a, c) for a, c in zip(np.eye(3)[:2], k, strict=True)]


def _compensator(e: Effect) -> Tendon:
    stiffness, x, y, arm, free = (e.values[f"compensator_{k}"] for k in ("stiffness", *COMPENSATOR))
    return Tendon(e.index, stiffness, (x, y), arm, free)


def _wind_up(e: Effect, v: Visits, load: Array) -> Array:
    size = e.values["hysteresis"] + e.values["hysteresis_per_torque"] * np.abs(load[:, e.index])
    return v.approach[:, e.index] * size


def _instrument(e: Effect, arm: TrueArm, v: Visits, sight: Sight) -> None:
    """The instrument's own polar frame: errors of its two circles, its scale, and sag of the beam.

    It stands at the data's origin, z up.
    """
    x, y, z = np.moveaxis(sight.points, -1, 0)
    flat = np.hypot(x, y)
    r, azimuth, elevation = np.hypot(flat, z), np.arctan2(y, x), np.arctan2(z, flat)
    a, b = e.vector("azimuth_sin", "azimuth_cos")
    azimuth = azimuth + a * np.sin(azimuth) + b * np.cos(azimuth)
    a, b = e.vector("elevation_sin", "elevation_cos")
    elevation = elevation + a * np.sin(elevation) + b * np.cos(elevation)
    r = r * (1 + e.values["scale"])
    z = r * np.sin(elevation) + e.values["refraction"] * flat**2
    flat = r * np.cos(elevation)
    sight.points = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], axis=-1)


# --- sizes ------------------------------------------------------------------------------------


def draw_effect(
    chosen: str, site: Site, rng: np.random.Generator, factor: float | None = None
) -> Effect:
    """The effect "name" at a random place of the arm, or "name:where" at that place."""
    name, _, at = chosen.partition(":")
    places = [place for place in KINDS[name].places(site) if at in ("", place[0])]
    if not places:
        raise ValueError(f"{chosen} has no place on arm '{site.spec.name}'")
    where, index = places[rng.integers(len(places))]
    drawn = log_uniform(SPREAD, rng)
    values, settings = KINDS[name].draw(site, index, drawn if factor is None else factor, rng)
    return Effect(name, where, values, settings, hooks=KINDS[name].hooks)


def possible(name: str, spec: ArmSpec) -> bool:
    """Whether arms of this kind can have the effect at all."""
    return name != "gravity_compensator" or spec.has_compensator


def time_constant(rng: np.random.Generator) -> Values:
    return {"time_constant_s": log_uniform(TIME_CONSTANT, rng)}


def _of_gear(keys: tuple[str, ...], size: float) -> Draw:
    return lambda site, j, f, rng: (spread(keys, f * site.spec.gear * size, rng), {})


def _signed(key: str, size: float) -> Draw:
    return lambda site, j, f, rng: ({key: sign(rng) * f * site.spec.gear * size}, {})


def _ripple(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
    order = float(site.orders[j])
    if rng.random() >= KNOWN_ORDER:
        order = log_uniform(ORDERS, rng)
    size = f * site.spec.gear * 5e-5
    return spread(("ripple_sin", "ripple_cos"), size, rng), {"ripple_order": order}


def _hysteresis(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
    size = f * site.spec.gear * 5e-5
    growth = float(size / site.torque[j]) if j in site.at_work else 0.0
    return {"hysteresis": size, "hysteresis_per_torque": growth}, {}


def _harder(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
    k3 = 0.2 * f * site.arm.compliance[j] / site.torque[j] ** 2
    return {"hardening": sign(rng) * float(k3)}, {}


def _balance(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
    """Half the largest load torque at joint 2 is balanced, times the factor; q2 from −135° to 0."""
    g = {key: value * rng.uniform(0.97, 1.03) for key, value in COMPENSATOR.items()}
    q = np.linspace(-2.35, 0.0, 200)
    along = g["anchor_x"] * np.cos(q) + g["anchor_y"] * np.sin(q)
    across = g["anchor_y"] * np.cos(q) - g["anchor_x"] * np.sin(q)
    s = np.sqrt(g["anchor_x"] ** 2 + g["anchor_y"] ** 2 + g["arm"] ** 2 + 2 * g["arm"] * along)
    torque_per_stiffness = np.abs((1 - g["free_length"] / s) * g["arm"] * across).max()
    stiffness = 0.5 * f * site.torque[j] / torque_per_stiffness
    values = {"stiffness": float(stiffness)} | {key: float(value) for key, value in g.items()}
    return {f"compensator_{key}": value for key, value in values.items()}, {}


def _payload(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
    hook = spread(HOOK, f * 0.010, rng)
    return {"payload_scale": sign(rng) * f * 0.02} | hook, {}


def _mass(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
    mass, com = site.arm.skeleton.mass[j], site.arm.skeleton.com[j]
    extra = sign(rng) * 0.1 * f * mass
    shift = np.array(list(spread(("x", "y", "z"), f * 0.02, rng).values()))
    moment = (mass + extra) * (com + shift) - mass * com
    return {"mass_error": float(extra)} | dict(zip(MOMENT, moment.tolist(), strict=True)), {}


def _pose(prefix: str, shift: float, turn: float) -> Draw:
    keys = _keys(prefix)
    return lambda site, j, f, rng: (
        spread(keys[:3], f * shift, rng) | spread(keys[3:], f * turn, rng), {}
    )  # fmt: skip


def _distortion(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
    circles = ("azimuth_sin", "azimuth_cos", "elevation_sin", "elevation_cos")
    scale, sag = sign(rng) * f * 2e-5, sign(rng) * f * 1e-6
    return {"scale": scale, "refraction": sag} | spread(circles, f * 2e-5, rng), {}


def _soft(*keys: str) -> Draw:
    return lambda site, j, f, rng: (
        positive(keys, 0.15 * f * float(site.arm.compliance[j]), rng), {}
    )  # fmt: skip


def _tilting(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
    size = 0.075 * f * float(site.arm.compliance[:2].mean())
    return positive(TILT, size, rng), {}


def _timed(draw: Draw, change: str = "") -> Draw:
    """The values of a draw, and drawn after them when it changes, or how slowly it settles."""

    def drawn(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
        values, _ = draw(site, j, f, rng)
        if not change:
            return values, time_constant(rng)
        return values, {change: float(rng.uniform(*CHANGE) * site.duration)}

    return drawn


_EVERY = at("joint", lambda s: s.joints)
_AT_WORK = at("joint", lambda s: s.at_work)
KINDS: dict[str, Kind] = {
    "encoder_scale": Kind(
        _EVERY,
        _signed("encoder_scale", 1e-4),
        Hooks(drive=lambda e, v: e.values["encoder_scale"] * v.q[:, e.index]),
    ),
    "gear_eccentricity": Kind(
        _EVERY, _of_gear(("eccentricity_sin", "eccentricity_cos"), 1e-4),
        _harmonic(1.0, "eccentricity"),
    ),
    "gear_second_harmonic": Kind(
        _EVERY, _of_gear(("harmonic2_sin", "harmonic2_cos"), 5e-5), _harmonic(2.0, "harmonic2")
    ),
    "gear_ripple": Kind(_EVERY, _ripple, _harmonic(np.nan, "ripple")),
    "wrist_coupling": Kind(only("wrist"), _of_gear(WRIST, 2e-4), Hooks(move=_wrist_coupling)),
    "backlash": Kind(
        _AT_WORK,
        lambda s, j, f, g: ({"backlash": f * s.spec.gear * 2e-4}, {}),
        Hooks(play=lambda e: {e.index: e.values["backlash"]}),
    ),
    "hysteresis": Kind(_EVERY, _hysteresis, Hooks(slack=_wind_up)),
    "joint_hardening": Kind(
        _AT_WORK, _harder, Hooks(slack=lambda e, v, t: e.values["hardening"] * t[:, e.index] ** 3)
    ),
    "off_axis_compliance": Kind(_EVERY, _soft(*OFF_AXIS), Hooks(springs=_off_axis)),
    "link_bending": Kind(
        at("link", lambda s: s.long_links), _soft(*BENDING), Hooks(springs=_link_bending)
    ),
    "base_compliance": Kind(only("base"), _tilting, Hooks(springs=_pedestal)),
    "gravity_compensator": Kind(compensators, _balance, Hooks(tendon=_compensator)),
    "payload_error": Kind(only("load"), _payload, Hooks(move=_payload_error)),
    "link_mass_error": Kind(
        at("link", lambda s: s.massive_links), _mass, Hooks(weigh=_link_mass_error)
    ),
    "thermal_expansion": Kind(
        all_or_one,
        lambda s, j, f, g: ({"expansion": sign(g) * f * s.spec.expansion}, time_constant(g)),
        Hooks(move=_thermal_expansion),
    ),
    "base_drift": Kind(
        only("base"), _timed(_pose("drift", 5e-5, 5e-5)),
        Hooks(base=lambda e, v: np.outer(settled(v, e), e.vector(*_keys("drift")))),
    ),
    "joint_drift": Kind(
        _EVERY, _timed(_signed("drift", 1e-4)),
        Hooks(drive=lambda e, v: e.values["drift"] * settled(v, e)),
    ),
    "encoder_jump": Kind(
        _EVERY, _timed(_signed("jump", 1e-4), "jump_time_s"),
        Hooks(drive=lambda e, v: e.values["jump"] * after(v, e, "jump_time_s")),
    ),
    "frame_jump": Kind(
        only("tracker"), _timed(_pose("jump", 1e-4, 5e-5), "jump_time_s"),
        Hooks(base=lambda e, v: np.outer(after(v, e, "jump_time_s"), e.vector(*_keys("jump")))),
    ),
    "marker_slip": Kind(
        markers, _timed(lambda s, j, f, g: (spread(SLIP, f * 1.5e-4, g), {}), "slip_time_s"),
        Hooks(move=_marker_slip),
    ),
    "tracker_distortion": Kind(only("tracker"), _distortion, Hooks(see=_instrument)),
}  # fmt: skip
