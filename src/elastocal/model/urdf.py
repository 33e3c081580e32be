"""URDF → nominal chain: what is wrong with the file is said by name; Pinocchio reads the rest."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from elastocal.errors import InputError
from elastocal.model.chain import MAX_JOINTS, MIN_JOINTS, Chain, Joint, LinkMass
from elastocal.text import did_you_mean, listed
from elastocal.units import Array

# The tree of links and joints in a URDF, and the one path through it from base to flange.

Vector = tuple[float, float, float]
MOVING = ("revolute", "continuous", "prismatic")
# Links that `elastocal export` hangs on a flange; none of them is a flange itself.
TOOL_FRAMES = ("elastocal_marker_", "elastocal_load_point")


@dataclass(frozen=True)
class Link:
    """Mass in kg (0 where the URDF has none) and centre of mass in m in the link's frame."""

    name: str
    mass: float = 0.0
    com: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class UrdfJoint:
    """One <joint>: origin in m and rad, unit axis, limit (lower, upper) or None."""

    name: str
    kind: str
    parent: str
    child: str
    xyz: Vector
    rpy: Vector
    axis: Vector
    limit: tuple[float, float] | None = None
    mimic: str | None = None


@dataclass(frozen=True)
class Tree:
    """Links and joints by name, in file order.

    Raises InputError at construction unless they form one tree: every link has at most one
    parent joint, exactly one has none, and all hang on that root.
    """

    path: Path
    name: str
    links: dict[str, Link]
    joints: dict[str, UrdfJoint]

    def __post_init__(self) -> None:
        parents: dict[str, UrdfJoint] = {}
        for joint in self.joints.values():
            other = parents.setdefault(joint.child, joint)
            if other is not joint:
                raise InputError(
                    f"{self.path}: link '{joint.child}' has two parents, joints '{other.name}' and "
                    f"'{joint.name}'; kinematic loops are not supported, remove one of them"
                )
        roots = [name for name in self.links if name not in parents]
        reached = {link for root in roots for link in self._below(root)}
        if len(reached) < len(self.links):
            cycle = self._cycle(next(name for name in self.links if name not in reached))
            raise InputError(
                f"{self.path}: joints {listed(cycle)} form a closed loop "
                "that hangs on no root link; loops are not supported, open it at one joint"
            )
        if len(roots) > 1:
            raise InputError(
                f"{self.path}: {len(roots)} links have no parent joint: {listed(roots)}; a robot "
                "is one tree with one root, connect or remove the others"
            )

    @cached_property
    def parent_joint(self) -> dict[str, UrdfJoint]:
        return {joint.child: joint for joint in self.joints.values()}

    @cached_property
    def _child_joints(self) -> dict[str, list[UrdfJoint]]:
        children: dict[str, list[UrdfJoint]] = {name: [] for name in self.links}
        for joint in self.joints.values():
            children[joint.parent].append(joint)
        return children

    @property
    def root(self) -> str:
        return next(name for name in self.links if name not in self.parent_joint)

    def _below(self, link: str) -> Iterator[str]:
        waiting = [link]
        while waiting:
            link = waiting.pop()
            yield link
            waiting += [joint.child for joint in self._child_joints[link]]

    def _cycle(self, link: str) -> list[str]:
        observed: list[str] = []
        while link not in observed:
            observed.append(link)
            link = self.parent_joint[link].parent
        return [self.parent_joint[name].name for name in reversed(observed[observed.index(link) :])]

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

    def find_link(self, role: str, name: str) -> str:
        """`name`, or an InputError with the nearest name and all links if there is no such link."""
        if name not in self.links:
            raise InputError(
                f"{self.path}: {role} link '{name}' is not there{did_you_mean(name, self.links)}; "
                f"links: {listed(self.links)}"
            )
        return name

    def last_link(self, base: str) -> str:
        """The only leaf below `base` that enough moving joints carry to be a flange."""
        leaves = [link for link in self._below(base) if self._is_leaf(link)]
        able = [leaf for leaf in leaves if len(self._moving(base, leaf)) >= MIN_JOINTS]
        choice = able or leaves
        if len(choice) > 1:
            raise InputError(
                f"{self.path}: several links could be the flange: {listed(sorted(choice))}; "
                "name the right one as `flange`"
            )
        return choice[0]

    def _is_leaf(self, link: str) -> bool:
        """Does nothing hang on the link but tool frames that `export` has added?"""
        below = (joint.child for joint in self._child_joints[link])
        return not link.startswith(TOOL_FRAMES) and all(c.startswith(TOOL_FRAMES) for c in below)

    def _moving(self, base: str, flange: str) -> list[UrdfJoint]:
        joints = self.joints_between(base, flange) or ()
        return [joint for joint in joints if joint.kind in MOVING]

    def serial_chain(self, base: str, flange: str) -> tuple[UrdfJoint, ...]:
        """The moving joints between base and flange, in order.

        Raises InputError if flange is not below base, if a joint on the path is floating, planar
        or a mimic or has no usable limits, or if the count is outside 4…9.
        """
        joints = self.joints_between(base, flange)
        if joints is None:
            raise InputError(
                f"{self.path}: flange '{flange}' is not below base '{base}'; links below "
                f"'{base}': {listed(link for link in self._below(base) if link != base)}"
            )
        for joint in joints:
            self._check_on_path(joint, f"{self.path}: joint '{joint.name}'")
        moving = self._moving(base, flange)
        if not MIN_JOINTS <= len(moving) <= MAX_JOINTS:
            names = listed(joint.name for joint in moving) or "none"
            raise InputError(
                f"{self.path}: {len(moving)} moving joints between '{base}' and '{flange}' "
                f"({names}); {MIN_JOINTS} to {MAX_JOINTS} are supported, choose base and flange "
                "accordingly"
            )
        return tuple(moving)

    def _check_on_path(self, joint: UrdfJoint, where: str) -> None:
        if joint.kind in ("floating", "planar"):
            raise InputError(
                f"{where} is {joint.kind} and lies between base and flange; only revolute, "
                "continuous, prismatic and fixed joints can, choose a base below it"
            )
        if joint.kind not in MOVING:
            return
        if joint.mimic is not None:
            raise InputError(
                f"{where} mimics '{joint.mimic}' and lies between base and flange; coupled joints "
                "are not supported there, remove <mimic> or choose another flange"
            )
        if joint.kind == "continuous":
            return
        if joint.limit is None:
            raise InputError(
                f'{where} is {joint.kind} without <limit>; add <limit lower="…" upper="…" '
                'effort="0" velocity="0"/> or make it continuous'
            )
        lower, upper = joint.limit
        if lower >= upper:
            raise InputError(
                f"{where}: limits lower={lower:g}, upper={upper:g} leave no room to move; "
                "lower must be below upper (URDF takes 0 for one left out)"
            )


