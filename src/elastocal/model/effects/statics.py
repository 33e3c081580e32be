"""What pulls at the arm (payload, compensator, weights of the links), and what yields: joints,
bearings, links and base, and how large torques get."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from elastocal.cell import Cell
from elastocal.messages import require, rounded
from elastocal.model import rigid
from elastocal.model.chain import Chain
from elastocal.model.effects.base import (
    SHORTEST,
    STIFFNESS,
    Arm,
    DrivenEffect,
    Effect,
    JointMotion,
    LinkFrame,
    ParameterSpec,
    Setting,
    Spring,
    Symbols,
    index,
    joints,
    links,
    motion_unit,
    transverse_axes,
    turning_joints,
)
from elastocal.model.evaluate import ONCE, BatchFunction
from elastocal.units import Array


class Payload(Effect):
    """f = (force_x, force_y, force_z) of the row, acting at `load_point_m` of the tool.

    The force is constant in the tracker frame (a hanging weight, a rope over a pulley) and its
    point moves with the arm: V = −f·p_load(θ).  No parameters.
    """

    name, stage, at = "payload", "load", "load"
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

    name, stage, at = "payload_error", "load", "load"
    formats = ("elastic",)
    remedy = "weigh the load and measure where it hangs"
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


RECORD_TORQUES = (
    "record the joints' torques or motor currents, which a wrong weight or spring changes "
    "and a gear error does not"
)
STANDARD_GRAVITY = 9.80665  # m/s², along −z of the tracker frame, which is vertical


class LinkGravity(Effect):
    """Weight m g of each link at its centre of mass: V = m g z_com(θ).  No parameters.

    Masses and centres of mass are the URDF's (or the DH robot's table of masses).
    """

    name, stage, at = "link_gravity", "load", "links"
    formats = ("elastic",)

    def acts_unasked(self, cell: Cell) -> bool:
        return cell.model.link_gravity

    def may_be_missing(self, cell: Cell) -> bool:
        return False

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        require(
            bool(arm.chain.masses),
            f"link_gravity is on, but robot '{arm.chain.name}' has no masses: give <inertial> "
            'elements in the URDF, or [robot] masses = "links.csv" for a DH robot, '
            "or set [model] link_gravity = false",
        )
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

    name, stage = "link_mass_error", "load"
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
                reason = f"the mass of {link} would be {rounded(nominal + error)} kg"
        return reason

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        T = arm.T_tracker_link[index(place)]
        moment = ca.vertcat(*[p[f"moment_{k}"] for k in "xyz"])
        arm.add_potential(STANDARD_GRAVITY * (p["mass_error"] * T[2, 3] + T[2, :3] @ moment))


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

    name, stage = "gravity_compensator", "load"
    rank = STIFFNESS
    formats = ("elastic",)
    remedy = RECORD_TORQUES

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        given = cell.model.nominal.gravity_compensator
        return joints(chain)[1:2] if given is None else (str(given["joint"]),)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        given = EXAMPLE | (cell.model.nominal.gravity_compensator or {})
        stiffness = float(given["stiffness_N_per_m"])
        sizes = *given["anchor_m"], given["arm_m"], given["free_length_m"]
        shape = zip(GEOMETRY, sizes, strict=True)
        return (
            ParameterSpec("compensator_stiffness", "N/m", stiffness, abs(stiffness) or None),
            *(ParameterSpec(key, "m", float(value), 1e-2) for key, value in shape),
        )

    def starts(self, place: str, chain: Chain, cell: Cell) -> tuple[dict[str, float], ...]:
        if cell.model.nominal.gravity_compensator is not None:
            return ()
        length = chain.lengths[index(place)]
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


# Joints that yield under the links' own weights, where nobody knows the weights.
#
# A mass at the origin of link k's frame stands on link k − 1, and of a first moment the part along
# a joint's axis does not turn with it.  So the potential of any masses is
#
#     V = g u · Σ_k w_k,   w_k = R_k (x_k S_kx + y_k S_ky) of a joint that turns,
#                          w_k = R_k a_k M_k q_k           of one that slides,
#
# u the vertical and x_k, y_k across the axis a_k of joint k, with all that stands further out
# counted in: M_k is the mass that joint k carries, and S_k the first moment of link k with it at
# the link's end (base inertial parameters; Gautier 1991, J. Robotic Systems 8, 485).  Joint j's
# torque −∂V/∂q_j has the terms k ≥ j alone.  With a compliance it is a deflection of the same form
# in the unknown products of compliance, mass and g; where the model has the joints' compliances
# the same weights make all joints yield, and what is unknown are the arm's moments alone.

POSES = 400  # random ones, over which sizes are taken
DEPENDENT = 1e-8  # of the largest; what is less is rounding
LEVELLED = 0.1  # share of a weight's torque that an axis feels which stands 6° off the vertical


@lru_cache(maxsize=16)
def levers(chain: Chain) -> tuple[ca.SX, list[ca.SX], list[Array]]:
    """Symbols q (joints,); −∂w_k/∂q_j of each joint j, k ≥ j, for unit moments in turn (functions,
    3), with u the torque; and these in random poses (POSES, functions, 3)."""
    q, slopes = ca.SX.sym("q", chain.n_joints), list[list[ca.SX]]()
    for k, T in enumerate(rigid.nominal_frames(chain, q, ca.SX.eye(4))[:-1]):
        turns, axis = chain.kinds[k] == "revolute", chain.joints[k].axis
        ways = transverse_axes(axis) if turns else (axis,)
        arms = (T[:3, :3] @ rigid.constant(way) * (1 if turns else q[k]) for way in ways)
        slopes.append([-ca.jacobian(arm, q) for arm in arms])
    each = [ca.vertcat(*(s[:, j].T for own in slopes[j:] for s in own)) for j in range(len(slopes))]
    return q, each, BatchFunction([q], each, ONCE)(rigid.drawn_joints(chain)[2][:POSES])


def _sizes(chain: Chain, j: int) -> dict[int, float]:
    """Number of each function that joint j moves → rms of its torque over the poses and all
    directions of the vertical.  A slide along the joint's axis is none."""
    sizes = np.sqrt((levers(chain)[2][j] ** 2).sum(axis=2).mean(axis=0) / 3)
    return {k: size for k, size in enumerate(sizes.tolist()) if size > DEPENDENT * max(sizes)}


