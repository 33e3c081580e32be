"""The calibrated arm as URDF: the user's file with corrected joint origins, or a new one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from elastocal.cell.arm_description import Robot
from elastocal.errors import InputError, option
from elastocal.export.exportable import ExportNumbers, nothing, numbers, origin_attributes
from elastocal.model.chain import Joint, LinkMass
from elastocal.model.urdf import Tree, check_urdf, urdf_bytes
from elastocal.model.xml_file import Tag, XmlText, comment, element
from elastocal.units import Array

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
    text = _UrdfText(tree)
    added = [comment(note)]
    for i, joint in enumerate(tree.serial_chain(base, flange)):
        if not nothing(correction := pieces.correction(i)):
            text.place(joint.name, joint.origin @ correction)
    added += _correct_flange(tree, text, pieces, flange)
    if frames.tool:
        for name, T in tool_frames(pieces).items():
            added += text.fixed(name, flange, name, T)
    if frames.base:
        added += _tracker_frame(tree, text, pieces, base)
    text.insert(text.end, "".join(f"  {line}\n" for line in added))
    return text.result()


class _UrdfText(XmlText):
    """The text of a checked URDF, whose joints can be placed anew."""

    def __init__(self, tree: Tree) -> None:
        super().__init__(tree.path, urdf_bytes(tree.path))
        self.tree = tree
        joints = self.tags[0].all("joint")
        self.joints: dict[str, Tag] = {tag.stated["name"].strip(): tag for tag in joints}

    def place(self, joint: str, T: Array) -> None:
        """Let a joint's frame be at T (4, 4) in its parent link's."""
        self.set_in(self.joints[joint], "origin", origin_attributes(T))

    def fixed(self, new: str, parent: str, child: str, T: Array) -> list[str]:
        """Lines of link `new` and the fixed joint parent → child, one of which is `new`.

        A frame of an earlier export is moved instead.
        """
        tree, name = self.tree, f"{new}_joint"
        old = tree.joints.get(name)
        if old is not None and (old.kind, old.parent, old.child) == ("fixed", parent, child):
            self.place(name, T)
            return []
        if old is not None or new in tree.links:
            what = f"joint '{name}'" if old is not None else f"link '{new}'"
            raise InputError(
                f"{tree.path}: {what} stands where export would add its own; rename it, "
                f"or leave the frame out ({option('frames', False)}, or no {option('base_frame')})"
            )
        return fixed_link(new, parent, child, T)


def _tracker_frame(tree: Tree, text: _UrdfText, pieces: ExportNumbers, base: str) -> list[str]:
    if base == TRACKER:
        raise InputError(
            f"{tree.path}: the cell's base is {TRACKER}, the tracker's frame of an earlier export; "
            "name the robot's own base link as [robot] base"
        )
    T = pieces.T_tracker_base @ np.linalg.inv(tree.placed(tree.root, base))
    if tree.root != TRACKER:
        return text.fixed(TRACKER, TRACKER, tree.root, T)
    below = next(joint for joint in tree.joints.values() if joint.parent == TRACKER)
    text.place(below.name, T @ below.origin)
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
    ends = element("parent", {"link": parent}), element("child", {"link": child})
    joint = {"name": f"{new}_joint", "type": "fixed"}
    return [
        element("link", {"name": new}),
        element("joint", joint, *ends, element("origin", origin_attributes(T))),
    ]


def _correct_flange(tree: Tree, text: _UrdfText, pieces: ExportNumbers, flange: str) -> list[str]:
    error = pieces.error(pieces.chain.n_joints - 1)
    if nothing(error):
        return []
    last = tree.parent_joint[flange]
    if last.kind == "fixed":
        text.place(last.name, last.origin @ error)
        return []
    # The flange is the link that the last joint moves: a link in between takes the correction.
    text.set_in(text.joints[last.name], "child", {"link": MOUNT})
    return text.fixed(MOUNT, MOUNT, flange, error)


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
    head = ['<?xml version="1.0" encoding="UTF-8"?>', comment(note)]
    return "\n".join([*head, *_nested("robot", {"name": chain.name}, lines)]) + "\n"


def _link(name: str, body: LinkMass | None) -> list[str]:
    if body is None:
        return [element("link", {"name": name})]
    return _nested("link", {"name": name}, _nested("inertial", {}, [
        element("origin", {"xyz": numbers(body.com), "rpy": "0 0 0"}),
        element("mass", {"value": repr(float(body.mass))}),
        element("inertia", dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")),
    ]))  # fmt: skip


def _joint(joint: Joint, parent: str, child: str) -> list[str]:
    bounded = math.isfinite(joint.lower) and math.isfinite(joint.upper)
    kind = joint.kind if bounded or joint.kind == "prismatic" else "continuous"
    lines = [
        element("parent", {"link": parent}),
        element("child", {"link": child}),
        element("origin", origin_attributes(joint.placement)),
        element("axis", {"xyz": numbers(joint.axis)}),
    ]
    if kind != "continuous":
        ends = {"lower": max(joint.lower, -NO_LIMIT), "upper": min(joint.upper, NO_LIMIT)}
        limit = {name: repr(float(end)) for name, end in ends.items()}
        lines.append(element("limit", limit | {"effort": "0", "velocity": "0"}))
    return _nested("joint", {"name": joint.name, "type": kind}, lines)


def _nested(tag: str, stated: dict[str, str], lines: Sequence[str]) -> list[str]:
    head, end = element(tag, stated, "|").split("|")
    return [head, *(f"  {line}" for line in lines), end]


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