# URDF file → checked records: whatever is wrong with the XML is said here, by name.
#
# Only what kinematics and weights need is kept (links with mass and centre of mass, joints with
# parent, child, origin, axis and limits); meshes, materials, plugins and transmissions are ignored.

MAX_BYTES = 50_000_000
JOINT_TYPES = (*MOVING, "fixed", "floating", "planar")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def check_urdf(path: str | Path) -> Tree:
    """The links and joints of the URDF file at `path`, every name and number checked.

    Raises InputError for a file that cannot be read or is not XML, for xacro macros left in,
    and for elements with missing, duplicate or unknown names or with bad numbers.
    """
    path = Path(path)
    root = _parse(path)
    links: dict[str, Link] = {}
    for element in root.findall("link"):
        name = _name(path, element, links)
        links[name] = _link(f"{path}: link '{name}'", name, element)
    if not links:
        raise InputError(f"{path}: <robot> has no <link>; a robot needs links and joints")
    joints: dict[str, UrdfJoint] = {}
    for element in root.findall("joint"):
        name = _name(path, element, joints)
        joints[name] = _joint(f"{path}: joint '{name}'", name, element, links)
    for joint in joints.values():
        if joint.mimic is not None and joint.mimic not in joints:
            raise InputError(
                f"{path}: joint '{joint.name}' mimics joint '{joint.mimic}', which is not there"
                f"{did_you_mean(joint.mimic, joints)}; name an existing joint"
            )
    return Tree(path, root.get("name") or path.stem, links, joints)


def _parse(path: Path) -> ET.Element:
    try:
        if path.is_dir():
            raise InputError(f"{path}: is a directory; give the URDF file itself")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(
                f"{path}: {size / 1e6:.0f} MB is too large for a URDF (at most 50 MB); "
                "is this a mesh?"
            )
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such URDF file; check the path") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read ({reason})") from None
    try:
        root = ET.fromstring(data)
    except ET.ParseError as error:
        if "unbound prefix" in str(error) and b"<xacro:" in data:
            raise InputError(_xacro(path, "<xacro:…> elements")) from None
        line, column = error.position
        reason = str(error).split(": line")[0]
        raise InputError(
            f"{path}: not XML: {reason} in line {line}, column {column + 1}; a URDF is an XML file"
        ) from None
    except (LookupError, ValueError) as error:
        raise InputError(f"{path}: not XML: {error}; save it as UTF-8") from None
    return _without_namespace(path, root)


