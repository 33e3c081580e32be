"""URDF → nominal chain: what is wrong with the file is said by name.

Only what kinematics and weights need is read: links with mass and centre of mass, joints with
parent, child, origin, axis and limits.  Meshes, materials, plugins and transmissions are ignored.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from elastocal.errors import InputError, require
from elastocal.files import read_bytes
from elastocal.model.chain import (
    FINGERS,
    MAX_JOINTS,
    MIN_JOINTS,
    Chain,
    Joint,
    JointKind,
    LinkMass,
    check_angles,
)
from elastocal.model.xml_file import MAX_BYTES, xacro_left, xml_tree
from elastocal.text import did_you_mean, listed
from elastocal.units import Array

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)
MOVING = ("revolute", "continuous", "prismatic")
JOINT_TYPES = (*MOVING, "fixed", "floating", "planar")
# Names of flanges, the usual first.
FLANGES = ("tool0", "flange", "ee_link", "tcp")
MOST_IN_A_FINGER = 5  # joints
# Links that `elastocal export` hangs on a flange; none of them is a flange itself.
TOOL_FRAMES = ("elastocal_marker_", "elastocal_load_point")
MOST_LINKS = 2000
ENDLESS_TEXT = re.compile(r"([+-]?)\.?inf(?:inity)?", re.IGNORECASE)
# What xacro, roslaunch and launch files would put in.
LEFT = re.compile(r"\$\{|\$\((?:arg|find|env|optenv|eval|dirname|anon)\b")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def read_urdf(path: str | Path, base: str | None = None, flange: str | None = None) -> Chain:
    """The serial chain between two links of a URDF.

    base: link name, default the root link; the chain starts in its frame.
    flange: link name, default the only leaf that at least four moving joints carry.
    Chain: placements in m, unit axes, limits in rad or m (continuous: infinite), and one mass
    per joint in kg with its centre of mass in m in the joint's frame (none if all are zero).
    Bodies beyond the flange and on side branches count, those carried by the base do not.

    Everything off the path from base to flange is held at zero.
    """
    tree = check_urdf(path)
    base, flange = tree.ends(base, flange)
    moving = tree.serial_chain(base, flange)
    with np.errstate(over="ignore", invalid="ignore"):  # numbers of 1e308 are judged later
        placements, end = tree.frames(base, flange)
        masses = tree.carried(moving)
    joints = []
    for source, placement in zip(moving, placements, strict=True):
        kind: JointKind = "prismatic" if source.kind == "prismatic" else "revolute"
        limits = source.limit or (-np.inf, np.inf)
        joints.append(Joint(source.name, kind, placement, np.array(source.axis), *limits))
    return Chain(
        tree.name, tuple(joints), end, masses if any(body.mass > 0 for body in masses) else ()
    )


# The tree of links and joints in a URDF, and the one path through it from base to flange.


@dataclass(frozen=True)
class UrdfJoint:
    """One <joint>: origin in m and rad, unit axis, limit (lower, upper); None where unlimited."""

    name: str
    kind: str
    parent: str
    child: str
    xyz: Vector
    rpy: Vector
    axis: Vector
    limit: tuple[float, float] | None = None
    mimic: str | None = None

    @property
    def origin(self) -> Array:
        """T (4, 4) from the joint's frame at zero to its parent link's."""
        from scipy.spatial.transform import Rotation

        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", self.rpy).as_matrix(), self.xyz
        return T


@dataclass(frozen=True)
class Tree:
    """Links, each with its own mass (0 where the URDF has none), and joints, in file order.

    Raises InputError at construction unless they form one tree: every link has at most one
    parent joint, exactly one has none, and all hang on that root.
    """

    path: Path
    name: str
    links: dict[str, LinkMass]
    joints: dict[str, UrdfJoint]

    def __post_init__(self) -> None:
        parents: dict[str, UrdfJoint] = {}
        for joint in self.joints.values():
            other = parents.setdefault(joint.child, joint)
            require(
                other is joint,
                f"{self.path}: link '{joint.child}' has two parents, joints '{other.name}' and "
                f"'{joint.name}'; kinematic loops are not supported, remove one of them",
            )
        roots = [name for name in self.links if name not in parents]
        reached = {link for root in roots for link in self._below(root)}
        if lost := [name for name in self.links if name not in reached]:
            way = [lost[0]]
            while way.count(way[-1]) < 2:
                way.append(parents[way[-1]].parent)
            cycle = [parents[name].name for name in way[way.index(way[-1]) : -1]]
            raise InputError(
                f"{self.path}: joints {listed(cycle[::-1])} form a closed loop "
                "that hangs on no root link; loops are not supported, open it at one joint"
            )
        require(
            len(roots) == 1,
            f"{self.path}: {len(roots)} links have no parent joint: {listed(roots)}; a robot "
            "is one tree with one root, connect or remove the others",
        )

    @cached_property
    def parent_joint(self) -> dict[str, UrdfJoint]:
        return {joint.child: joint for joint in self.joints.values()}

    @cached_property
    def _children(self) -> dict[str, list[str]]:
        children: dict[str, list[str]] = {name: [] for name in self.links}
        for joint in self.joints.values():
            children[joint.parent].append(joint.child)
        return children

    @property
    def root(self) -> str:
        return next(name for name in self.links if name not in self.parent_joint)

    def _below(self, link: str) -> Iterator[str]:
        waiting = [link]
        while waiting:
            link = waiting.pop()
            yield link
            waiting += self._children[link]

    def joints_between(self, base: str, flange: str) -> tuple[UrdfJoint, ...] | None:
        """All joints from base to flange in order, None unless flange is below base."""
        joints: list[UrdfJoint] = []
        link = flange
        while link != base:
            if link not in self.parent_joint:
                return None
            joints.append(self.parent_joint[link])
            link = joints[-1].parent
        return tuple(reversed(joints))

    def find_link(self, role: str, name: str, usual: str) -> str:
        """`name`, or an InputError with the nearest name, the `usual` one and all links if there
        is no such link."""
        hint = did_you_mean(name, self.links)
        hint += f" (usual here: '{usual}')" if usual and f"'{usual}'" not in hint else ""
        require(
            name in self.links,
            f"{self.path}: {role} link '{name}' is not there{hint}; links: {listed(self.links)}",
        )
        return name

    def ends(self, base: str | None, flange: str | None) -> tuple[str, str]:
        """The first and the last link, None for those that are found."""
        base = self.root if base is None else self.find_link("base", base, self.root)
        if flange is None:
            return base, self.only_flange(base)
        usual = ""
        if flange not in self.links:
            with suppress(InputError):  # of several arms, each with an end of its own
                usual = self.last_link(base)
        return base, self.find_link("flange", flange, usual)

    def last_link(self, base: str) -> str:
        """The link below `base` from which on fingers, or frames that none moves, branch off.

        Of the links that no other hangs on, those with the most moving joints on their way have it
        in common; among frames at its end one with a usual name is taken.  Raises InputError, with
        what each arm would end in, where there are several arms.
        """
        arms: dict[tuple[str, ...], list[str]] = {}
        for leaf in self._leaves(base):
            way = [joint.name for joint in self._moving(base, leaf)]
            if len(way) >= MIN_JOINTS:
                arms.setdefault(tuple(way[:MIN_JOINTS]), []).append(leaf)
        ends = [self._end_of_arm(base, leaves) for leaves in arms.values()]
        require(
            len(ends) < 2,
            f"{self.path}: several links could be the flange, one of each arm: "
            f"{listed(sorted(ends))}; name the right one as `flange`, and its base",
        )
        leaves = self._leaves(base)
        return ends[0] if ends else max(leaves, key=lambda leaf: len(self._moving(base, leaf)))

    def only_flange(self, base: str) -> str:
        """`last_link` where there is nothing to choose: a cell that leaves the choice open may have
        meant another frame.  Raises InputError with the links that there are."""
        able = [k for k in self._leaves(base) if len(self._moving(base, k)) >= MIN_JOINTS]
        found = self.last_link(base)
        require(
            len(able) < 2,
            f"{self.path}: several links could be the flange: {listed(sorted({*able, found}))}; "
            f"name the right one as `flange` (init takes '{found}')",
        )
        return found

    def _leaves(self, base: str) -> list[str]:
        """Links on which nothing hangs but tool frames that `export` has added."""
        return [
            link for link in self._below(base)
            if not link.startswith(TOOL_FRAMES)
            and all(child.startswith(TOOL_FRAMES) for child in self._children[link])
        ]  # fmt: skip

    def _end_of_arm(self, base: str, leaves: Sequence[str]) -> str:
        most = max(len(self._moving(base, leaf)) for leaf in leaves)
        ways = [
            [joint.child for joint in self.joints_between(base, leaf) or ()]
            for leaf in leaves
            if len(self._moving(base, leaf)) == most
        ]
        common = [link for link in ways[0] if all(link in way for way in ways)]
        if len(self._moving(base, common[-1])) == most and len(ways) > 1:
            named = [way[-1] for name in FLANGES for way in ways if way[-1] == name]
            return named[0] if named else common[-1]
        # Fingers of unequal length, as a thumb has: no link is common to those with most joints.
        for k, link in enumerate(common):
            before, after = (
                len(self._moving(*pair)) for pair in ((base, link), (link, common[-1]))
            )
            if before < MIN_JOINTS or not 0 < after <= MOST_IN_A_FINGER:
                continue
            beside = [c for c in self._children[link] if c not in common and self._moves(c)]
            if len(beside) > 1 or any(self._is_finger(c) for c in beside):
                return common[k]
        return common[-1]

    def _moves(self, link: str) -> bool:
        """Whether the joint before a link, or one below it, moves."""
        return any(self.parent_joint[below].kind in MOVING for below in self._below(link))

    def _is_finger(self, link: str) -> bool:
        joints = [self.parent_joint[below] for below in self._below(link)]
        return any(j.mimic is not None or FINGERS.search(j.name + j.child) for j in joints)

    def placed(self, root: str, link: str) -> Array:
        """T_root_link (4, 4) with every joint between them at zero."""
        T = np.eye(4)
        for joint in self.joints_between(root, link) or ():
            T = T @ joint.origin
        return T

    def frames(self, base: str, flange: str) -> tuple[list[Array], Array]:
        """Of each moving joint its frame in the one before it, the first in the base's, and the
        flange's in the last (4, 4)."""
        placements, T = [], np.eye(4)
        for joint in self.joints_between(base, flange) or ():
            T = T @ joint.origin
            if joint.kind in MOVING:
                placements.append(T)
                T = np.eye(4)
        return placements, T

    def carried(self, moving: Sequence[UrdfJoint]) -> tuple[LinkMass, ...]:
        """What each of the joints carries up to the next of them, in its frame."""
        own = {joint.child: k for k, joint in enumerate(moving)}
        mass, moment = np.zeros(len(moving)), np.zeros((len(moving), 3))
        at: dict[str, tuple[int | None, Array]] = {}  # number of the joint, place in its frame
        for link in self._below(self.root):
            before = self.parent_joint.get(link)
            k, T = (None, np.eye(4)) if before is None else at[before.parent]
            if before is not None:
                k, T = (own[link], np.eye(4)) if link in own else (k, T @ before.origin)
            at[link] = k, T
            if k is not None:
                body = self.links[link]
                mass[k] += body.mass
                moment[k] += body.mass * (T @ [*body.com, 1.0])[:3]
        return tuple(
            LinkMass(float(m), s / m if m > 0 else np.zeros(3))
            for m, s in zip(mass, moment, strict=True)
        )

    def _moving(self, base: str, flange: str) -> list[UrdfJoint]:
        return [j for j in self.joints_between(base, flange) or () if j.kind in MOVING]

    def serial_chain(self, base: str, flange: str) -> tuple[UrdfJoint, ...]:
        """The moving joints between base and flange, in order."""
        joints = self.joints_between(base, flange)
        if joints is None:
            raise InputError(
                f"{self.path}: flange '{flange}' is not below base '{base}'; links below "
                f"'{base}': {listed(link for link in self._below(base) if link != base)}"
            )
        for joint in joints:
            _check_on_path(joint, f"{self.path}: joint '{joint.name}'")
        moving = self._moving(base, flange)
        names = listed(joint.name for joint in moving) or "none"
        require(
            MIN_JOINTS <= len(moving) <= MAX_JOINTS,
            f"{self.path}: {len(moving)} moving joints between '{base}' and '{flange}' "
            f"({names}); {MIN_JOINTS} to {MAX_JOINTS} are supported, choose base and flange "
            "accordingly",
        )
        return tuple(moving)


