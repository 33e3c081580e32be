"""The nominal serial chain: its joints and their names and limits, and whether it can be one."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sized
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np

from elastocal.cell import Cell
from elastocal.messages import InputError, check_known, listed, printable, require, rounded, wish
from elastocal.units import Array, BoolArray, IntArray

JointKind = Literal["revolute", "prismatic"]

MIN_JOINTS, MAX_JOINTS = 4, 9
MAX_LENGTH, MAX_MASS = 50.0, 1e5  # m, kg: beyond them a unit is wrong, no arm is so long or heavy


@dataclass(frozen=True)
class Joint:
    """One moving joint of the chain.  `placement` (4, 4) takes coordinates of this joint's frame at
    zero motion to the previous joint's frame (to the base frame for the first joint); `axis` (3,)
    is the unit joint axis in this joint's frame.  `lower` and `upper` are in rad (revolute) or m
    (prismatic), infinite where the source has no limit."""

    name: str
    kind: JointKind
    placement: Array
    axis: Array
    lower: float = -np.inf
    upper: float = np.inf


@dataclass(frozen=True)
class LinkMass:
    """Mass in kg and centre of mass (3,) in m in the frame of the moving joint that carries it."""

    mass: float
    com: Array


@dataclass(frozen=True, eq=False)
class Chain:
    """A serial chain base → joint 1 → … → joint n → flange.  `flange_placement` (4, 4) places the
    flange in the last joint's frame. `masses` holds one entry per joint, all bodies rigidly carried
    by that joint lumped, or is empty where the source has no inertias.  `notes`: what to know of
    how the source was read, in sentences."""

    name: str
    joints: tuple[Joint, ...]
    flange_placement: Array
    masses: tuple[LinkMass, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def n_joints(self) -> int:
        return len(self.joints)

    @property
    def link_ends(self) -> list[Array]:
        """Per link the placement (4, 4) of its distal frame in its joint's frame at zero motion."""
        return [*(joint.placement for joint in self.joints[1:]), self.flange_placement]

    @property
    def lengths(self) -> list[float]:
        """Per link from its joint's frame to its distal one, in m."""
        return [float(np.linalg.norm(T[:3, 3])) for T in self.link_ends]

    @property
    def kinds(self) -> tuple[JointKind, ...]:
        return tuple(joint.kind for joint in self.joints)

    @property
    def turning(self) -> BoolArray:
        """Which joints (n,) are revolute."""
        return np.array([kind == "revolute" for kind in self.kinds], dtype=bool)


# Joint limits: the robot's own, narrowed by the cell's.

NO_LIMIT = 100.0  # half turns, or m


def joint_limits(cell: Cell, chain: Chain) -> tuple[Array, Array]:
    """Lower and upper joint limits (n,) in rad or m, infinite where there is none."""
    lower = np.array([joint.lower for joint in chain.joints])
    upper = np.array([joint.upper for joint in chain.joints])
    for name, (low, high) in cell.limits.items():
        i = joint_index(name)
        lower[i], upper[i] = max(lower[i], low), min(upper[i], high)
        told = f"[limits] {name} leaves no range inside the robot's own limits"
        require(lower[i] < upper[i], f"{cell.source}: {told}")
    return lower, upper


def finite_ranges(
    chain: Chain, lower: Array, upper: Array, near: Array | None = None
) -> tuple[Array, Array]:
    """Ranges (n,) to draw joint values from: the limits, and where there are none, a turn (2 m
    for a prismatic joint) from the one limit, or about `near` (n,), by default about zero.  A
    limit beyond `NO_LIMIT` such half turns (1 m) from there is none: files write 1e16 for it."""
    half = np.where(chain.turning, np.pi, 1.0)
    centre = np.zeros(len(lower)) if near is None else near
    lower = np.where(lower < centre - NO_LIMIT * half, -np.inf, lower)
    upper = np.where(upper > centre + NO_LIMIT * half, np.inf, upper)
    low = np.where(np.isfinite(upper), upper - 2 * half, centre - half)
    low = np.where(np.isfinite(lower), lower, low)
    return low, np.where(np.isfinite(upper), upper, low + 2 * half)


def told(chain: Chain, j: int, value: float, digits: int = 6) -> str:
    turns = chain.kinds[j] == "revolute"
    return f"{rounded(np.degrees(value), digits)}°" if turns else f"{rounded(value, digits)} m"


LIMIT_SLACK = 1e-6  # rad or m: what rounding to printed digits may push over a limit