def _without_namespace(path: Path, root: ET.Element) -> ET.Element:
    for element in root.iter():
        namespace, _, local = element.tag.rpartition("}")
        if "xacro" in namespace:
            raise InputError(_xacro(path, f"<xacro:{local}>"))
        macro = next((v for v in element.attrib.values() if "${" in v), None)
        if macro is not None:
            raise InputError(_xacro(path, f"'{macro}' in <{local}>"))
        element.tag = local
    if root.tag != "robot":
        hint = {
            "mujoco": "; this is MJCF, export it as URDF",
            "sdf": "; this is SDF, export it as URDF",
        }.get(root.tag, "")
        raise InputError(
            f'{path}: the root element is <{root.tag}>, a URDF has <robot name="…">{hint}'
        )
    return root


def _xacro(path: Path, what: str) -> str:
    return (
        f"{path}: xacro macros are left in ({what}); "
        f"run xacro first: xacro {path.name} > expanded.urdf"
    )


def _name(path: Path, element: ET.Element, known: dict) -> str:
    name = element.get("name", "").strip()
    if not name:
        raise InputError(
            f"{path}: {element.tag} number {len(known) + 1} has no name; "
            f'write <{element.tag} name="…">'
        )
    if name in known:
        raise InputError(
            f"{path}: two {element.tag}s are named '{name}'; names must be unique, rename one"
        )
    return name


def _link(where: str, name: str, element: ET.Element) -> Link:
    inertial = element.find("inertial")
    if inertial is None:
        return Link(name)
    mass_element = inertial.find("mass")
    if mass_element is None or mass_element.get("value") is None:
        raise InputError(
            f'{where}: <inertial> without <mass value="…">; add it or remove <inertial>'
        )
    mass = _number(f"{where}, mass value", mass_element.get("value", ""))
    if mass < 0:
        raise InputError(f"{where}: mass {mass:g} kg is negative; give kg, zero or more")
    com = _vector(where, inertial.find("origin"), "origin", "xyz", (0.0, 0.0, 0.0))
    return Link(name, mass, com)


def _joint(where: str, name: str, element: ET.Element, links: dict[str, Link]) -> UrdfJoint:
    kind = element.get("type")
    if kind is None:
        raise InputError(f'{where} has no type; write type="{"|".join(JOINT_TYPES)}"')
    if kind not in JOINT_TYPES:
        raise InputError(
            f"{where}: unknown joint type '{kind}'{did_you_mean(kind, JOINT_TYPES)}; "
            f"valid: {', '.join(JOINT_TYPES)}"
        )
    origin = element.find("origin")
    zero = (0.0, 0.0, 0.0)
    axis = _vector(where, element.find("axis"), "axis", "xyz", (1.0, 0.0, 0.0))  # URDF default
    length = math.hypot(*axis)
    if kind in MOVING and length < 1e-9:
        raise InputError(f'{where}: axis is zero; give a direction such as xyz="0 0 1"')
    limit = element.find("limit")
    bounds = None
    if limit is not None:
        lower, upper = (
            _number(f"{where}, limit {side}", limit.get(side, "0")) for side in ("lower", "upper")
        )
        bounds = (lower, upper)
    mimic = element.find("mimic")
    return UrdfJoint(
        name=name,
        kind=kind,
        parent=_end(where, element, "parent", links),
        child=_end(where, element, "child", links),
        xyz=_vector(where, origin, "origin", "xyz", zero),
        rpy=_vector(where, origin, "origin", "rpy", zero),
        axis=(axis[0] / length, axis[1] / length, axis[2] / length) if length else axis,
        limit=bounds,
        mimic=None if mimic is None else mimic.get("joint", ""),
    )


def _end(where: str, element: ET.Element, side: str, links: dict[str, Link]) -> str:
    end = element.find(side)
    name = None if end is None else end.get("link")
    if not name:
        raise InputError(f'{where} has no {side} link; add <{side} link="…"/>')
    if name not in links:
        raise InputError(
            f"{where}: {side} link '{name}' is not there{did_you_mean(name, links)}; "
            "name an existing link or add it"
        )
    return name


def _vector(
    where: str, element: ET.Element | None, tag: str, attribute: str, default: Vector
) -> Vector:
    text = None if element is None else element.get(attribute)
    if text is None:
        return default
    words = text.split()
    what = f"{where}, {tag} {attribute}"
    if len(words) != 3:
        raise InputError(f"{what}: '{text}' is not three numbers; write e.g. {attribute}=\"0 0 1\"")
    x, y, z = (_number(what, word) for word in words)
    return x, y, z


def _number(what: str, text: str) -> float:
    text = text.strip()
    value = float(text) if NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise InputError(f"{what}: '{text}' is not a finite number; write e.g. 0.25 or -1.5e-3")
    return value


# URDF → nominal chain.  Pinocchio reads the kinematics; urdf_check says what is wrong before.
#
# Everything off the path from base to flange is held still: those joints become fixed at their
# neutral position, so that pinocchio merges their bodies into the joint on the path that carries
# them.  With X_i pinocchio's placement of joint i in its parent joint, the chain is
#
#     T_base_flange(q) = (T_p0_base)⁻¹ X_1 J_1(q_1) X_2 J_2(q_2) … X_n J_n(q_n) T_n_flange
#
# where p0 is the (immobile) joint frame that carries the base link.


