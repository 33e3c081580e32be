"""Can a nominal chain be meant as its file states it?  One rule for URDF, MJCF and DH tables.

Lengths off by 1000 (mm and m) or angles off by 57.3 (degrees and rad) make another arm, whose
simulation and fit look as good as the right one's.  What no arm can be is refused; what hardly any
is becomes a note of the chain, which `init` and `identify` show.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np

from elastocal.errors import InputError, require
from elastocal.model.chain import MAX_LENGTH, MAX_MASS, MIN_JOINTS, Chain, Joint, LinkMass
from elastocal.text import listed
from elastocal.units import Array

# A thousandth of the longest: an arm of at most MAX_LENGTH in m, read as mm, is shorter.
MIN_LENGTH = MAX_LENGTH / 1000
# Two turns: beyond them an angle of the geometry, four a limit, is in another unit.  Limits of many
# whole turns and powers of ten occur: the latter stand for no limit.
MAX_ANGLE, MAX_LIMIT = 4 * math.pi, 8 * math.pi
MOST_DEGREES = 720.0  # no limit in degrees is larger, so a larger one in rad stands for none
# Two turns in rad, read as degrees: no range of an arm's joints is as narrow.
NARROWEST, SHORTEST = math.radians(MAX_ANGLE), 1e-3  # rad, m
# What names of fingers and of their joints have in them, and how far a jaw slides at most, in m.
FINGERS = re.compile("finger|gripper|jaw|knuckle|thumb|claw|hand", re.IGNORECASE)
LONGEST_JAW = 0.15
# Between neighbouring axes: calibrated parallel ones are below 0.5°, and pi/4 … 2 pi rad, read as
# degrees, lie between these.
TILT = math.radians(0.75), math.radians(2 * math.pi + 0.01)


def plausible(chain: Chain, source: object) -> Chain:
    """The chain of the file `source`, with limits that stand for none taken out and notes of what
    is doubtful.  Raises InputError where it is longer, shorter or heavier than any arm, or has
    limits that only another unit explains."""
    _check_lengths(chain, source)
    _check_masses(chain, source)
    joints = tuple(_limited(joint, f"{source}: joint '{joint.name}'") for joint in chain.joints)
    chain = replace(chain, joints=joints)
    return replace(chain, notes=(*chain.notes, *_doubts(chain)))


def check_angles(where: str, angles: tuple[float, ...], meant: str) -> None:
    """Raise InputError where an angle in rad is beyond two turns; `meant`: the file's unit."""
    worst = max(map(abs, angles), default=0.0)
    require(
        worst <= MAX_ANGLE,
        f"{where}: {worst:g} rad is more than two turns; {meant}: convert degrees",
    )


def jaw_told(chain: Chain, moved: str = "") -> list[str]:
    """A sentence where the last joint, or the link `moved` by it, looks like a gripper's jaw, which
    is no part of the arm."""
    last = chain.joints[-1]
    slides = last.kind == "prismatic" and last.upper - last.lower < LONGEST_JAW
    if chain.n_joints <= MIN_JOINTS or not (slides or FINGERS.search(f"{last.name} {moved}")):
        return []
    return [
        f"the last joint '{last.name}' looks like a jaw of a gripper; if it is, name what carries "
        "it as flange"
    ]


def extent(chain: Chain) -> float:
    """Length in m from joint to joint and on to the flange."""
    ends = [*(joint.placement for joint in chain.joints[1:]), chain.flange_placement]
    return float(sum(np.linalg.norm(T[:3, 3]) for T in ends))


def near_the_arm(chain: Chain) -> Chain:
    """The same motion with every joint's frame slid along its axis to the foot of the perpendicular
    from the frame before it.

    With s_i the shift along axis i, X_i ← s_{i−1}⁻¹ X_i s_i, which the motions about and along the
    axes commute with.
    """
    joints: list[Joint] = []
    masses: list[LinkMass] = []
    slid: Array = np.zeros(3)  # of the joint before, in its frame
    for i, joint in enumerate(chain.joints):
        T = joint.placement.copy()
        T[:3, 3] -= slid
        along = T[:3, :3] @ joint.axis
        height = -float(along @ T[:3, 3])
        T[:3, 3] += height * along
        slid = height * joint.axis
        joints.append(replace(joint, placement=T))
        if chain.masses:
            masses.append(replace(chain.masses[i], com=chain.masses[i].com - slid))
    flange = chain.flange_placement.copy()
    flange[:3, 3] -= slid
    return replace(
        chain, joints=tuple(joints), flange_placement=flange, masses=tuple(masses)
    )  # fmt: skip


