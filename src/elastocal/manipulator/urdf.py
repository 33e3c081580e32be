"""URDF → nominal chain.  Pinocchio reads the kinematics; urdf_check says what is wrong before.

Everything off the path from base to flange is held still: those joints become fixed at their
neutral position, so that pinocchio merges their bodies into the joint on the path that carries
them.  With X_i pinocchio's placement of joint i in its parent joint, the chain is

    T_base_flange(q) = (T_p0_base)⁻¹ X_1 J_1(q_1) X_2 J_2(q_2) … X_n J_n(q_n) T_n_flange

where p0 is the (immobile) joint frame that carries the base link.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from elastocal.errors import InputError
from elastocal.manipulator.chain import Array, Chain, Joint, LinkMass
from elastocal.manipulator.urdf_check import check_urdf
from elastocal.manipulator.urdf_tree import Tree, UrdfJoint


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
        joints.append(_joint(source, placement, model, i))
    masses = tuple(
        LinkMass(float(inertia.mass), np.array(inertia.lever)) for inertia in model.inertias[1:]
    )
    return Chain(
        name=tree.name,
        joints=tuple(joints),
        flange_placement=_link_placement(model, flange).homogeneous,
        masses=masses if any(body.mass > 0 for body in masses) else (),
    )


def _joint(source: UrdfJoint, placement: Array, model: Any, index: int) -> Joint:
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
