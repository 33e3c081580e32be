"""How each effect of the catalogue acts on the simulated arm."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mjcf import Spring, Tendon
from numpy.typing import NDArray
from skeleton import Skeleton, transverse
from world import Effect, Hooks, Motion, Sight, TrueArm, Visits, reweighed

Array = NDArray[np.float64]
Move = Callable[[Effect, Visits, Motion], None]
POSE = ("x", "y", "z", "rx", "ry", "rz")


def settled(visits: Visits, effect: Effect) -> Array:
    """1 − exp(−t/τ) (n,)."""
    return -np.expm1(-visits.time / effect.settings["time_constant_s"])


def after(visits: Visits, effect: Effect, key: str) -> Array:
    """1 from the change on, 0 before it (n,)."""
    return (visits.time >= effect.settings[key]).astype(float)


def _harmonic(order: float, prefix: str) -> Move:
    def move(e: Effect, v: Visits, m: Motion) -> None:
        angle = e.settings.get("ripple_order", order) * v.q[:, e.index]
        a, b = e.vector(f"{prefix}_sin", f"{prefix}_cos")
        m.drive[:, e.index] += a * np.sin(angle) + b * np.cos(angle)

    return move


def _encoder_scale(e: Effect, v: Visits, m: Motion) -> None:
    m.drive[:, e.index] += e.values["encoder_scale"] * v.q[:, e.index]


def _wrist_coupling(e: Effect, v: Visits, m: Motion) -> None:
    a, b, c = e.vector("coupling_a", "coupling_b", "coupling_c")
    m.drive[:, -2] += a * v.q[:, -3]
    m.drive[:, -1] += b * v.q[:, -3] + c * v.q[:, -2]


def _joint_drift(e: Effect, v: Visits, m: Motion) -> None:
    m.drive[:, e.index] += e.values["drift"] * settled(v, e)


def _encoder_jump(e: Effect, v: Visits, m: Motion) -> None:
    m.drive[:, e.index] += e.values["jump"] * after(v, e, "jump_time_s")


def _base_drift(e: Effect, v: Visits, m: Motion) -> None:
    m.base += np.outer(settled(v, e), e.vector(*[f"drift_{k}" for k in POSE]))


def _frame_jump(e: Effect, v: Visits, m: Motion) -> None:
    m.base += np.outer(after(v, e, "jump_time_s"), e.vector(*[f"jump_{k}" for k in POSE]))


def _marker_slip(e: Effect, v: Visits, m: Motion) -> None:
    k = int(e.where.removeprefix("marker:M")) - 1
    slip = e.vector("slip_x", "slip_y", "slip_z")
    m.markers[:, k] += np.outer(after(v, e, "slip_time_s"), slip)


def _thermal_expansion(e: Effect, v: Visits, m: Motion) -> None:
    strain = e.values["expansion"] * settled(v, e)
    if e.where == "all":
        m.stretch += strain[:, None]
    else:
        m.stretch[:, e.index] += strain


def _payload_error(e: Effect, v: Visits, m: Motion) -> None:
    m.force *= 1 + e.values["payload_scale"]
    m.hook += e.vector("load_point_x", "load_point_y", "load_point_z")


def _link_mass_error(e: Effect, skeleton: Skeleton) -> Skeleton:
    j = e.index
    mass = skeleton.mass[j] + e.values["mass_error"]
    moment = skeleton.mass[j] * skeleton.com[j] + e.vector("moment_x", "moment_y", "moment_z")
    return reweighed(skeleton, j, mass, moment / mass)


def _off_axis(e: Effect, arm: TrueArm) -> list[Spring]:
    axes = transverse(arm.skeleton.axis[e.index])
    k = e.vector("off_axis_compliance_x", "off_axis_compliance_y")
    return [Spring(e.index + 1, a, c) for a, c in zip(axes, k, strict=True)]


def _link_bending(e: Effect, arm: TrueArm) -> list[Spring]:
    """At the link's distal end: across its direction, and about it."""
    j = e.index
    along = arm.skeleton.rotation[j + 1].T @ arm.skeleton.link_vector(j)
    axes = (*transverse(along), along / np.linalg.norm(along))
    k = e.vector("bending_y", "bending_z", "torsion")
    return [Spring(j + 2, a, c) for a, c in zip(axes, k, strict=True)]


def _pedestal(e: Effect, arm: TrueArm) -> list[Spring]:
    k = e.vector("tilt_compliance_x", "tilt_compliance_y")
    return [Spring(0, a, c) for a, c in zip(np.eye(3)[:2], k, strict=True)]


def _compensator(e: Effect) -> Tendon:
    v = e.values
    anchor = (v["compensator_anchor_x"], v["compensator_anchor_y"])
    return Tendon(
        e.index, v["compensator_stiffness"], anchor, v["compensator_arm"],
        v["compensator_free_length"],
    )  # fmt: skip


def _wind_up(e: Effect, v: Visits, load: Array, free: Array) -> None:
    j = e.index
    size = e.values["hysteresis"] + e.values["hysteresis_per_torque"] * np.abs(load[:, j])
    free[:, j] += v.approach[:, j] * size


def _hardening(e: Effect, v: Visits, load: Array, free: Array) -> None:
    free[:, e.index] += e.values["hardening"] * load[:, e.index] ** 3


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


INSIDE: dict[str, Hooks] = {
    "encoder_scale": Hooks(move=_encoder_scale),
    "gear_eccentricity": Hooks(move=_harmonic(1.0, "eccentricity")),
    "gear_second_harmonic": Hooks(move=_harmonic(2.0, "harmonic2")),
    "gear_ripple": Hooks(move=_harmonic(np.nan, "ripple")),
    "wrist_coupling": Hooks(move=_wrist_coupling),
    "backlash": Hooks(play=lambda e: {e.index: e.values["backlash"]}),
    "hysteresis": Hooks(slack=_wind_up),
    "joint_hardening": Hooks(slack=_hardening),
    "off_axis_compliance": Hooks(springs=_off_axis),
    "link_bending": Hooks(springs=_link_bending),
    "base_compliance": Hooks(springs=_pedestal),
    "gravity_compensator": Hooks(tendon=_compensator),
    "payload_error": Hooks(move=_payload_error),
    "link_mass_error": Hooks(weigh=_link_mass_error),
    "thermal_expansion": Hooks(move=_thermal_expansion),
    "base_drift": Hooks(move=_base_drift),
    "joint_drift": Hooks(move=_joint_drift),
    "encoder_jump": Hooks(move=_encoder_jump),
    "frame_jump": Hooks(move=_frame_jump),
    "marker_slip": Hooks(move=_marker_slip),
    "tracker_distortion": Hooks(see=_instrument),
}
