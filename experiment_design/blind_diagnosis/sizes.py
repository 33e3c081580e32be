"""Where each catalogue effect may sit on an arm, and how large it is drawn there.

A factor, log-uniform in SPREAD where none is given, multiplies the realistic size of the effect.
Sizes are rms of a component: a pair sin, cos has √2 times the size as its amplitude.  Angles of
drives are those of a heavy arm's times `ArmSpec.gear`; compliances go with the arm's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from arm_data import ArmSpec
from chance import Values, log_uniform, positive, sign, spread
from places import Places, Site, all_or_one, at_joints, at_links, compensators, markers, only
from world import Effect

SPREAD = (0.6, 1.7)
TIME_CONSTANT = (900.0, 5400.0)  # s, log-uniform
CHANGE = (0.15, 0.85)  # of the campaign
ORDERS = (20.0, 300.0)  # log-uniform
KNOWN_ORDER = 0.7  # share of ripples whose order the cell lists
COMPENSATOR = {"anchor_x": 0.68, "anchor_y": 0.13, "arm": 0.19, "free_length": 0.46}  # m


Draw = Callable[[Site, int, float, np.random.Generator], tuple[Values, Values]]


@dataclass(frozen=True)
class Kind:
    """Where the effect may sit; draw(site, index, factor, rng) → its values and settings."""

    places: Places
    draw: Draw


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
    return Effect(name, where, values, settings)


def possible(name: str, spec: ArmSpec) -> bool:
    """Whether arms of this kind can have the effect at all."""
    return name != "gravity_compensator" or spec.has_compensator


def time_constant(rng: np.random.Generator) -> Values:
    return {"time_constant_s": log_uniform(TIME_CONSTANT, rng)}


def change_time(site: Site, key: str, rng: np.random.Generator) -> Values:
    return {key: float(rng.uniform(*CHANGE) * site.duration)}


def _pair(prefix: str, size: float) -> Draw:
    keys = (f"{prefix}_sin", f"{prefix}_cos")
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


def _hardening(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
    k3 = 0.2 * f * site.arm.compliance[j] / site.torque[j] ** 2
    return {"hardening": sign(rng) * float(k3)}, {}


def _compensator(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
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
    hook = spread(("load_point_x", "load_point_y", "load_point_z"), f * 0.010, rng)
    return {"payload_scale": sign(rng) * f * 0.02} | hook, {}


def _mass(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
    mass, com = site.arm.skeleton.mass[j], site.arm.skeleton.com[j]
    extra = sign(rng) * 0.1 * f * mass
    shift = np.array(list(spread(("x", "y", "z"), f * 0.02, rng).values()))
    moment = (mass + extra) * (com + shift) - mass * com
    keys = ("moment_x", "moment_y", "moment_z")
    return {"mass_error": float(extra)} | dict(zip(keys, moment.tolist(), strict=True)), {}


def _pose(prefix: str, shift: float, turn: float, f: float, rng: np.random.Generator) -> Values:
    shifts = spread((f"{prefix}_x", f"{prefix}_y", f"{prefix}_z"), f * shift, rng)
    return shifts | spread((f"{prefix}_rx", f"{prefix}_ry", f"{prefix}_rz"), f * turn, rng)


def _distortion(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
    circles = ("azimuth_sin", "azimuth_cos", "elevation_sin", "elevation_cos")
    scale, sag = sign(rng) * f * 2e-5, sign(rng) * f * 1e-6
    return {"scale": scale, "refraction": sag} | spread(circles, f * 2e-5, rng), {}


def _off_axis(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
    keys = ("off_axis_compliance_x", "off_axis_compliance_y")
    return positive(keys, 0.15 * f * float(site.arm.compliance[j]), rng), {}


def _bending(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
    keys = ("bending_y", "bending_z", "torsion")
    return positive(keys, 0.15 * f * float(site.arm.compliance[j]), rng), {}


def _pedestal(site: Site, j: int, f: float, rng: np.random.Generator) -> tuple[Values, Values]:
    size = 0.075 * f * float(site.arm.compliance[:2].mean())
    return positive(("tilt_compliance_x", "tilt_compliance_y"), size, rng), {}


_EVERY = at_joints(lambda s: s.joints)
_AT_WORK = at_joints(lambda s: s.at_work)
KINDS: dict[str, Kind] = {
    "encoder_scale": Kind(_EVERY, _signed("encoder_scale", 1e-4)),
    "gear_eccentricity": Kind(_EVERY, _pair("eccentricity", 1e-4)),
    "gear_second_harmonic": Kind(_EVERY, _pair("harmonic2", 5e-5)),
    "gear_ripple": Kind(_EVERY, _ripple),
    "wrist_coupling": Kind(
        only("wrist"),
        lambda s, j, f, g: (
            spread(("coupling_a", "coupling_b", "coupling_c"), f * s.spec.gear * 2e-4, g),
            {},
        ),
    ),
    "backlash": Kind(_AT_WORK, lambda s, j, f, g: ({"backlash": f * s.spec.gear * 2e-4}, {})),
    "hysteresis": Kind(_EVERY, _hysteresis),
    "joint_hardening": Kind(_AT_WORK, _hardening),
    "off_axis_compliance": Kind(_EVERY, _off_axis),
    "link_bending": Kind(at_links(lambda s: s.long_links), _bending),
    "base_compliance": Kind(only("base"), _pedestal),
    "gravity_compensator": Kind(compensators, _compensator),
    "payload_error": Kind(only("load"), _payload),
    "link_mass_error": Kind(at_links(lambda s: s.massive_links), _mass),
    "thermal_expansion": Kind(
        all_or_one,
        lambda s, j, f, g: ({"expansion": sign(g) * f * s.spec.expansion}, time_constant(g)),
    ),
    "base_drift": Kind(
        only("base"), lambda s, j, f, g: (_pose("drift", 5e-5, 5e-5, f, g), time_constant(g))
    ),
    "joint_drift": Kind(
        _EVERY,
        lambda s, j, f, g: (_signed("drift", 1e-4)(s, j, f, g)[0], time_constant(g)),
    ),
    "encoder_jump": Kind(
        _EVERY,
        lambda s, j, f, g: (
            _signed("jump", 1e-4)(s, j, f, g)[0],
            change_time(s, "jump_time_s", g),
        ),
    ),
    "frame_jump": Kind(
        only("tracker"),
        lambda s, j, f, g: (_pose("jump", 1e-4, 5e-5, f, g), change_time(s, "jump_time_s", g)),
    ),
    "marker_slip": Kind(
        markers,
        lambda s, j, f, g: (
            spread(("slip_x", "slip_y", "slip_z"), f * 1.5e-4, g),
            change_time(s, "slip_time_s", g),
        ),
    ),
    "tracker_distortion": Kind(only("tracker"), _distortion),
}