def _check_on_path(joint: UrdfJoint, where: str) -> None:
    require(
        joint.kind not in ("floating", "planar"),
        f"{where} is {joint.kind} and lies between base and flange; only revolute, "
        "continuous, prismatic and fixed joints can, choose a base below it",
    )
    if joint.kind not in MOVING:
        return
    require(
        joint.mimic is None,
        f"{where} mimics '{joint.mimic}' and lies between base and flange; coupled joints "
        "are not supported there, remove <mimic> or choose another flange",
    )
    if joint.kind == "continuous":
        return
    if joint.limit is None:
        raise InputError(
            f'{where} is {joint.kind} without <limit>; add <limit lower="…" upper="…" '
            'effort="0" velocity="0"/> or make it continuous'
        )
    lower, upper = joint.limit
    require(
        lower < upper,
        f"{where}: limits lower={lower:g}, upper={upper:g} leave no room to move; "
        "lower must be below upper (URDF takes 0 for one left out)",
    )


# From the file to checked records: whatever is wrong with the XML is said here, by name.


def check_urdf(path: str | Path) -> Tree:
    """The links and joints of the URDF file at `path`, every name and number checked."""
    path = Path(path)
    root = _without_namespace(path, xml_tree(path, urdf_bytes(path), "a URDF"))
    links: dict[str, LinkMass] = {}
    for element in root.findall("link"):
        require(len(links) < MOST_LINKS, f"{path}: more than {MOST_LINKS} links; remove some")
        name = _name(path, element, links)
        links[name] = _mass(f"{path}: link '{name}'", element.find("inertial"))
    require(bool(links), f"{path}: <robot> has no <link>; a robot needs links and joints")
    joints: dict[str, UrdfJoint] = {}
    for element in root.findall("joint"):
        require(len(joints) < MOST_LINKS, f"{path}: more than {MOST_LINKS} joints; remove some")
        name = _name(path, element, joints)
        joints[name] = _joint(f"{path}: joint '{name}'", name, element, links)
    for joint in joints.values():
        if joint.mimic is not None and joint.mimic not in joints:
            raise InputError(
                f"{path}: joint '{joint.name}' mimics joint '{joint.mimic}', which is not there"
                f"{did_you_mean(joint.mimic, joints)}; name an existing joint"
            )
    return Tree(path, root.get("name") or path.stem, links, joints)