def feels_weight(chain: Chain, j: int, up: Array) -> bool:
    """Whether weights load joint j (0-based) with the vertical `up` (3,) in the base frame: not
    where it turns about an upright axis in all poses or slides level."""
    arms = levers(chain)[2][j]
    return bool(((arms @ up) ** 2).sum() > LEVELLED**2 * (arms**2).sum() / 3)


class GravitySag(DrivenEffect):
    """δq_j = Σ_i a_i φ_i(q), φ_i the torques of unknown weights about joint j; a_i in rad.

    φ_i are −∂(u·w)/∂q_j of unit moments of the links that the joint carries, at the commanded
    joints, each divided by its rms over the joints' ranges: so a_i is how far the joint gives way
    on average.  The vertical u is z of the tracker frame, seen from the base wherever that
    stands.  It needs no masses: a_i is compliance times g times a sum of masses and first
    moments.  Setting: the prior size `sag_size_rad` of each a_i. Where compliances are known,
    `link_weights` says more with less, and so does `link_gravity` where masses are.
    """

    name, stage, at = "gravity_sag", "transmission", "turning joints"
    remedy = RECORD_TORQUES
    constants = (Setting("sag_size_rad", "range", 2e-4, 1e-12, 1.0),)
    together = True
    family = "gravity"
    sized_by = "sag_size_rad"
    entry = JointMotion()

    def shrunk_keys(self, place: str, chain: Chain) -> dict[str, str]:
        return {f"sag_{n}": "rad" for n, _ in enumerate(_sizes(chain, index(place)), 1)}

    def acts(self, place: str, chain: Chain, cell: Cell) -> bool:
        turned = cell.model.nominal.base_rotation
        return feels_weight(chain, index(place), (np.eye(3) if turned is None else turned)[2])

    def may_be_missing(self, cell: Cell) -> bool:
        return not any(e.name == JointCompliance.name for e in cell.model.effects)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        up, j = arm.T_tracker_base[2, :3].T, index(place)
        q, each, _ = levers(arm.chain)
        torques = ca.substitute(each[j], q, arm.q_commanded) @ up
        terms = enumerate(_sizes(arm.chain, j).items(), 1)
        return sum((p[f"sag_{n}"] * torques[k] / size for n, (k, size) in terms), ca.SX(0))


