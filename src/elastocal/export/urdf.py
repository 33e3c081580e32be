"""The calibrated arm as URDF: the user's own file with corrected joint origins.

With O_i the origin of moving joint i, E_i the error of the link before it (6-D, at the link's
distal end) and J_i(a_i) the motion by the joint's offset a_i,

    O_i ← O_i E_i J_i(a_i)           and for the flange's own fixed joint      O_f ← O_f E_n.

So joint values stay what the controller commands: the encoder's zero has moved in the file, and
limits, mimics and calibration marks, which are stated in commanded values, stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

import numpy as np

from elastocal.cell import Robot
from elastocal.errors import InputError, option
from elastocal.export.pieces import Pieces
from elastocal.export.rigid_text import origin_attributes
from elastocal.export.urdf_edit import UrdfText, element, read_urdf_text
from elastocal.manipulator.chain import Array
from elastocal.manipulator.effects.placements import link_ends
from elastocal.manipulator.urdf_check import check_urdf
from elastocal.manipulator.urdf_tree import Tree, UrdfJoint

PREFIX = "elastocal_"
MOUNT, TRACKER, LOAD_POINT = f"{PREFIX}flange_mount", f"{PREFIX}tracker", f"{PREFIX}load_point"


@dataclass(frozen=True)
class Frames:
    """Which frames to add to the robot: markers and load point on the flange; the tracker's."""

    tool: bool = True
    base: bool = False


def calibrated_urdf(robot: Robot, pieces: Pieces, frames: Frames, note: str) -> str:
    """Text of the robot's URDF with the calibrated geometry; `note` becomes a comment in it.

    Only origins that change are touched.  Frames: elastocal_marker_NAME and elastocal_load_point
    as links on the flange, elastocal_tracker as the new root above the robot.  Raises InputError
    where the file has a link or joint of such a name that is none of these.
    """
    assert robot.urdf is not None
    tree = check_urdf(robot.urdf)
    base = tree.root if robot.base is None else robot.base
    flange = tree.last_link(base) if robot.flange is None else robot.flange
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


def _tracker_frame(tree: Tree, text: UrdfText, pieces: Pieces, base: str) -> list[str]:
    if base == TRACKER:
        raise InputError(
            f"{tree.path}: the cell's base is {TRACKER}, the tracker's frame of an earlier export; "
            "name the robot's own base link as [robot] base"
        )
    T = pieces.T_tracker_base @ np.linalg.inv(_placed(tree, tree.root, base))
    if tree.root != TRACKER:
        return _fixed(tree, text, TRACKER, TRACKER, tree.root, T)
    below = next(joint for joint in tree.joints.values() if joint.parent == TRACKER)
    text.set_origin(below.name, origin_attributes(T @ _origin(below)))
    return []


def tool_frames(pieces: Pieces) -> dict[str, Array]:
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


def fixed_joint(name: str, parent: str, child: str, T: Array) -> str:
    """A fixed joint as one line."""
    inside = [
        element("parent", {"link": parent}),
        element("child", {"link": child}),
        element("origin", origin_attributes(T)),
    ]
    return f'<joint name={quoteattr(name)} type="fixed">{"".join(inside)}</joint>'


def comment(text: str) -> str:
    """`text` as it may stand in an XML comment, where two hyphens end it."""
    return text.replace("--", "- -").rstrip("-")


def _correct_joints(
    tree: Tree, text: UrdfText, pieces: Pieces, moving: tuple[UrdfJoint, ...]
) -> None:
    for i, joint in enumerate(moving):
        correction = pieces.offset_motion(i)
        if i > 0:
            correction = _error_of_link(pieces, i - 1) @ correction
        if not _nothing(correction):
            text.set_origin(joint.name, origin_attributes(_origin(joint) @ correction))


def _correct_flange(
    tree: Tree, text: UrdfText, pieces: Pieces, base: str, flange: str
) -> list[str]:
    error = _error_of_link(pieces, pieces.chain.n_joints - 1)
    if _nothing(error):
        return []
    last = tree.parent_joint[flange]
    if last.kind == "fixed":
        text.set_origin(last.name, origin_attributes(_origin(last) @ error))
        return []
    # The flange is the link that the last joint moves: a link in between takes the correction.
    text.set_child(last.name, MOUNT)
    return _fixed(tree, text, MOUNT, MOUNT, flange, error)


def _error_of_link(pieces: Pieces, i: int) -> Array:
    """E (4, 4) of link i (0-based): calibrated = nominal distal frame · E."""
    nominal = link_ends(pieces.chain)[i]
    if np.array_equal(nominal, pieces.links[i]):
        return np.eye(4)
    return np.asarray(np.linalg.solve(nominal, pieces.links[i]))


def _nothing(T: Array) -> bool:
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
    return [element("link", {"name": new}), fixed_joint(name, parent, child, T)]


def _origin(joint: UrdfJoint) -> Array:
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", joint.rpy).as_matrix()
    T[:3, 3] = joint.xyz
    return T


def _placed(tree: Tree, root: str, link: str) -> Array:
    """T_root_link (4, 4) with every joint between them at zero."""
    T = np.eye(4)
    for joint in tree.joints_between(root, link) or ():
        T = T @ _origin(joint)
    return T