def beyond_limits(
    cell: Cell, chain: Chain, q: Array, slack: float = LIMIT_SLACK, digits: int = 6
) -> tuple[IntArray, int, str] | None:
    """The postures q (n, joints) that lie beyond the limits, and of the first one the joint
    (0-based) and a sentence on it."""
    lower, upper = joint_limits(cell, chain)
    beyond = (q < lower - slack) | (q > upper + slack)
    if not beyond.any():
        return None
    i, j = (int(v) for v in np.argwhere(beyond)[0])
    at, low, high = (told(chain, j, v, digits) for v in (q[i, j], lower[j], upper[j]))
    name = f"joint{j + 1} ({chain.joints[j].name})"
    rows = np.flatnonzero(beyond.any(axis=1))
    return rows, j, f"{name} at {at} is beyond its limits, {low} to {high}"


def check_posture(cell: Cell, chain: Chain, key: str, q: Array, degrees: bool) -> None:
    check_numbers(chain, key, q, degrees)
    if (beyond := beyond_limits(cell, chain, q[None])) is not None:
        raise InputError(f"{key}: {beyond[2]}; correct the posture or the limits")


def check_numbers(chain: Chain, key: str, found: Sized, degrees: bool, one: bool = False) -> None:
    n, own = chain.n_joints, key.rpartition(": key ")[2]
    require(
        len(found) == n or (one and len(found) == 1),
        f"{key} has {len(found)} numbers, but robot '{chain.name}' has {n} joints; "
        f"give {n} numbers{' or one for all' if one else ''}",
    )
    for k, kind in enumerate(chain.kinds if degrees else ()):
        require(
            kind != "prismatic",
            f"{key} gives degrees, but joint{k + 1} ({chain.joints[k].name}) is prismatic; use "
            f"{own.replace('deg_per_s', 'si').replace('_deg', '_si')}, in rad and m",
        )


def joint_index(name: str) -> int:
    """0-based index of "joint3", as of "link3"."""
    return int(name.lstrip("abcdefghijklmnopqrstuvwxyz")) - 1


# Can a nominal chain be meant as its file states it?  One rule for URDF, MJCF and DH tables.
# Lengths off by 1000 (mm and m) or angles off by 57.3 (degrees and rad) make another arm, whose
# simulation and fit look as good as the right one's.  What no arm can be is refused; what hardly
# any is becomes a note of the chain, which `init` and `identify` show.

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
    is doubtful."""
    places = [*(f"joint {i}" for i in range(1, chain.n_joints + 1)), "the flange"]
    ends = [*(joint.placement for joint in chain.joints), chain.flange_placement]
    for place, T in zip(places, ends, strict=True):
        length = float(np.linalg.norm(T[:3, 3]))
        told = f"{source}: {length:g} m before {place} is too long for a link; correct it"
        require(length <= MAX_LENGTH, f"{told}, or if lengths are in mm, state them in m")
    whole = sum(chain.lengths)
    for good, size, meant in (
        (whole <= MAX_LENGTH, f"{whole:g} m",
         "millimetres, state them in m (DH table: d_mm, a_mm)"),
        (whole >= MIN_LENGTH, f"{rounded(whole * 1e3)} mm",
         "metres, state them so (DH table: d_m, a_m)"),
    ):  # fmt: skip
        told = f"the links are {size} long together, which no arm is; if its lengths are {meant}"
        require(good, f"{source}: {told}")
    for i, body in enumerate(chain.masses, start=1):
        for found, most, told in (
            (body.mass, MAX_MASS, "kg is too heavy"),
            (float(np.linalg.norm(body.com)), MAX_LENGTH, "m to the centre of mass is too far"),
        ):
            require(found <= most, f"{source}: {found:g} {told} for link {i}; correct it")
    joints = tuple(_limited(joint, f"{source}: joint '{joint.name}'") for joint in chain.joints)
    chain = replace(chain, joints=joints)
    return replace(chain, notes=(*chain.notes, *_doubts(chain)))


def check_angles(where: str, angles: tuple[float, ...], meant: str) -> None:
    """Raise InputError where an angle in rad is beyond two turns; `meant`: the file's unit."""
    worst = max(map(abs, angles), default=0.0)
    told = f"{where}: {worst:g} rad is more than two turns; {meant}: convert degrees"
    require(worst <= MAX_ANGLE, told)


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


def near_the_arm(chain: Chain) -> Chain:
    """The same motion with every joint's frame slid along its axis to the foot of the perpendicular
    from the frame before it: with s_i the shift along axis i, X_i ← s_{i−1}⁻¹ X_i s_i, which the
    motions about and along the axes commute with."""
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
    return replace(chain, joints=tuple(joints), flange_placement=flange, masses=tuple(masses))


