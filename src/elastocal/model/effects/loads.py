"""What pulls at the arm: the payload, the weights of the links, the compensator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from elastocal.cell.work_cell import Cell
from elastocal.errors import require
from elastocal.model import rigid
from elastocal.model.arm import Arm, ParameterSpec
from elastocal.model.chain import Chain
from elastocal.model.effects.base import (
    RECORD_TORQUES,
    STIFFNESS,
    WEIGH_LOAD,
    Effect,
    Symbols,
    index,
    joints,
    links,
)
from elastocal.model.effects.placements import SHORTEST, link_ends
from elastocal.model.evaluate import BatchFunction
from elastocal.units import Array


class Payload(Effect):
    """f = (force_x, force_y, force_z) of the row, acting at `load_point_m` of the tool.

    The force is constant in the tracker frame (a hanging weight, a rope over a pulley) and its
    point moves with the arm: V = −f·p_load(θ).  No parameters.
    """

    name = "payload"
    stage = "load"
    at = "load"
    formats = ("elastic",)

    def acts_unasked(self, cell: Cell) -> bool:
        return True

    def may_be_missing(self, cell: Cell) -> bool:
        return False

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        arm.add_force(rigid.point(arm.T_tracker_flange, arm.load_point), arm.input("force", 3))


class PayloadError(Effect):
    """The row's force f acts as (1 + s) f at `load_point_m` + d; s (1), d (3,) m, flange frame.

    The weight was not weighed, or the load hangs elsewhere than drawn.  Adds to the declared
    load's potential −f·p(θ) what is missing: V = −f·(s p + (1 + s) R d), R the flange's rotation.
    """

    name = "payload_error"
    stage = "load"
    at = "load"
    formats = ("elastic",)
    remedy = WEIGH_LOAD
    needs = ("load",)
    unknowns = (
        ParameterSpec("payload_scale", "1", 0.0, 0.02),
        *(ParameterSpec(f"load_point_{k}", "m", 0.0, 0.01) for k in "xyz"),
    )

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        force, T = arm.input("force", 3), arm.T_tracker_flange
        scale = p["payload_scale"]
        shift = ca.vertcat(*[p[f"load_point_{k}"] for k in "xyz"])
        arm.add_force(rigid.point(T, arm.load_point), scale * force)
        arm.add_potential(-(1 + scale) * ca.dot(force, T[:3, :3] @ shift))


STANDARD_GRAVITY = 9.80665  # m/s², along −z of the tracker frame, which is vertical


class LinkGravity(Effect):
    """Weight m g of each link at its centre of mass: V = m g z_com(θ).  No parameters.

    Masses and centres of mass are the URDF's (or the DH robot's table of masses).
    """

    name = "link_gravity"
    stage = "load"
    at = "links"
    formats = ("elastic",)

    def acts_unasked(self, cell: Cell) -> bool:
        return cell.model.link_gravity

    def may_be_missing(self, cell: Cell) -> bool:
        return False

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        require(
            bool(chain.masses),
            f"link_gravity is on, but robot '{chain.name}' has no masses: give <inertial> "
            'elements in the URDF, or [robot] masses = "links.csv" for a DH robot, '
            "or set [model] link_gravity = false",
        )
        return ()

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        i = index(place)
        body = arm.chain.masses[i]
        com = rigid.point(arm.T_tracker_link[i], rigid.constant(body.com))
        arm.add_force(com, ca.vertcat(0, 0, -body.mass * STANDARD_GRAVITY))


DISPLACED = 0.02  # m; typical error of a centre of mass


class LinkMassError(Effect):
    """V = g (m z + (R s)_z): mass m (kg) and first moment s (3,) (kg m) missing from a link.

    z is the height of the link's joint frame and R its rotation; s is taken in that frame.  A
    mass error δm with its centre at c is m = δm, s = δm c; a centre of mass displaced by δc is
    s = m₀ δc.  Cables, hoses and gear oil are in no CAD file.  Where `link_gravity` is off, all
    of the link's weight is missing, and the typical sizes are the URDF's own.  Places: links
    whose mass the robot's file gives.
    """

    name = "link_mass_error"
    stage = "load"
    formats = ("elastic",)
    remedy = RECORD_TORQUES

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        pairs = zip(links(chain), chain.masses, strict=False)
        return tuple(link for link, body in pairs if body.mass > 0)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        body = chain.masses[index(place)]
        share = 0.1 if cell.model.link_gravity else 1.0
        moment = body.mass * (share * float(np.linalg.norm(body.com)) + DISPLACED)
        return (
            ParameterSpec("mass_error", "kg", 0.0, share * body.mass),
            *(ParameterSpec(f"moment_{k}", "kg*m", 0.0, moment) for k in "xyz"),
        )

    def unphysical(self, values: Mapping[str, float], chain: Chain, cell: Cell) -> str:
        reason = ""
        for link, own in zip(links(chain), chain.masses, strict=False):
            error = values.get(f"{link}.mass_error")
            nominal = own.mass if cell.model.link_gravity else 0.0
            if error is not None and nominal + error <= 0:
                reason = f"the mass of {link} would be {nominal + error:.3g} kg"
        return reason

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        T = arm.T_tracker_link[index(place)]
        moment = ca.vertcat(*[p[f"moment_{k}"] for k in "xyz"])
        height = p["mass_error"] * T[2, 3] + T[2, :3] @ moment
        arm.add_potential(STANDARD_GRAVITY * height)


GEOMETRY = (
    "compensator_anchor_x", "compensator_anchor_y", "compensator_arm", "compensator_free_length",
)  # fmt: skip
# Rough geometry of a KR 270 compensator: an example to start from, to be identified.
EXAMPLE: dict[str, Any] = {
    "stiffness_N_per_m": 0.0,
    "anchor_m": (0.686, 0.120),
    "arm_m": 0.185,
    "free_length_m": 0.458,
}
# Geometries from which an unknown compensator is sought.  Only its shape counts, the angle of the
# anchor, the arm and the free length over the anchor's distance a: sizes trade with the stiffness.
ANCHOR_SHARE = 0.3  # of the length of the joint's link
ANCHOR_DEFAULT = 0.4  # m, where it has none
ANGLES, ARMS = 24, (0.12, 0.25, 0.4, 0.6, 0.8)
# s₀/a of springs that pull and push a little and much, of gas springs that push and pull with
# nearly the same force everywhere, in shares of the shortest and the longest length or of a.
# Without a free length a torque is a sine, whatever the arm.
PULLING, PUSHING, GAS = (0.7,), (1.3,), (6.0, -4.0)
NO_LENGTH = (0.25, 0.0)


def spring_energy(q: Any, x: Any, y: Any, arm: Any, free: Any) -> ca.SX:
    """½ (s − s₀)² of a spring of unit stiffness between (x, y) and an arm turned by q."""
    s = ca.sqrt(x**2 + y**2 + arm**2 + 2 * arm * (x * ca.cos(q) + y * ca.sin(q)))
    return (s - free) ** 2 / 2


@cache
def spring_torque() -> BatchFunction:
    """The torque of that spring, of the angle and the geometry (x, y, arm, free)."""
    angle, shape = ca.SX.sym("q"), ca.SX.sym("shape", len(GEOMETRY))
    energy = spring_energy(angle, *ca.vertsplit(shape))
    return BatchFunction([angle, shape], [ca.gradient(energy, angle)])


class GravityCompensator(Effect):
    """Spring of stiffness K_c and free length s₀ acting at arm L, anchored at (a_x, a_y).

    s² = a² + L² + 2 a L cos(α − q), a = |(a_x, a_y)|, α = atan2(a_y, a_x), V = ½ K_c (s − s₀)²,
    hence the torque M = −K_c (1 − s₀/s) a L sin(α − q) about the joint, taken at the deflected
    angle (Klimchik et al. 2013, section 5).  Geometry comes from `[model.nominal]
    gravity_compensator`; without it an example geometry and zero stiffness are the start, and a
    diagnosis looks through others: pulling, pushing and gas springs (nearly constant force: a free
    length far from s, below zero where it pulls) anchored anywhere.
    """

    name = "gravity_compensator"
    stage = "load"
    rank = STIFFNESS
    formats = ("elastic",)
    remedy = RECORD_TORQUES

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        given = cell.model.nominal.gravity_compensator
        return joints(chain)[1:2] if given is None else (str(given["joint"]),)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        given = EXAMPLE | (cell.model.nominal.gravity_compensator or {})
        anchor_x, anchor_y = given["anchor_m"]
        stiffness = float(given["stiffness_N_per_m"])
        return (
            ParameterSpec("compensator_stiffness", "N/m", stiffness, abs(stiffness) or None),
            ParameterSpec("compensator_anchor_x", "m", float(anchor_x), 1e-2),
            ParameterSpec("compensator_anchor_y", "m", float(anchor_y), 1e-2),
            ParameterSpec("compensator_arm", "m", float(given["arm_m"]), 1e-2),
            ParameterSpec("compensator_free_length", "m", float(given["free_length_m"]), 1e-2),
        )

    def starts(self, place: str, chain: Chain, cell: Cell) -> tuple[dict[str, float], ...]:
        if cell.model.nominal.gravity_compensator is not None:
            return ()
        length = float(np.linalg.norm(link_ends(chain)[index(place)][:3, 3]))
        a = ANCHOR_SHARE * length if length > SHORTEST else ANCHOR_DEFAULT
        shapes = [NO_LENGTH]
        for share in ARMS:
            shapes += [(share, f * (1 - share)) for f in PULLING]
            shapes += [(share, f * (1 + share)) for f in PUSHING]
            shapes += [(share, f) for f in GAS]
        return tuple(
            dict(zip(GEOMETRY, (a * np.cos(t), a * np.sin(t), a * share, a * free), strict=True))
            for t in np.linspace(0, 2 * np.pi, ANGLES, endpoint=False)
            for share, free in shapes
        )

    def profiles(self, place: str, starts: Sequence[Mapping[str, float]], q: Array) -> Array | None:
        """The torque of a spring of unit stiffness."""
        shapes = np.array([[start[key] for key in GEOMETRY] for start in starts])
        known, row = np.unique(q[:, index(place)], return_inverse=True)
        angles, every = np.repeat(known, len(starts)), np.tile(shapes, (len(known), 1))
        (values,) = spring_torque()(angles[:, None], every)
        return np.asarray(values.reshape(len(known), len(starts))[row.ravel()])

    def hints(self, place: str, values: Mapping[str, float]) -> dict[str, Any]:
        x, y, arm, free = (values[key] for key in GEOMETRY)
        turned = -1.0 if arm < 0 else 1.0  # the other end of the arm, seen from the other side
        table = {
            "joint": place,
            # Of a spring that the readings would have push the other way a fit starts from none.
            "stiffness_N_per_m": max(values["compensator_stiffness"], 0.0),
            "anchor_m": [turned * x, turned * y],
            "arm_m": turned * arm,
            "free_length_m": free,
        }
        return {"gravity_compensator": table}

    def unphysical(self, values: Mapping[str, float], chain: Chain, cell: Cell) -> str:
        keys = (".compensator_stiffness", ".compensator_free_length")
        negative = any(v < 0 for name, v in values.items() if name.endswith(keys))
        return "negative stiffness or free length" if negative else ""

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        q = arm.joint_angle(index(place))
        arm.add_potential(p["compensator_stiffness"] * spring_energy(q, *(p[k] for k in GEOMETRY)))