def urdf_bytes(path: Path) -> bytes:
    """The content of a URDF file.  Raises InputError where it cannot be read or is too large."""
    return read_bytes(path, "URDF file", MAX_BYTES)


def _without_namespace(path: Path, root: ET.Element) -> ET.Element:
    for element in root.iter():
        namespace, _, local = element.tag.rpartition("}")
        require("xacro" not in namespace, xacro_left(path, f"<xacro:{local}>"))
        # Files of meshes and plug-ins are not read.
        values = [v for k, v in element.attrib.items() if k not in ("filename", "file")]
        macro = next((v for v in values if LEFT.search(v)), None)
        require(macro is None, xacro_left(path, f"'{macro}' in <{local}>"))
        element.tag = local
    other = {"mujoco": "MJCF", "sdf": "SDF"}.get(root.tag)
    way = 'give it as mjcf = "…"' if other == "MJCF" else "export it as URDF"
    hint = f"; this is {other}, {way}" if other else ""
    require(
        root.tag == "robot",
        f'{path}: the root element is <{root.tag}>, a URDF has <robot name="…">{hint}',
    )
    return root


def _name(path: Path, element: ET.Element, known: Mapping[str, Any]) -> str:
    tag, name = element.tag, element.get("name", "").strip()
    require(
        bool(name), f'{path}: {tag} number {len(known) + 1} has no name; write <{tag} name="…">'
    )
    require(
        name not in known,
        f"{path}: two {tag}s are named '{name}'; names must be unique, rename one",
    )
    return name


