"""What yields under load: joints, bearings, links and base, and how large torques get."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

import casadi as ca
import numpy as np

from elastocal.cell import Cell
from elastocal.messages import require
from elastocal.model import rigid
from elastocal.model.arm import Arm, ParameterSpec, Setting, Spring
from elastocal.model.chain import Chain, extent
from elastocal.model.effects.base import (
    STIFFNESS,
    DrivenEffect,
    Effect,
    JointMotion,
    LinkFrame,
    Symbols,
    index,
    links,
    motion_unit,
    turning_joints,
)
from elastocal.model.effects.loads import STANDARD_GRAVITY
from elastocal.model.effects.placements import SHORTEST, transverse_axes
from elastocal.units import Array


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
    x, y, z = (float(a) for a in joint.axis)
    arm.add_spring(Spring(name, f"joint{i + 1}", joint.kind, (x, y, z), law))


def nominal_compliance(chain: Chain, cell: Cell) -> tuple[float, ...] | None:
    """The cell's nominal compliances, one per joint; InputError where their number is another."""
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

    name = "joint_compliance"
    stage = "compliance"
    at = "joints"
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
    """Bound in N m on the torque of the links' weights about revolute joint i (0-based).

    τ ≤ g Σ_j m_j r_j over the bodies j that the joint carries, r_j the length of the chain from
    the joint's axis to the body's centre of mass; whatever the pose and the mounting.  0 where
    masses are unknown.
    """
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
    does not state, load a wrist far more than its own weight does.
    """
    given = nominal_compliance(chain, cell)
    wound = RATED_WIND_UP / given[i] if given and given[i] > 0 else 0.0
    turning = [j for j, kind in enumerate(chain.kinds) if kind == "revolute"]
    strongest = max(weight_torque(chain, j) for j in turning)
    return max(weight_torque(chain, i), WRIST_SHARE * strongest, wound) or None


# kg/m³, mass of the links over the cube of the arm's length: 9 (UR5, Panda), 33 (KR 270), 40
# (KR 120).  Files of robots often state 1 or 2 kg for every link, which no arm of that size has.
USUAL_MASS, OF_ANY_ARM = 30.0, 10.0


def usual_over_stated_mass(chain: Chain) -> float:
    """What the masses are to be multiplied by; 1 where an arm of this length may have them."""
    mass = sum(body.mass for body in chain.masses)
    usual = USUAL_MASS * extent(chain) ** 3
    alike = usual <= OF_ANY_ARM * mass and mass <= OF_ANY_ARM * usual
    return 1.0 if alike or mass == 0 else usual / mass


def torque_scale(chain: Chain, cell: Cell, i: int) -> float:
    """τ_s in N m: torques below it are so small that friction and play blur their sign.

    A thousandth of the rated torque: a true dead zone turns over at once, and a wrist seldom sees
    more than a few per cent of its rating.
    """
    return 1e-3 * (rated_torque(chain, cell, i) or UNRATED)


class JointHardening(TorqueEffect):
    """δq = k₃ τ³ besides the linear k τ; k₃ in rad/(N m)³, negative where the joint stiffens.

    Teeth and bearings carry more of their surface the harder they are pressed (Hertz: the
    contact's deflection grows with a power below one of the load), so that strain-wave and
    cycloidal gears stiffen with torque; the cubic is the first odd term after the linear one.
    Typical: 20 % of the linear deflection at the rated torque.
    """

    name = "joint_hardening"
    stage = "compliance"
    at = "turning joints"

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        given = nominal_compliance(chain, cell)
        rated = rated_torque(chain, cell, index(place))
        typical = 0.2 * given[index(place)] / rated**2 if given and rated else None
        return (ParameterSpec("hardening", "rad/(N*m)^3", 0.0, typical or None),)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        k3 = p["hardening"]
        add_deflection(arm, index(place), f"{place}.hardening", lambda tau: k3 * tau**3)


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

    name = "off_axis_compliance"
    at = "joints"
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

    name = "link_bending"
    at = "links"
    share = 0.15

    def axes(self, place: str, chain: Chain) -> dict[str, Array]:
        """In the frame at the distal end; torsion about the line there from the joint's frame, or
        about the joint's axis where the link has no length."""
        T = chain.link_ends[index(place)]
        length = np.linalg.norm(T[:3, 3])
        along = T[:3, 3] / length if length > SHORTEST else chain.joints[index(place)].axis
        along = T[:3, :3].T @ along
        y, z = transverse_axes(along)
        return {"torsion": along, "bending_y": y, "bending_z": z}


class BaseCompliance(TiltingEffect):
    """Tilt of the base about its x and y axes, θ = k M, M the load's moment at the base origin.

    Pedestals, anchor bolts and floors give way under the overturning moment; k in rad/(N m).
    Typical: 10 % of the compliance of joint 1.
    """

    name = "base_compliance"
    at = "base"
    sized_by_value = True
    rank = STIFFNESS
    prefix = "tilt_compliance_"
    share = 0.1

    def axes(self, place: str, chain: Chain) -> dict[str, Array]:
        return {"x": np.eye(3)[0], "y": np.eye(3)[1]}


# Couplings of joints by the torques that drive them.


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

    name = "torque_coupling"
    stage = "transmission"
    at = "joints"
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

    name = "torque_tilt"
    stage = "geometry"
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