# Kilograms of an arm of one metre: arms of 0.6 to 1.4 m weigh 15 to 40 kg per square metre of their
# reach, and heavy ones twice as much.
WEIGHT = 30.0  # kg/m²
HOUSING = 0.1  # m, that even the last link stands out


def further(chain: Chain) -> Array:
    """Stretched length (joints,) in m of what follows each link's end, a housing at least."""
    lengths = np.array(chain.lengths)
    return np.cumsum(lengths[::-1])[::-1] - lengths + HOUSING


class LinkWeights(Effect):
    """V = g u · [Σ R_k (x_k S_kx + y_k S_ky) + Σ R_k a_k M_k q_k]: weights of all links at once.

    S_kx, S_ky (kg m) is the first moment of link k across its joint's axis, with the mass of all
    that follows at the link's end; of a sliding joint M_k (kg) is the mass that it carries.  These
    make up the torques of any masses about all joints, which then yield by their compliances: so
    it shows where the cell has `joint_compliance` or other springs, and `gravity_sag` is what can
    be had elsewhere.  With `link_gravity` they are what is missing from the masses stated.  Each is
    as large as where everything weighs `weights_kg_per_m` (setting, the prior size): along the way
    to the link's end, half of the link and all that follows; across it, the link a housing away.
    """

    name, stage, at = "link_weights", "load", "arm"
    together = True
    family = "gravity"
    sized_by = "weights_kg_per_m"

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        density = WEIGHT * float(chain.lengths[0] + further(chain)[0])
        return (Setting(self.sized_by, "range", density, 1e-9, 1e9),)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        density = self.stated(place, chain, cell)[self.sized_by]
        found: list[ParameterSpec] = []
        each = zip(chain.link_ends, chain.lengths, further(chain).tolist(), strict=True)
        for link, joint, (T, own, beyond) in zip(links(chain), chain.joints, each, strict=True):
            across = np.array(transverse_axes(joint.axis))
            mass = density * (own + HOUSING)
            if joint.kind == "revolute":
                for key, way in zip("xy", np.abs(across @ T[:3, 3]).tolist(), strict=True):
                    along, across_it = density * way * (own / 2 + beyond), mass * HOUSING
                    name, size = f"{link}_moment_{key}", along + across_it
                    alike = "along" if along > across_it else "across"
                    found.append(ParameterSpec(name, "kg*m", 0.0, size, shrunk=True, alike=alike))
            else:
                size = density * (own + beyond)
                found.append(ParameterSpec(f"{link}_mass", "kg", 0.0, size, shrunk=True))
        return tuple(found)

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        moment = ca.SX(0)
        for i, (link, joint) in enumerate(zip(links(arm.chain), arm.chain.joints, strict=True)):
            up = arm.T_tracker_link[i][2, :3]
            if joint.kind == "revolute":
                for key, axis in zip("xy", transverse_axes(joint.axis), strict=True):
                    moment += p[f"{link}_moment_{key}"] * (up @ rigid.constant(axis))
            else:
                moment += p[f"{link}_mass"] * (up @ rigid.constant(joint.axis)) * arm.joint_angle(i)
        arm.add_potential(STANDARD_GRAVITY * moment)


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
    arm.add_spring(Spring(name, f"joint{i + 1}", joint.kind, tuple(map(float, joint.axis)), law))


def nominal_compliance(chain: Chain, cell: Cell) -> tuple[float, ...] | None:
    given = cell.model.nominal.joint_compliance
    require(
        given is None or len(given) == chain.n_joints,
        f"[model.nominal] joint_compliance has {len(given or ())} values, "
        f"but the arm has {chain.n_joints} joints; give one per joint",
    )
    return given


def _of_levels(levels: Sequence[float]) -> list[str]:
    return [f"compliance_level{n}" for n in range(1, len(levels) + 1)]