def _mass(where: str, inertial: ET.Element | None) -> LinkMass:
    if inertial is None:
        return LinkMass(0.0, np.zeros(3))
    element = inertial.find("mass")
    text = None if element is None else element.get("value")
    if text is None:
        raise InputError(
            f'{where}: <inertial> without <mass value="…">; add it or remove <inertial>'
        )
    mass = _number(f"{where}, mass value", text)
    require(mass >= 0, f"{where}: mass {mass:g} kg is negative; give kg, zero or more")
    return LinkMass(mass, np.array(_vector(where, inertial, "origin", "xyz")))


def _joint(where: str, name: str, element: ET.Element, links: Mapping[str, LinkMass]) -> UrdfJoint:
    kind = element.get("type")
    if kind is None:
        raise InputError(f'{where} has no type; write type="{"|".join(JOINT_TYPES)}"')
    require(
        kind in JOINT_TYPES,
        f"{where}: unknown joint type '{kind}'{did_you_mean(kind, JOINT_TYPES)}; "
        f"valid: {', '.join(JOINT_TYPES)}",
    )
    x, y, z = _vector(where, element, "axis", "xyz", (1.0, 0.0, 0.0))  # URDF default
    length = math.hypot(x, y, z)
    require(
        kind not in MOVING or length >= 1e-9,
        f'{where}: axis is zero; give a direction such as xyz="0 0 1"',
    )
    limit = None
    if (stated := element.find("limit")) is not None:
        lower, upper = (
            _limit(f"{where}, limit {side}", stated.get(side, "0")) for side in ("lower", "upper")
        )
        limit = None if kind == "continuous" else (lower, upper)
    mimic = element.find("mimic")
    rpy = _vector(where, element, "origin", "rpy")
    check_angles(f"{where}, origin rpy", rpy, "a URDF takes rad")
    return UrdfJoint(
        name,
        kind,
        parent=_end(where, element, "parent", links),
        child=_end(where, element, "child", links),
        xyz=_vector(where, element, "origin", "xyz"),
        rpy=rpy,
        axis=(x / length, y / length, z / length) if length else (x, y, z),
        limit=limit,
        mimic=None if mimic is None else mimic.get("joint", ""),
    )