def read_urdf(path: str | Path, base: str | None = None, flange: str | None = None) -> Chain:
    """The serial chain between two links of a URDF.

    base: link name, default the root link; the chain starts in its frame.
    flange: link name, default the only leaf that at least four moving joints carry.
    Chain: placements in m, unit axes, limits in rad or m (continuous: infinite), and one mass
    per joint in kg with its centre of mass in m in the joint's frame (none if all are zero).
    Bodies beyond the flange and on side branches count, those carried by the base do not.

    Raises InputError, naming file, element and remedy, for anything urdf_check or Tree refuses.
    """
    tree = check_urdf(path)
    base = tree.root if base is None else tree.find_link("base", base)
    flange = tree.last_link(base) if flange is None else tree.find_link("flange", flange)
    moving = tree.serial_chain(base, flange)
    model = _pinocchio_model(tree, moving)
    base_in_parent = _link_placement(model, base)
    joints = []
    for i, source in enumerate(moving, start=1):
        placement = model.jointPlacements[i].homogeneous
        if i == 1:
            placement = base_in_parent.inverse().homogeneous @ placement
        joints.append(_pinocchio_joint(source, placement, model, i))
    masses = tuple(
        LinkMass(float(inertia.mass), np.array(inertia.lever)) for inertia in model.inertias[1:]
    )
    return Chain(
        name=tree.name,
        joints=tuple(joints),
        flange_placement=_link_placement(model, flange).homogeneous,
        masses=masses if any(body.mass > 0 for body in masses) else (),
    )


def _pinocchio_joint(source: UrdfJoint, placement: Array, model: Any, index: int) -> Joint:
    # The motion subspace is (linear, angular) for every pinocchio joint, aligned or not, also
    # for unbounded ones that store (cos q, sin q).
    subspace = np.asarray(model.createData().joints[index].S).reshape(6)
    prismatic = source.kind == "prismatic"
    lower, upper = source.limit or (-np.inf, np.inf)
    if source.kind == "continuous":
        lower, upper = -np.inf, np.inf
    return Joint(
        name=source.name,
        kind="prismatic" if prismatic else "revolute",
        placement=placement,
        axis=subspace[:3] if prismatic else subspace[3:],
        lower=lower,
        upper=upper,
    )


def _link_placement(model: Any, link: str) -> Any:
    import pinocchio as pin

    return model.frames[model.getFrameId(link, pin.FrameType.BODY)].placement


def _pinocchio_model(tree: Tree, moving: Sequence[UrdfJoint]) -> Any:
    import pinocchio as pin

    try:
        model = pin.buildModelFromXML(skeleton(tree, {joint.name for joint in moving}))
    except Exception as error:  # pinocchio raises ValueError, RuntimeError and its own
        raise InputError(f"{tree.path}: pinocchio cannot read it: {error}") from error
    found = list(model.names)[1:]
    expected = [joint.name for joint in moving]
    if found != expected or list(model.parents)[1:] != list(range(len(found))):
        raise InputError(
            f"{tree.path}: pinocchio reads the joints {found} as something else than the serial "
            f"chain {expected}; simplify the URDF"
        )
    return model


def skeleton(tree: Tree, moving: Collection[str]) -> str:
    """URDF text with links, masses and joints only; joints not in `moving` are fixed."""
    robot = ET.Element("robot", name=tree.name)
    for link in tree.links.values():
        element = ET.SubElement(robot, "link", name=link.name)
        inertial = ET.SubElement(element, "inertial")
        ET.SubElement(inertial, "mass", value=repr(link.mass))
        ET.SubElement(inertial, "origin", xyz=_text(link.com))
        zero = dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")
        ET.SubElement(inertial, "inertia", zero)
    for joint in tree.joints.values():
        kind = joint.kind if joint.name in moving else "fixed"
        element = ET.SubElement(robot, "joint", name=joint.name, type=kind)
        ET.SubElement(element, "parent", link=joint.parent)
        ET.SubElement(element, "child", link=joint.child)
        ET.SubElement(element, "origin", xyz=_text(joint.xyz), rpy=_text(joint.rpy))
        ET.SubElement(element, "axis", xyz=_text(joint.axis))
        if kind in ("revolute", "prismatic") and joint.limit is not None:
            lower, upper = (repr(bound) for bound in joint.limit)
            ET.SubElement(element, "limit", lower=lower, upper=upper, effort="0", velocity="0")
    return ET.tostring(robot, encoding="unicode")


def _text(vector: tuple[float, float, float]) -> str:
    return " ".join(repr(value) for value in vector)
