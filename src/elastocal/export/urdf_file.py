"""The calibrated arm as URDF: the user's file with corrected joint origins, or a new one."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np

from elastocal.cell.arm_description import Robot
from elastocal.errors import InputError, option
from elastocal.export.exportable import ExportNumbers, numbers, origin_attributes
from elastocal.model.chain import Joint, LinkMass
from elastocal.model.effects.placements import link_ends
from elastocal.model.urdf import Tree, UrdfJoint, as_utf8, check_urdf, urdf_bytes
from elastocal.units import Array

# Edits of a URDF's text that leave everything else as it was, to the byte.
#
# An XML library would write the whole file anew: other quotes, no comments before the root, other
# white space.  Here a parser only says where the start tags stand; the text between is not touched.

TAG = re.compile(rb"""(?:[^"'>]|"[^"]*"|'[^']*')*>""")


@dataclass
class XmlText:
    """The text of an XML file and the edits to make; offsets count bytes of `data` in UTF-8."""

    data: bytes
    edits: list[tuple[int, int, bytes]] = field(default_factory=list, kw_only=True)
    tags: dict[int, dict[str, str | None]] = field(default_factory=dict, kw_only=True)

    def insert(self, at: int, text: str) -> None:
        """Put text at an offset, behind what was put there before."""
        self.edits.append((at, at, text.encode("utf-8")))

    def result(self) -> str:
        """The text with all edits made."""
        parts, last = [], 0
        changed = [self._changed(start, given) for start, given in self.tags.items()]
        for start, end, new in sorted([*self.edits, *changed], key=lambda edit: edit[:2]):
            parts += [self.data[last:start], new]
            last = end
        return b"".join([*parts, self.data[last:]]).decode("utf-8")

    def set_attributes(
        self, start: int, attributes: Mapping[str, str], without: Collection[str] = ()
    ) -> None:
        """Set attributes of the start tag at an offset, and take out those named `without`."""
        self.tags.setdefault(start, {}).update(dict.fromkeys(without) | dict(attributes))

    def _changed(self, start: int, given: Mapping[str, str | None]) -> tuple[int, int, bytes]:
        end = tag_end(self.data, start)
        tag = self.data[start:end].decode("utf-8")
        for name, value in given.items():
            pattern = re.compile(rf"""(\s{name}\s*=\s*)("[^"]*"|'[^']*')""")
            found = pattern.search(tag)
            if value is None:
                tag = pattern.sub("", tag)
            elif found is not None:
                tag = tag[: found.start(2)] + quoteattr(value) + tag[found.end(2) :]
            else:
                body = tag[:-1].rstrip().removesuffix("/").rstrip()
                closing = "/>" if tag.endswith("/>") else ">"
                tag = f"{body} {name}={quoteattr(value)}{closing}"
        return start, end, tag.encode("utf-8")


@dataclass
class UrdfText(XmlText):
    """The text of a URDF.

    `joints`: joint → the offset of its start tag ("joint"), and of the first of each tag in it.
    """

    joints: dict[str, dict[str, int]]
    end: int  # of the robot's content: where its end tag starts

    def set_origin(self, joint: str, attributes: Mapping[str, str]) -> None:
        """Replace xyz and rpy of a joint's <origin>, or give it one."""
        tags = self.joints[joint]
        if "origin" in tags:
            self.set_attributes(tags["origin"], attributes)
            return
        self.insert(tag_end(self.data, tags["joint"]), element("origin", attributes))

    def set_child(self, joint: str, link: str) -> None:
        """Let a joint carry another link."""
        self.set_attributes(self.joints[joint]["child"], {"link": link})

    def append(self, text: str) -> None:
        """Add elements at the end of the robot."""
        self.insert(self.end, text)


def element(tag: str, attributes: Mapping[str, str]) -> str:
    """An empty element as text."""
    return f"<{tag}{''.join(f' {k}={quoteattr(v)}' for k, v in attributes.items())}/>"


def read_urdf_text(path: Path) -> UrdfText:
    """The URDF at `path` (already checked by urdf_check) with its joints located.

    A file in another encoding is taken over as UTF-8, its declaration with it.
    Raises InputError where it cannot be decoded.
    """
    data = as_utf8(path, urdf_bytes(path))
    found = UrdfText(data, {}, len(data))
    parser = expat.ParserCreate()
    stack: list[str] = []
    tags: dict[str, int] = {}

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal tags
        local, at = tag.rpartition(":")[2], parser.CurrentByteIndex
        stack.append(local)
        if len(stack) == 2 and local == "joint":
            tags = found.joints[attributes["name"].strip()] = {"joint": at}
        elif len(stack) == 3 and stack[1] == "joint":
            tags.setdefault(local, at)

    def end(tag: str) -> None:
        stack.pop()
        if not stack:
            found.end = parser.CurrentByteIndex

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(data, True)
    return found


def tag_end(data: bytes, start: int) -> int:
    """Offset just after the `>` that closes the tag at `start`; one in quotes does not."""
    tag = TAG.match(data, start)
    assert tag, "a parsed tag ends"
    return tag.end()


# The calibrated arm as URDF: the user's own file with corrected joint origins.
#
# With O_i the origin of moving joint i, E_i the error of the link before it (6-D, at the link's
# distal end) and J_i(a_i) the motion by the joint's offset a_i,
#
#     O_i ← O_i E_i J_i(a_i)           and for the flange's own fixed joint      O_f ← O_f E_n.
#
# So joint values stay what the controller commands: the encoder's zero has moved in the file, and
# limits, mimics and calibration marks, which are stated in commanded values, stay as they are.

PREFIX = "elastocal_"
MOUNT, TRACKER, LOAD_POINT = f"{PREFIX}flange_mount", f"{PREFIX}tracker", f"{PREFIX}load_point"


@dataclass(frozen=True)
class Frames:
    """Which frames to add to the robot: markers and load point on the flange; the tracker's."""

    tool: bool = True
    base: bool = False


def calibrated_urdf(robot: Robot, pieces: ExportNumbers, frames: Frames, note: str) -> str:
    """Text of the robot's URDF with the calibrated geometry; `note` becomes a comment in it.

    Only origins that change are touched.  Frames: elastocal_marker_NAME and elastocal_load_point
    as links on the flange, elastocal_tracker as the new root above the robot.  Raises InputError
    where the file has a link or joint of such a name that is none of these.
    """
    assert robot.urdf is not None
    tree = check_urdf(robot.urdf)
    base = tree.root if robot.base is None else robot.base
    flange = tree.only_flange(base) if robot.flange is None else robot.flange
    text = read_urdf_text(robot.urdf)
    added = [f"<!-- {comment(note)} -->"]
    _correct_joints(tree, text, pieces, tree.serial_chain(base, flange))
    added += _correct_flange(tree, text, pieces, base, flange)
    if frames.tool:
        for name, T in tool_frames(pieces).items():
            added += _fixed(tree, text, name, flange, name, T)
    if frames.base:
        added += _tracker_frame(tree, text, pieces, base)
    text.append("".join(f"  {line}\n" for line in added))
    return text.result()


def _tracker_frame(tree: Tree, text: UrdfText, pieces: ExportNumbers, base: str) -> list[str]:
    if base == TRACKER:
        raise InputError(
            f"{tree.path}: the cell's base is {TRACKER}, the tracker's frame of an earlier export; "
            "name the robot's own base link as [robot] base"
        )
    T = pieces.T_tracker_base @ np.linalg.inv(tree.placed(tree.root, base))
    if tree.root != TRACKER:
        return _fixed(tree, text, TRACKER, TRACKER, tree.root, T)
    below = next(joint for joint in tree.joints.values() if joint.parent == TRACKER)
    text.set_origin(below.name, origin_attributes(T @ below.origin))
    return []


def tool_frames(pieces: ExportNumbers) -> dict[str, Array]:
    """Link name → placement (4, 4) in the flange frame of every marker and of the load point."""
    frames: dict[str, Array] = {}
    for marker, T in pieces.markers.items():
        name = f"{PREFIX}marker_{'_'.join(marker.split())}"
        while name in frames:  # "A B" beside "A_B"
            name += "_"
        frames[name] = T
    load = np.eye(4)
    load[:3, 3] = pieces.load_point
    return frames | {LOAD_POINT: load}


def fixed_link(new: str, parent: str, child: str, T: Array) -> list[str]:
    """Lines of link `new` and the fixed joint parent → child, one of which is `new`."""
    inside = [
        element("parent", {"link": parent}),
        element("child", {"link": child}),
        element("origin", origin_attributes(T)),
    ]
    head = f'<joint name={quoteattr(f"{new}_joint")} type="fixed">'
    return [element("link", {"name": new}), f"{head}{''.join(inside)}</joint>"]


def comment(text: str) -> str:
    """`text` as it may stand in an XML comment, where two hyphens end it."""
    return text.replace("--", "- -").rstrip("-")


def _correct_joints(
    tree: Tree, text: UrdfText, pieces: ExportNumbers, moving: tuple[UrdfJoint, ...]
) -> None:
    for i, joint in enumerate(moving):
        if not nothing(correction := correction_of_joint(pieces, i)):
            text.set_origin(joint.name, origin_attributes(joint.origin @ correction))


def _correct_flange(
    tree: Tree, text: UrdfText, pieces: ExportNumbers, base: str, flange: str
) -> list[str]:
    error = error_of_link(pieces, pieces.chain.n_joints - 1)
    if nothing(error):
        return []
    last = tree.parent_joint[flange]
    if last.kind == "fixed":
        text.set_origin(last.name, origin_attributes(last.origin @ error))
        return []
    # The flange is the link that the last joint moves: a link in between takes the correction.
    text.set_child(last.name, MOUNT)
    return _fixed(tree, text, MOUNT, MOUNT, flange, error)


def correction_of_joint(pieces: ExportNumbers, i: int) -> Array:
    """E_{i−1} J_i(a_i) (4, 4) of joint i (0-based)."""
    offset = pieces.offset_motion(i)
    return offset if i == 0 else error_of_link(pieces, i - 1) @ offset


def error_of_link(pieces: ExportNumbers, i: int) -> Array:
    """E (4, 4) of link i (0-based): calibrated = nominal distal frame · E."""
    nominal = link_ends(pieces.chain)[i]
    if np.array_equal(nominal, pieces.links[i]):
        return np.eye(4)
    return np.asarray(np.linalg.solve(nominal, pieces.links[i]))


def nothing(T: Array) -> bool:
    return bool(np.max(np.abs(T - np.eye(4))) < 4 * np.finfo(float).eps)


def _fixed(tree: Tree, text: UrdfText, new: str, parent: str, child: str, T: Array) -> list[str]:
    """The lines of link `new` and the fixed joint parent → child, one of which is `new`.

    A frame of an earlier export is moved instead.
    """
    name = f"{new}_joint"
    old = tree.joints.get(name)
    if old is not None and (old.kind, old.parent, old.child) == ("fixed", parent, child):
        text.set_origin(name, origin_attributes(T))
        return []
    if old is not None or new in tree.links:
        what = f"joint '{name}'" if old is not None else f"link '{new}'"
        raise InputError(
            f"{tree.path}: {what} stands where export would add its own; rename it, "
            f"or leave the frame out ({option('frames', False)}, or no {option('base_frame')})"
        )
    return fixed_link(new, parent, child, T)


# A URDF for an arm that has none: a robot described by a DH table.

BASE, FLANGE = "base_link", "flange"
NO_LIMIT = 1e6  # m; a URDF's slide must have limits


def new_urdf(pieces: ExportNumbers, frames: Frames, note: str) -> str:
    """URDF text of links base_link, link_1 … link_n, flange with the calibrated placements.

    Joints bear the table's names and limits (continuous where one has none); masses stand with a
    zero inertia tensor, of which the table says nothing.
    """
    chain = pieces.calibrated_chain()
    lines = []
    if frames.base:
        lines += fixed_link(TRACKER, TRACKER, BASE, pieces.T_tracker_base)
    lines += [element("link", {"name": BASE})]
    parent = BASE
    for i, joint in enumerate(chain.joints, start=1):
        lines += _link(f"link_{i}", chain.masses[i - 1] if chain.masses else None)
        lines += _joint(joint, parent, f"link_{i}")
        parent = f"link_{i}"
    lines += fixed_link(FLANGE, parent, FLANGE, chain.flange_placement)
    if frames.tool:
        for name, T in tool_frames(pieces).items():
            lines += fixed_link(name, FLANGE, name, T)
    head = ['<?xml version="1.0" encoding="UTF-8"?>', f"<!-- {comment(note)} -->"]
    body = [f"  {line}" for line in lines]
    return "\n".join([*head, f"<robot name={quoteattr(chain.name)}>", *body, "</robot>"]) + "\n"


def _link(name: str, body: LinkMass | None) -> list[str]:
    if body is None:
        return [element("link", {"name": name})]
    inertia = dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")
    return [
        f"<link name={quoteattr(name)}>",
        "  <inertial>",
        f"    {element('origin', {'xyz': numbers(body.com), 'rpy': '0 0 0'})}",
        f"    {element('mass', {'value': repr(float(body.mass))})}",
        f"    {element('inertia', inertia)}",
        "  </inertial>",
        "</link>",
    ]


def _joint(joint: Joint, parent: str, child: str) -> list[str]:
    bounded = math.isfinite(joint.lower) and math.isfinite(joint.upper)
    kind = joint.kind if bounded or joint.kind == "prismatic" else "continuous"
    lines = [
        f"<joint name={quoteattr(joint.name)} type={quoteattr(kind)}>",
        f"  {element('parent', {'link': parent})}",
        f"  {element('child', {'link': child})}",
        f"  {element('origin', origin_attributes(joint.placement))}",
        f"  {element('axis', {'xyz': numbers(joint.axis)})}",
    ]
    if kind != "continuous":
        ends = {"lower": max(joint.lower, -NO_LIMIT), "upper": min(joint.upper, NO_LIMIT)}
        limit = {name: repr(float(end)) for name, end in ends.items()}
        lines += [f"  {element('limit', limit | {'effort': '0', 'velocity': '0'})}"]
    return [*lines, "</joint>"]


# The written file as others read it: pinocchio's own reader on all of the text, not elastocal's.


def urdf_flanges(text: str, joints: Sequence[str], base: str, flange: str, q: Array) -> Array:
    """T_base_flange (n, 4, 4) at q (n, joints) of a URDF in pinocchio; other joints are neutral.

    Raises ValueError or RuntimeError where pinocchio refuses it.
    """
    import pinocchio as pin

    model = pin.buildModelFromXML(text.encode("utf-8").decode("utf-8-sig"))
    data, found = model.createData(), []
    ends = [model.getFrameId(name, pin.FrameType.BODY) for name in (base, flange)]
    numbers = [model.getJointId(name) for name in joints]
    for row in q:
        position = pin.neutral(model)
        for number, value in zip(numbers, row, strict=True):
            at = model.joints[number].idx_q
            turns = model.joints[number].nq == 2  # without limits: (cos q, sin q)
            position[at : at + 1 + turns] = [np.cos(value), np.sin(value)] if turns else [value]
        pin.framesForwardKinematics(model, data, position)
        start, end = (data.oMf[frame].homogeneous for frame in ends)
        found.append(np.linalg.solve(start, end))
    return np.array(found)