def _check_lengths(chain: Chain, source: object) -> None:
    places = [*(f"joint {i}" for i in range(1, chain.n_joints + 1)), "the flange"]
    ends = [*(joint.placement for joint in chain.joints), chain.flange_placement]
    for place, T in zip(places, ends, strict=True):
        length = float(np.linalg.norm(T[:3, 3]))
        require(
            length <= MAX_LENGTH,
            f"{source}: {length:g} m before {place} is too long for a link; correct it",
        )
    whole = extent(chain)
    require(
        whole <= MAX_LENGTH,
        f"{source}: the links are {whole:g} m long together, which no arm is; if its lengths are "
        "millimetres, state them in m (DH table: d_mm, a_mm)",
    )
    require(
        whole >= MIN_LENGTH,
        f"{source}: the links are {whole * 1e3:.3g} mm long together, which no arm is; if its "
        "lengths are metres, state them so (DH table: d_m, a_m)",
    )


def _check_masses(chain: Chain, source: object) -> None:
    for i, body in enumerate(chain.masses, start=1):
        require(
            body.mass <= MAX_MASS,
            f"{source}: {body.mass:g} kg is too heavy for link {i}; correct it",
        )
        offset = float(np.linalg.norm(body.com))
        require(
            offset <= MAX_LENGTH,
            f"{source}: {offset:g} m to the centre of mass is too far for link {i}; correct it",
        )


def _limited(joint: Joint, where: str) -> Joint:
    """The joint without limits that stand for none; InputError for those in another unit."""
    turns = joint.kind == "revolute"
    most, none = (MAX_LIMIT, MOST_DEGREES) if turns else (MAX_LENGTH, MAX_LENGTH * 1000)
    ends = [joint.lower, joint.upper]
    far = [abs(v) for v in ends if math.isfinite(v) and abs(v) > most]
    if far and all(v > none or 10.0 ** round(math.log10(v)) == v for v in far):
        low, high = (math.copysign(math.inf, v) if abs(v) > most else v for v in ends)
        return replace(joint, lower=low, upper=high)
    if not far or (turns and all(abs(v / math.pi - round(v / math.pi)) < 1e-3 for v in far)):
        return joint
    unit, told, wrong = (
        ("rad", f"more than {max(far) / 2 / math.pi:.0f} turns", "degrees, convert them to rad")
        if turns
        else ("m", "longer than any axis", "millimetres, convert them to m")
    )
    raise InputError(
        f"{where}: limits {joint.lower:g}, {joint.upper:g} {unit} are {told}; if these are "
        f"{wrong}; if there is no limit, state none"
    )


def _doubts(chain: Chain) -> list[str]:
    """What hardly any arm has, as sentences that name the likely cause."""
    found = []
    axes = [joint.placement[:3, :3] @ joint.axis for joint in chain.joints]
    before = [joint.axis for joint in chain.joints]
    apart = [math.acos(min(abs(float(a @ b)), 1.0)) for a, b in zip(before, axes[1:], strict=False)]
    if TILT[0] < (largest := max(apart, default=0.0)) < TILT[1]:
        found.append(
            f"neighbouring axes are at most {math.degrees(largest):.4f} degrees apart, as where an "
            "angle of pi/4, pi/2 or pi rad is read as degrees; if the file's angles are radians, "
            "state that (DH table: theta0_rad, alpha_rad; MJCF: compiler angle)"
        )
    for kind, least, told in (
        ("revolute", NARROWEST, "{:.3g} degrees, as where limits in rad are read as degrees"),
        ("prismatic", SHORTEST, "{:.3g} mm, as where limits in m are read as mm"),
    ):
        spans = [j.upper - j.lower for j in chain.joints if j.kind == kind]
        if spans and max(spans) < least:
            widest = math.degrees(max(spans)) if kind == "revolute" else max(spans) * 1e3
            names = listed((j.name for j in chain.joints if j.kind == kind), 4)
            found.append(
                f"the widest range of {names} is {told.format(widest)}; check the unit of limits"
            )
    return found