def _end(where: str, element: ET.Element, side: str, links: Mapping[str, LinkMass]) -> str:
    end = element.find(side)
    name = "" if end is None else end.get("link", "")
    require(bool(name), f'{where} has no {side} link; add <{side} link="…"/>')
    require(
        name in links,
        f"{where}: {side} link '{name}' is not there{did_you_mean(name, links)}; "
        "name an existing link or add it",
    )
    return name


def _vector(
    where: str, parent: ET.Element, tag: str, attribute: str, default: Vector = ZERO
) -> Vector:
    element = parent.find(tag)
    text = None if element is None else element.get(attribute)
    if text is None:
        return default
    words, what = text.split(), f"{where}, {tag} {attribute}"
    require(
        len(words) == 3, f"{what}: '{text}' is not three numbers; write e.g. {attribute}=\"0 0 1\""
    )
    x, y, z = (_number(what, word) for word in words)
    return x, y, z


def _limit(what: str, text: str) -> float:
    """A number, or infinite: no limit."""
    endless = ENDLESS_TEXT.fullmatch(text.strip())
    if endless is None:
        return _number(what, text)
    return -math.inf if endless[1] == "-" else math.inf


def _number(what: str, text: str) -> float:
    text = text.strip()
    value = float(text) if NUMBER.fullmatch(text) else math.nan
    require(
        math.isfinite(value), f"{what}: '{text}' is not a finite number; write e.g. 0.25 or -1.5e-3"
    )
    return value
