"""URDF → the links and joints of a robot: what is wrong with the file is said by name.

Only what kinematics and weights need is read: links with mass and centre of mass, joints with
parent, child, origin, axis and limits.  Meshes, materials, plugins and transmissions are ignored.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from functools import lru_cache
from pathlib import Path

import numpy as np

from elastocal.errors import InputError, require
from elastocal.files import read_bytes
from elastocal.model.chain import Chain, LinkMass, check_angles
from elastocal.model.robot_tree import MOVING, FileJoint, Tree
from elastocal.model.xml_file import MAX_BYTES, Tag, XmlFile
from elastocal.text import did_you_mean
from elastocal.units import rotation_from_rpy

Vector = tuple[float, float, float]
JOINT_TYPES = (*MOVING, "fixed", "floating", "planar")
MOST_LINKS = 2000
ENDLESS_TEXT = re.compile(r"([+-]?)\.?inf(?:inity)?", re.IGNORECASE)
# What xacro, roslaunch and launch files would put in.
LEFT = re.compile(r"\$\{|\$\((?:arg|find|env|optenv|eval|dirname|anon)\b")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def read_urdf(path: str | Path, base: str | None = None, flange: str | None = None) -> Chain:
    """The serial chain between two links of a URDF.

    base: link name, default the root link; the chain starts in its frame.
    flange: link name, default the only leaf that at least four moving joints carry.
    """
    tree = check_urdf(path)
    return tree.chain(*tree.ends(base, flange, choose=False))


def check_urdf(path: str | Path) -> Tree:
    """The links and joints of the URDF file at `path`, every name and number checked."""
    file = Path(path)
    return _known(file, read_bytes(file, "URDF file", MAX_BYTES))


@lru_cache(maxsize=8)
def _known(path: Path, data: bytes) -> Tree:
    # A cell's model, its first cell, an export each ask for the same file.
    return tree_of(XmlFile(path, data, "a URDF"))


def urdf_file(path: Path) -> XmlFile:
    """The file to be edited."""
    return XmlFile.read(path, "URDF file", "a URDF")


def tree_of(file: XmlFile) -> Tree:
    path, root = file.path, file.root
    _check_root(file)
    links: dict[str, LinkMass] = {}
    for tag in root.all("link"):
        name = _name(path, tag, links)
        links[name] = _mass(f"{path}: link '{name}'", tag.first("inertial"))
    require(bool(links), f"{path}: <robot> has no <link>; a robot needs links and joints")
    joints: dict[str, FileJoint] = {}
    for tag in root.all("joint"):
        name = _name(path, tag, joints)
        joints[name] = _joint(f"{path}: joint '{name}'", name, tag, links)
    for joint in joints.values():
        if joint.follows is not None and joint.follows not in joints:
            raise InputError(
                f"{path}: joint '{joint.name}' mimics joint '{joint.follows}', which is not there"
                f"{did_you_mean(joint.follows, joints)}; name an existing joint"
            )
    return Tree(path, root.get("name") or path.stem, links, tuple(joints.values()))


def xacro_left(path: Path, what: str) -> str:
    """The message that `what` of the file shows that it is still to be expanded."""
    plain = path.name.removesuffix(".xacro")
    plain = plain if plain.endswith(".urdf") and plain != path.name else "expanded.urdf"
    return (
        f"{path}: xacro macros are left in ({what}); run xacro first: xacro {path.name} > {plain}"
    )


def _check_root(file: XmlFile) -> None:
    path, root = file.path, file.root.name
    for tag in file.tags:
        require(tag.prefix != "xacro", xacro_left(path, f"<xacro:{tag.name}>"))
        # Files of meshes and plug-ins are not read.
        values = [v for k, v in tag.stated.items() if k not in ("filename", "file")]
        macro = next((v for v in values if LEFT.search(v)), None)
        require(macro is None, xacro_left(path, f"'{macro}' in <{tag.name}>"))
    other = {"mujoco": "MJCF", "sdf": "SDF"}.get(root)
    way = 'give it as mjcf = "…"' if other == "MJCF" else "export it as URDF"
    hint = f"; this is {other}, {way}" if other else ""
    require(
        root == "robot",
        f'{path}: the root element is <{root}>, a URDF has <robot name="…">{hint}',
    )


def _name(path: Path, tag: Tag, known: Collection[str]) -> str:
    kind, name = tag.name, tag.get("name").strip()
    require(len(known) < MOST_LINKS, f"{path}: more than {MOST_LINKS} {kind}s; remove some")
    require(
        bool(name), f'{path}: {kind} number {len(known) + 1} has no name; write <{kind} name="…">'
    )
    require(
        name not in known,
        f"{path}: two {kind}s are named '{name}'; names must be unique, rename one",
    )
    return name


def _mass(where: str, inertial: Tag | None) -> LinkMass:
    if inertial is None:
        return LinkMass(0.0, np.zeros(3))
    stated = inertial.first("mass")
    if stated is None or "value" not in stated.stated:
        raise InputError(
            f'{where}: <inertial> without <mass value="…">; add it or remove <inertial>'
        )
    mass = _number(f"{where}, mass value", stated.get("value"))
    require(mass >= 0, f"{where}: mass {mass:g} kg is negative; give kg, zero or more")
    return LinkMass(mass, np.array(_vector(where, inertial, "origin", "xyz")))


def _joint(where: str, name: str, tag: Tag, links: Collection[str]) -> FileJoint:
    kind = tag.stated.get("type")
    if kind is None:
        raise InputError(f'{where} has no type; write type="{"|".join(JOINT_TYPES)}"')
    require(
        kind in JOINT_TYPES,
        f"{where}: unknown joint type '{kind}'{did_you_mean(kind, JOINT_TYPES)}; "
        f"valid: {', '.join(JOINT_TYPES)}",
    )
    axis = np.array(_vector(where, tag, "axis", "xyz", (1.0, 0.0, 0.0)))  # URDF default
    length = math.hypot(*axis)
    require(
        kind not in MOVING or length >= 1e-9,
        f'{where}: axis is zero; give a direction such as xyz="0 0 1"',
    )
    limit = None
    if (stated := tag.first("limit")) is not None:
        lower, upper = (
            _limit(f"{where}, limit {side}", stated.get(side, "0")) for side in ("lower", "upper")
        )
        limit = None if kind == "continuous" else (lower, upper)
    mimic, rpy = tag.first("mimic"), _vector(where, tag, "origin", "rpy")
    check_angles(f"{where}, origin rpy", rpy, "a URDF takes rad")
    origin = np.eye(4)
    origin[:3, :3] = rotation_from_rpy(rpy)
    origin[:3, 3] = _vector(where, tag, "origin", "xyz")
    return FileJoint(
        name,
        kind,
        parent=_end(where, tag, "parent", links),
        child=_end(where, tag, "child", links),
        origin=origin,
        axis=axis / length if length else axis,
        limit=limit,
        follows=None if mimic is None else mimic.get("joint"),
    )


def _end(where: str, joint: Tag, side: str, links: Collection[str]) -> str:
    end = joint.first(side)
    name = "" if end is None else end.get("link")
    require(bool(name), f'{where} has no {side} link; add <{side} link="…"/>')
    require(
        name in links,
        f"{where}: {side} link '{name}' is not there{did_you_mean(name, links)}; "
        "name an existing link or add it",
    )
    return name


def _vector(
    where: str, above: Tag, name: str, key: str, default: Vector = (0.0, 0.0, 0.0)
) -> Vector:
    tag = above.first(name)
    text = None if tag is None else tag.stated.get(key)
    if text is None:
        return default
    words, what = text.split(), f"{where}, {name} {key}"
    require(len(words) == 3, f"{what}: '{text}' is not three numbers; write e.g. {key}=\"0 0 1\"")
    x, y, z = (_number(what, word) for word in words)
    return x, y, z


def _limit(what: str, text: str) -> float:
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