class JointCompliance(TorqueEffect):
    """δq_j = k_j τ_j, k_j in rad/(N m) (m/N for a prismatic joint).

    τ_j is the load's torque about the joint axis, either computed at the deflected pose from
    the load, link weights and compensator, or taken from the table (`torque = "measured"`:
    the torque that the load exerts on the joint, positive along +q).

    Where the cell splits a joint by levels (`[model.compliance_levels]`), the compliance is
    one independent value k_ji per level, as in Klimchik et al. 2013, section 5.
    """

    name, stage, at = "joint_compliance", "compliance", "joints"
    elastic = True
    sized_by_value = True
    rank = STIFFNESS
    formats = ("elastic",)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        i = index(place)
        unit = "rad/(N*m)" if chain.kinds[i] == "revolute" else "m/N"
        given = nominal_compliance(chain, cell)
        nominal = 0.0 if given is None else float(given[i])
        typical = abs(nominal) or None
        levels = cell.model.compliance_levels.get(place)
        keys = _of_levels(levels) if levels else ["compliance"]
        return tuple(ParameterSpec(key, unit, nominal, typical, lower=0.0) for key in keys)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        levels = arm.cell.model.compliance_levels.get(place)
        if levels:
            chosen = arm.input(f"level:{place}", len(levels))
            k = ca.dot(chosen, ca.vertcat(*[p[key] for key in _of_levels(levels)]))
        else:
            k = p["compliance"]
        add_deflection(arm, index(place), place, lambda tau: k * tau)


RATED_WIND_UP = 3e-3  # rad; what a drive yields by at its largest torque, small or large
WRIST_SHARE = 1 / 8  # of the strongest joint's torque, in common six- and seven-axis arms
UNRATED = 1e3  # N m, where nothing tells


def weight_torque(chain: Chain, i: int) -> float:
    """Bound in N m on the torque of the links' weights about revolute joint i (0-based), whatever
    the pose and the mounting: τ ≤ g Σ_j m_j r_j over the bodies j that the joint carries, r_j the
    length of the chain from the joint's axis to the body's centre of mass.  0 where masses are
    unknown."""
    axis = chain.joints[i].axis
    ends = [T[:3, 3] for T in chain.link_ends]
    moment, reach = 0.0, 0.0
    for j, body in enumerate(chain.masses[i:], start=i):
        # Only the joint's own link keeps its direction to the axis in every pose.
        along = np.outer(axis, axis) if j == i else np.zeros((3, 3))
        to_com, to_end = (float(np.linalg.norm(p - along @ p)) for p in (body.com, ends[j]))
        moment += body.mass * (reach + to_com)
        reach += to_end
    return STANDARD_GRAVITY * moment


def rated_torque(chain: Chain, cell: Cell, i: int) -> float | None:
    """Size in N m of the largest torque on revolute joint i (0-based); None where nothing tells.
    The largest of the weights' torque on it, an eighth of that on the strongest joint, and the
    torque that winds the joint up by 3 mrad with its nominal compliance: payloads, which the cell
    does not state, load a wrist far more than its own weight does."""
    given = nominal_compliance(chain, cell)
    wound = RATED_WIND_UP / given[i] if given and given[i] > 0 else 0.0
    turning = [j for j, kind in enumerate(chain.kinds) if kind == "revolute"]
    strongest = max(weight_torque(chain, j) for j in turning)
    return max(weight_torque(chain, i), WRIST_SHARE * strongest, wound) or None


# kg/m³, mass of the links over the cube of the arm's length: 9 (UR5, Panda), 33 (KR 270), 40
# (KR 120).  Files of robots often state 1 or 2 kg for every link, which no arm of that size has.
USUAL_MASS, OF_ANY_ARM = 30.0, 10.0


def usual_over_stated_mass(chain: Chain) -> float:
    """What the masses are to be multiplied by; 1 where an arm of this length may have them, and of
    gantries, whose travel is no length of theirs."""
    mass = sum(body.mass for body in chain.masses)
    usual = USUAL_MASS * sum(chain.lengths) ** 3
    alike = usual <= OF_ANY_ARM * mass and mass <= OF_ANY_ARM * usual
    gantry = chain.kinds.count("prismatic") > 1
    return 1.0 if alike or mass == 0 or gantry else usual / mass


OF_RATED = 10.0  # times the rated torque: no planned load winds a joint up by more


def largest_load(cell: Cell) -> float:
    loads = np.zeros((1, 3)) if cell.design.loads is None else np.asarray(cell.design.loads)
    return float(np.linalg.norm(loads, axis=1).max())


