"""URDF file → checked records: whatever is wrong with the XML is said here, by name.

Only what kinematics and weights need is kept (links with mass and centre of mass, joints with
parent, child, origin, axis and limits); meshes, materials, plugins and transmissions are ignored.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from pathlib import Path

from elastocal.errors import InputError
from elastocal.manipulator.urdf_tree import MOVING, Link, Tree, UrdfJoint, Vector
from elastocal.text import did_you_mean

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