def _limited(joint: Joint, where: str) -> Joint:
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


Value = TypeVar("Value")


def file_names(chain: Chain) -> dict[str, str]:
    both = ((f"joint{i}", joint.name) for i, joint in enumerate(chain.joints, start=1))
    return {number: name for number, name in both if name != number}


def clashing(chain: Chain) -> list[str]:
    numbers = {f"joint{i}" for i in range(1, chain.n_joints + 1)}
    return sorted(numbers.intersection(file_names(chain).values()))


def names_told(chain: Chain) -> str:
    """ "joint1 = shoulder_pan, joint2 = …", or "" where the file's names end with these numbers."""
    names = file_names(chain)
    ends = [re.search(r"[0-9]+$", name) for name in names.values()]
    if all(end and name == f"joint{int(end[0])}" for name, end in zip(names, ends, strict=True)):
        return ""
    return listed(f"{number} = {printable(name)}" for number, name in names.items())


def _meanings(chain: Chain, meant: str | None) -> tuple[dict[str, str], list[str]]:
    """What a joint may be called → jointN, and the names of which one must say what is `meant`."""
    by_file = {name: number for number, name in file_names(chain).items()}
    clash = [] if meant == "order" else clashing(chain)
    if clash:  # by the file: a number that is no name there means nothing
        same = {joint.name: joint.name for joint in chain.joints if joint.name not in by_file}
        return same | by_file, clash if meant is None else []
    return by_file | {f"joint{i}": f"joint{i}" for i in range(1, chain.n_joints + 1)}, []


def numbered(cell: Cell, chain: Chain) -> Cell:
    """The cell with every joint that it names as jointN, N its place in the chain; it may be named
    as in the robot's file.  Where the file calls another than the Nth joint jointN, `[robot]
    joint_names` says which is meant."""
    known, clash = _meanings(chain, cell.robot.joint_names)
    at = f"{cell.source}: "

    def loose(name: str, where: str) -> str:
        """jointN of a name that stands at `where`; what is no joint stays."""
        if name in clash:
            raise InputError(
                f"{where} names {name}, which in the robot's file is joint number "
                f"{known[name].removeprefix('joint')} of the arm ({names_told(chain)}); say which "
                'is meant: [robot] joint_names = "file" (names of the file) or "order" (jointN is '
                "the Nth)"
            )
        return known.get(name, name)

    def one(name: str, where: str) -> str:
        told = f"{where} names {name}, but robot '{chain.name}' has {chain.n_joints} joints"
        check_known(name, known, told, "they are")
        return loose(name, where)

    def keys(
        table: Mapping[str, Value], where: str, of: Callable[[str, str], str]
    ) -> dict[str, Value]:
        found = {of(name, where): value for name, value in table.items()}
        told = f"{where} names a joint twice, by its name in the robot's file and by its number"
        require(len(found) == len(table), f"{told} ({names_told(chain)}); keep one")
        return found

    spec, wishes = cell.model, cell.design
    spring = spec.nominal.gravity_compensator
    where = f"{at}[model.nominal.gravity_compensator] joint"
    nominal = replace(
        spec.nominal,
        settings=keys(spec.nominal.settings, f"{at}[model.nominal.settings]", loose),
        sizes=keys(spec.nominal.sizes, f"{at}[model.nominal.sizes]", loose),
        gravity_compensator=spring and spring | {"joint": one(str(spring["joint"]), where)},
    )
    effects = tuple(
        e if e.where is None else replace(e, where=loose(e.where, f"{at}[model] effects"))
        for e in spec.effects
    )
    levels = keys(spec.compliance_levels, f"{at}[model.compliance_levels]", one)
    combined = wish("combination", f"{at}[design] combination")
    wanted = wish("interest", f"{at}[design] interest")
    combination = {
        ".".join([loose(place, combined), *rest]): value
        for name, value in wishes.combination.items()
        for place, *rest in [name.rsplit(".", 1)]
    }
    return replace(
        cell,
        limits=keys(cell.limits, f"{at}[limits]", one),
        model=replace(spec, nominal=nominal, effects=effects, compliance_levels=levels),
        design=replace(
            wishes,
            levels=keys(wishes.levels, wish("levels", f"{at}[design.levels]"), one),
            interest=tuple(loose(name, wanted) for name in wishes.interest),
            combination=combination,
        ),
    )