def usual_compliance(chain: Chain, cell: Cell, i: int) -> float:
    """rad/(N m) that wind revolute joint i (0-based) up by RATED_WIND_UP at its rated torque by the
    links' weights, else that of the largest load planned."""
    rated = usual_over_stated_mass(chain) * (rated_torque(chain, cell, i) or 0.0)
    lever = sum(chain.lengths[i:]) + float(np.linalg.norm(cell.tool.load_point))
    planned = largest_load(cell) * lever
    return RATED_WIND_UP / max(rated or planned or UNRATED, planned / OF_RATED)


def torque_scale(chain: Chain, cell: Cell, i: int) -> float:
    """τ_s in N m, a thousandth of the rated torque: torques below it are so small that friction and
    play blur their sign.  A true dead zone turns over at once, and a wrist seldom sees more than a
    few per cent of its rating."""
    return 1e-3 * (rated_torque(chain, cell, i) or UNRATED)


class JointHardening(TorqueEffect):
    """δq = k₃ τ³ besides the linear k τ; k₃ in rad/(N m)³, negative where the joint stiffens.

    Teeth and bearings carry more of their surface the harder they are pressed (Hertz: the
    contact's deflection grows with a power below one of the load), so that strain-wave and
    cycloidal gears stiffen with torque; the cubic is the first odd term after the linear one.
    Typical: 20 % of the linear deflection at the rated torque.
    """

    name, stage, at = "joint_hardening", "compliance", "turning joints"

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        given = nominal_compliance(chain, cell)
        rated = rated_torque(chain, cell, index(place))
        typical = 0.2 * given[index(place)] / rated**2 if given and rated else None
        return (ParameterSpec("hardening", "rad/(N*m)^3", 0.0, typical or None),)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        add_deflection(arm, index(place), f"{place}.hardening", lambda tau: p["hardening"] * tau**3)


class TiltingEffect(LoadedEffect):
    """θ = k M about axes of a place, M the load's moments there; k in rad/(N m).

    Typical: a `share` of the compliance of the joint that is, moves or stands at the place.
    """

    stage = "compliance"
    elastic = True
    formats = ("elastic",)
    prefix: ClassVar[str] = ""  # of the parameters' keys, before the name of the axis
    share: ClassVar[float]

    def axes(self, place: str, chain: Chain) -> dict[str, Array]:
        """Name → unit axis (3,) in the frame of the place."""
        raise NotImplementedError

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        given, i = nominal_compliance(chain, cell), 0 if place == "base" else index(place)
        known = given is not None and chain.kinds[i] == "revolute"
        typical = self.share * given[i] or None if given and known else None
        return tuple(
            ParameterSpec(self.prefix + key, "rad/(N*m)", 0.0, typical, lower=0.0)
            for key in sorted(self.axes(place, chain))
        )

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        for key, axis in self.axes(place, arm.chain).items():
            k = p[self.prefix + key]
            arm.add_spring(Spring.linear(f"{place}.{key}", place, "revolute", axis, k))


class OffAxisCompliance(TiltingEffect):
    """Tilt of the joint about its two transverse axes, θ_x = k_x M_x and θ_y = k_y M_y.

    M_x, M_y are the transverse moments of the load at the joint; the axes are fixed to the
    proximal link (the bearing's housing).  Typical: 5 to 20 % of the drive's compliance.
    """

    name, at = "off_axis_compliance", "joints"
    sized_by_value = True
    rank = STIFFNESS
    prefix = "off_axis_compliance_"
    share = 0.2

    def axes(self, place: str, chain: Chain) -> dict[str, Array]:
        return dict(zip("xy", transverse_axes(chain.joints[index(place)].axis), strict=True))


class LinkBending(TiltingEffect):
    """θ = k M at the link's distal end: bending about two transverse axes, torsion about its own.

    M are the load's moments there, about axes fixed to the link; k in rad/(N m).  For a uniform
    beam of length L, k = L/(E I) in bending and L/(G J) in torsion (the rotation of its end under
    an end moment; Timoshenko); the deflection by a transverse force at the end itself is of
    higher order in L over the lever arm and left out.  Typical: 15 % of the compliance of the
    joint that moves the link.
    """

    name, at = "link_bending", "links"
    share = 0.15

    def axes(self, place: str, chain: Chain) -> dict[str, Array]:
        """In the frame at the distal end; torsion about the line there from the joint's frame, or
        about the joint's axis where the link has no length."""
        i = index(place)
        T, length = chain.link_ends[i], chain.lengths[i]
        along = T[:3, :3].T @ (T[:3, 3] / length if length > SHORTEST else chain.joints[i].axis)
        y, z = transverse_axes(along)
        return {"torsion": along, "bending_y": y, "bending_z": z}


class BaseCompliance(TiltingEffect):
    """Tilt of the base about its x and y axes, θ = k M, M the load's moment at the base origin.

    Pedestals, anchor bolts and floors give way under the overturning moment; k in rad/(N m).
    Typical: 10 % of the compliance of joint 1.
    """

    name, at = "base_compliance", "base"
    sized_by_value = True
    rank = STIFFNESS
    prefix = "tilt_compliance_"
    share = 0.1

    def axes(self, place: str, chain: Chain) -> dict[str, Array]:
        return {"x": np.eye(3)[0], "y": np.eye(3)[1]}


class TorqueDriven(DrivenEffect):
    """u = Σ_i k_i τ_i a_i with the recorded torques τ_i of some joints, along given a_i."""

    together = True
    family = "torque"
    needs = ("torque",)
    prefix: ClassVar[str]  # of the parameters' keys

    def ways(self, place: str, chain: Chain) -> dict[str, tuple[int, Array]]:
        """What ends a parameter's key → index of the joint and direction a (entry.size,)."""
        raise NotImplementedError

    def shrunk_keys(self, place: str, chain: Chain) -> dict[str, str]:
        unit = motion_unit(place, chain) if place.startswith("joint") else "rad"
        return {f"{self.prefix}_{key}": f"{unit}/(N*m)" for key in self.ways(place, chain)}

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        torque, u = arm.input("torque", arm.chain.n_joints), ca.SX.zeros(self.entry.size)
        for key, (joint, way) in self.ways(place, arm.chain).items():
            u += p[f"{self.prefix}_{key}"] * torque[joint] * rigid.constant(way)
        return u


class TorqueCoupling(TorqueDriven):
    """δq_j = Σ_{i≠j} k_i τ_i with the recorded torques τ_i of the other joints; k_i in rad/(N m).

    Housings and bearings that two drives share, wrists with concentric shafts.  Setting: the
    prior size `coupling_rad_per_Nm` of each k_i.
    """

    name, stage, at = "torque_coupling", "transmission", "joints"
    constants = (Setting("coupling_rad_per_Nm", "range", 3e-7, 1e-15, 1.0),)
    sized_by = "coupling_rad_per_Nm"
    prefix = "coupling"
    entry = JointMotion()

    def ways(self, place: str, chain: Chain) -> dict[str, tuple[int, Array]]:
        return {i: (index(i), np.ones(1)) for i in turning_joints(chain) if i != place}


class TorqueTilt(TorqueDriven):
    """The link's end turns by k τ about axes across the joints at its ends; k in rad/(N m).

    τ is the recorded torque of the link's own joint (`own`) and of the next one (`next`), the
    axes are the two across that joint's, fixed to the link.  A drive's torque bends its bearing and
    housing, and the link behind it.  Setting: the prior size `tilt_rad_per_Nm` of each k.
    """

    name, stage = "torque_tilt", "geometry"
    constants = (Setting("tilt_rad_per_Nm", "range", 3e-7, 1e-15, 1.0),)
    sized_by = "tilt_rad_per_Nm"
    prefix = "tilt"
    entry = LinkFrame()

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return tuple(link for link in links(chain) if self.ways(link, chain))

    def ways(self, place: str, chain: Chain) -> dict[str, tuple[int, Array]]:
        """Turns about the axes across revolute joints, in the frame at the link's distal end."""
        found: dict[str, tuple[int, Array]] = {}
        i = index(place)
        ends = {"own": (i, chain.link_ends[i][:3, :3].T), "next": (i + 1, np.eye(3))}
        for end, (joint, R) in ends.items():
            if joint < chain.n_joints and chain.kinds[joint] == "revolute":
                for key, axis in zip("xy", transverse_axes(chain.joints[joint].axis), strict=True):
                    found[f"{end}_{key}"] = joint, np.append(np.zeros(3), R @ axis)
        return found
