"""The calibrated arm as URDF or MJCF: the user's own file with the corrections in it, or a new one;
of an MJCF the rest under load is the model's static equilibrium."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from elastocal.cell_tables import Robot
from elastocal.export.exportable import ExportNumbers
from elastocal.messages import ElastocalError, InputError, listed, option, require
from elastocal.model import mjcf
from elastocal.model.chain import Chain, Joint, LinkMass
from elastocal.model.effects.base import Spring, transverse_axes
from elastocal.model.effects.statics import STANDARD_GRAVITY
from elastocal.model.mjcf import AXES, SPRING, SPRING_OF_NEW, MjcfArm, import_mujoco, transform
from elastocal.model.urdf import TRACKER, Tag, XmlFile, comment, element, tree_of, urdf_file
from elastocal.units import Array, pose_at, rpy_from_rotation


def numbers(values: ArrayLike) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(values, dtype=float))


def placed_body(name: str | None, T: Array) -> dict[str, str]:
    """Attributes of a body or site at T (4, 4) in its parent's frame."""
    turned = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
    called = {} if name is None else {"name": name}
    return called | {"pos": numbers(T[:3, 3]), "quat": numbers(turned)}


def origin_attributes(T: Array) -> dict[str, str]:
    return {"xyz": numbers(T[:3, 3]), "rpy": numbers(rpy_from_rotation(T[:3, :3]))}


def nothing(T: Array) -> bool:
    """Whether T (4, 4) differs from the identity by rounding alone."""
    return bool(np.max(np.abs(T - np.eye(4))) < 4 * np.finfo(float).eps)


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
MOUNT, LOAD_POINT = f"{PREFIX}flange_mount", f"{PREFIX}load_point"


def calibrated_urdf(
    robot: Robot, pieces: ExportNumbers, tool: bool, base_frame: bool, note: str
) -> str:
    """Only origins that change are touched; `note` becomes a comment.  `tool` adds
    elastocal_marker_NAME and elastocal_load_point as links on the flange, `base_frame`
    elastocal_tracker as the new root."""
    assert robot.urdf is not None
    file = urdf_file(robot.urdf)
    tree, tags = tree_of(file), {tag.get("name").strip(): tag for tag in file.root.all("joint")}
    base, flange = tree.ends(robot.base, robot.flange, choose=False)
    lines = [comment(note)]

    def place(joint: str, T: Array) -> None:
        file.set_in(tags[joint], "origin", origin_attributes(T))

    def add(new: str, parent: str, child: str, T: Array) -> None:
        """Link `new` and the fixed joint parent → child, one of which is `new`; a frame of an
        earlier export is moved instead."""
        name = f"{new}_joint"
        old = next((joint for joint in tree.joints if joint.name == name), None)
        if old is not None and (old.kind, old.parent, old.child) == ("fixed", parent, child):
            return place(name, T)
        what = f"joint '{name}'" if old is not None else f"link '{new}'"
        require(
            old is None and new not in tree.links,
            f"{tree.path}: {what} stands where export would add its own; rename it, or leave the "
            f"frame out ({option('frames', False)}, or no {option('base_frame')})",
        )
        lines.extend(map(as_text, fixed_link(new, parent, child, T)))

    for i, joint in enumerate(tree.serial_chain(base, flange)):
        if not nothing(correction := pieces.correction(i)):
            place(joint.name, joint.origin @ correction)
    last, error = tree.parent_joint[flange], pieces.error(pieces.chain.n_joints - 1)
    if not nothing(error) and last.kind == "fixed":
        place(last.name, last.origin @ error)
    elif not nothing(error):
        # The flange is the link that the last joint moves: a link in between takes the correction.
        file.set_in(tags[last.name], "child", {"link": MOUNT})
        add(MOUNT, MOUNT, flange, error)
    for name, T in tool_frames(pieces).items() if tool else ():
        add(name, flange, name, T)
    if base_frame:
        require(
            base != TRACKER,
            f"{tree.path}: the cell's base is {TRACKER}, the tracker's frame of an earlier "
            "export; name the robot's own base link as [robot] base",
        )
        T = pieces.T_tracker_base @ np.linalg.inv(tree.placed(base))
        if tree.root != TRACKER:
            add(TRACKER, TRACKER, tree.root, T)
        else:
            below = next(joint for joint in tree.joints if joint.parent == TRACKER)
            place(below.name, T @ below.origin)
    file.insert(file.end, "".join(f"  {line}\n" for line in lines))
    return file.result()


def tool_frames(pieces: ExportNumbers) -> dict[str, Array]:
    frames: dict[str, Array] = {}
    for marker, T in pieces.markers.items():
        name = f"{PREFIX}marker_{'_'.join(marker.split())}"
        while name in frames:  # "A B" beside "A_B"
            name += "_"
        frames[name] = T
    return frames | {LOAD_POINT: pose_at(pieces.load_point)}


def fixed_link(new: str, parent: str, child: str, T: Array) -> tuple[ET.Element, ET.Element]:
    return ET.Element("link", name=new), _joint(f"{new}_joint", "fixed", parent, child, T)


def _joint(name: str, kind: str, parent: str, child: str, T: Array) -> ET.Element:
    joint = ET.Element("joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", origin_attributes(T))
    return joint


def as_text(made: ET.Element) -> str:
    return ET.tostring(made, "unicode").replace(" />", "/>")  # a > in quotes is written as &gt;


NEW_ENDS = NEW_BASE, NEW_FLANGE = "base_link", "flange"
NO_LIMIT = 1e6  # m; a URDF's slide must have limits


def new_urdf(pieces: ExportNumbers, tool: bool, base_frame: bool, note: str) -> str:
    """Links base_link, link_1 … link_n, flange with the calibrated placements.  Joints bear the
    table's names and limits (continuous where one has none); masses that are known stand with a
    zero inertia tensor."""
    chain, root = pieces.calibrated_chain(), ET.Element("robot", name=pieces.chain.name)
    # Masses of the robot's description where no weights act in the model.
    masses = pieces.masses or pieces.chain.masses
    if base_frame:
        root.extend(fixed_link(TRACKER, TRACKER, NEW_BASE, pieces.T_tracker_base))
    ET.SubElement(root, "link", name=NEW_BASE)
    parent = NEW_BASE
    for i, joint in enumerate(chain.joints, start=1):
        link = ET.SubElement(root, "link", name=f"link_{i}")
        for body in masses[i - 1 : i]:
            inertial, keys = ET.SubElement(link, "inertial"), "ixx ixy ixz iyy iyz izz"
            ET.SubElement(inertial, "origin", xyz=numbers(body.com), rpy="0 0 0")
            ET.SubElement(inertial, "mass", value=repr(float(body.mass)))
            ET.SubElement(inertial, "inertia", dict.fromkeys(keys.split(), "0"))
        bounded = math.isfinite(joint.lower) and math.isfinite(joint.upper)
        kind = joint.kind if bounded or joint.kind == "prismatic" else "continuous"
        moving = _joint(joint.name, kind, parent, link.get("name", ""), joint.placement)
        ET.SubElement(moving, "axis", xyz=numbers(joint.axis))
        if kind != "continuous":
            lower, upper = max(joint.lower, -NO_LIMIT), min(joint.upper, NO_LIMIT)
            ends = {"lower": repr(float(lower)), "upper": repr(float(upper))}
            ET.SubElement(moving, "limit", ends, effort="0", velocity="0")
        root.append(moving)
        parent = f"link_{i}"
    root.extend(fixed_link(NEW_FLANGE, parent, NEW_FLANGE, chain.flange_placement))
    for name, T in tool_frames(pieces).items() if tool else ():
        root.extend(fixed_link(name, NEW_FLANGE, name, T))
    ET.indent(root)
    head = f'<?xml version="1.0" encoding="UTF-8"?>\n{comment(note)}\n'
    return f"{head}{as_text(root)}\n"


# Files that MuJoCo looks for beside the main file, whatever directories the compiler states.
BESIDE = ("include", "model")


def moved(path: Path, text: str, folder: Path) -> tuple[str, list[str]]:
    """The `text` of a file that lies at `path`, to be written into another `folder`, from where its
    meshes are to be found, and what to know.  A file without names of others, or that stays where
    it was, is as before to the byte."""
    xml = XmlFile(path, text.encode("utf-8"), "a file")
    named = [tag for tag in xml.tags if any(_is_file(tag, key) for key in tag.stated)]
    if not named:
        return text, []
    home, there = path.parent.resolve(), folder.resolve()
    if there != home:
        if any(tag.name in BESIDE for tag in named):
            return text, [f"copy it beside {path.name}: the files that it includes are there"]
        if xml.root.name == "mujoco":
            stated = mjcf.parsed(path).compiler
            places = {key: _from(there, home / (getattr(stated, key) or ""))
                      for key in ("meshdir", "texturedir")}  # fmt: skip
            if compilers := [tag for tag in xml.tags if tag.name == "compiler"]:
                xml.set(compilers[-1], places)
            else:
                xml.insert_in(xml.root, f"\n  {element('compiler', places)}")
        for tag in (tag for tag in named if "filename" in tag.stated):
            place = home / tag.stated["filename"]
            if place.is_file():  # others are found in packages
                xml.set(tag, {"filename": _from(there, place)})
    told = "meshes and other files are named relative to the file: to have it elsewhere, export it"
    return xml.result(), [f"{told} there"]


def _is_file(tag: Tag, key: str) -> bool:
    name = tag.stated[key]
    if key == "filename":  # of a URDF
        relative = "://" not in name and not Path(name).is_absolute()
        return tag.name in ("mesh", "texture") and relative
    return key.startswith("file") and bool(name)


def _from(folder: Path, place: Path) -> str:
    try:
        return Path(os.path.relpath(place, folder)).as_posix()
    except ValueError:  # on another drive
        return place.as_posix()


def urdf_flanges(text: str, joints: Sequence[str], base: str, flange: str, q: Array) -> Array:
    """T_base_flange (n, 4, 4) at q (n, joints) in pinocchio, which raises ValueError or
    RuntimeError where it refuses the file; other joints are neutral."""
    import pinocchio as pin

    model = pin.buildModelFromXML(text.encode("utf-8").decode("utf-8-sig"))
    data, found = model.createData(), []
    ends = [model.getFrameId(name, pin.FrameType.BODY) for name in (base, flange)]
    numbers = [model.getJointId(name) for name in joints]
    for row in q:
        motion = np.zeros(model.nv)  # a position is (cos q, sin q) where there are no limits
        motion[[model.joints[number].idx_v for number in numbers]] = row
        pin.framesForwardKinematics(model, data, pin.integrate(model, pin.neutral(model), motion))
        start, end = (data.oMf[frame].homogeneous for frame in ends)
        found.append(np.linalg.solve(start, end))
    return np.array(found)


# A new MJCF.
#
# Each joint is a hinge or slide that a position actuator drives: its control is the commanded
# joint value, its gain kp = 1/k the identified stiffness, so that at rest q − q_commanded = k τ.
# Springs that no motor holds (bearings across the axis, links, pedestal) are passive joints of
# stiffness 1/k in series, where the model has them, and so is a drive's with such bearings.
# Geometry, masses, load point and the spring of a gravity compensator are those of the model.

# A drive without identified compliance: 5 kN m turn it by 5e-9 rad, 15 nm at 3 m.
RIGID = 1e12  # N m/rad or N/m
# Damping over stiffness, s.  It only settles the motion: nothing of the rest depends on it, and
# an implicit integrator keeps even the rigid drives stable with it.
SETTLING = 0.02
# Keeps the mass matrix regular where links weigh nothing, and the accelerations of a stiff drive
# after a step of its command below the 1e10 rad/s² beyond which MuJoCo gives up.
ARMATURE, ARMATURE_PER_STIFFNESS = 0.1, 1e-8  # kg m² (kg), s²
MOTIONS = {"revolute": "hinge", "prismatic": "slide"}
# A moving body needs some mass and inertia in MuJoCo; these weigh 1e-13 N.
NO_MASS, NO_INERTIA = 1e-14, 1e-12
SHORTEST = 1e-3  # m; a shorter link is not drawn
IDENTITY, NOTHING = np.eye(4), LinkMass(0.0, np.zeros(3))


def link_inertias(path: Path, chain: Chain) -> tuple[Array, ...]:
    """(3, 3) kg m² per joint about the centre of mass of all that it carries, in its frame's axes,
    joints beside the chain at zero; empty where pinocchio reads no inertia in the file."""
    import pinocchio as pin

    file, moving = urdf_file(path), {joint.name for joint in chain.joints}
    for joint in file.root.all("joint"):
        if joint.get("name").strip() not in moving:
            file.set(joint, {"type": "fixed"})
    try:
        model = pin.buildModelFromXML(file.result().removeprefix("\ufeff"))
    except (ValueError, RuntimeError):
        return ()
    tensors = [np.array(inertia.inertia) for inertia in model.inertias[1:]]
    return tuple(tensors) if len(tensors) == chain.n_joints else ()


def calibrated_mjcf(robot: Robot, pieces: ExportNumbers, base_frame: bool, note: str) -> str:
    """Joints and their actuators (control: commanded rad or m) are called as in the robot's file;
    actuators load_x, load_y, load_z (control: N at the load point, axes of the tracker).  Sites:
    flange, load_point, marker_NAME.  The world is the robot's base, or with `base_frame` the
    tracker's frame."""
    chain, inertias = pieces.chain, tuple[Array, ...]()
    if pieces.masses and robot.urdf is not None:
        inertias = link_inertias(robot.urdf, chain)
    root = ET.Element("mujoco", model=chain.name)
    root.append(ET.Comment(f" {note.replace('--', '- -')} "))
    ET.SubElement(root, "compiler", angle="radian", balanceinertia="true", autolimits="false")
    R = np.eye(3) if base_frame else pieces.T_tracker_base[:3, :3].T
    ET.SubElement(
        root, "option", gravity=numbers(R @ [0.0, 0.0, -STANDARD_GRAVITY]),
        integrator="implicitfast",
    )  # fmt: skip
    world = ET.SubElement(root, "worldbody")
    ET.SubElement(world, "site", placed_body(AXES, pose_at(np.zeros(3), R)))
    actuators = ET.Element("actuator")
    body = _body(world, "base", pieces.T_tracker_base if base_frame else np.eye(4))
    _passive(body, pieces.springs_at("base"))
    names = [joint.name for joint in chain.joints]
    taken = any(re.match("spring_|load_[xyz]$", name) for name in names)
    if taken or len(set(names)) < len(names):  # those that stand for others
        names = [f"joint{i}" for i in range(1, chain.n_joints + 1)]
    before: dict[Spring, float] = {}
    for i, (joint, name) in enumerate(zip(chain.joints, names, strict=True)):
        offset, T = pieces.offset_motion(i), pieces.placement(i)
        if before:  # on a body of their own: MuJoCo takes six joints at most in one
            body, T = _body(body, f"link{i}_end", T), np.eye(4)
            _passive(body, before)
        named = f"joint{i + 1}.compensator_"
        compensated = {
            n.removeprefix(named): v for n, v in pieces.compensator.items() if named in n
        }
        if compensated:
            _compensate(root, body, T, joint.axis, compensated)
        mass = pieces.masses[i] if pieces.masses else NOTHING
        body = _body(body, f"link{i + 1}", T @ offset, mass, inertias[i] if inertias else None)
        # Springs across the axis stand between the joint's own and its motion: turns about
        # different axes do not commute, and so that one is a passive joint too, with a rigid drive.
        springs = pieces.springs_at(f"joint{i + 1}")
        own = all(s.axis == tuple(joint.axis) and s.kind == joint.kind for s in springs)
        # Their axes stand before the body was turned by the joint's offset.
        _passive(body, {} if own else springs, np.asarray(np.linalg.inv(offset)))
        _motor(body, actuators, joint, name, sum(springs.values()) if own else 0.0)
        if compensated:
            # The offset turns the frame about the axis before the joint moves, and the model's
            # angle counts it; so the arm's end stands at angle zero of the joint's own frame.
            arm = compensated["arm"] * transverse_axes(joint.axis)[0]
            ET.SubElement(body, "site", name="compensator_arm", pos=numbers(arm))
        before = pieces.springs_at(f"link{i + 1}")
        end = pieces.links[i][:3, 3]
        if np.linalg.norm(end) >= SHORTEST:  # to be seen only: it weighs and touches nothing
            ET.SubElement(
                body, "geom", type="capsule", fromto=numbers([0, 0, 0, *end]), size="0.02",
                mass="0", contype="0", conaffinity="0", group="2",
            )  # fmt: skip
    flange = _body(body, "flange", pieces.links[-1])
    _passive(flange, before)
    _tool(flange, actuators, pieces)
    root.append(actuators)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _tool(flange: ET.Element, actuators: ET.Element, pieces: ExportNumbers) -> None:
    placed = {"flange": np.eye(4), "load_point": pose_at(pieces.load_point)}
    placed |= {f"marker_{name}": T for name, T in pieces.markers.items()}
    for name, T in placed.items():
        ET.SubElement(flange, "site", placed_body(name, T))
    # Forces along the tracker's axes, which keep their direction while the arm moves.
    for axis, unit in zip("xyz", np.eye(3, 6), strict=True):
        ET.SubElement(
            actuators, "motor", name=f"load_{axis}", site="load_point", refsite=AXES,
            gear=numbers(pieces.load_scale * unit),
        )  # fmt: skip


def _body(
    parent: ET.Element, name: str, T: Array, mass: LinkMass = NOTHING,
    inertia: Array | None = None,
) -> ET.Element:  # fmt: skip
    body = ET.SubElement(parent, "body", placed_body(name, T))
    inertial = {"pos": numbers(mass.com), "mass": repr(max(float(mass.mass), NO_MASS))}
    if inertia is not None and min(np.diag(inertia)) > NO_INERTIA:
        entries = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
        inertial["fullinertia"] = numbers(entries)
    else:
        inertial["diaginertia"] = numbers([NO_INERTIA] * 3)
    ET.SubElement(body, "inertial", inertial)
    return body


def _passive(body: ET.Element, springs: dict[Spring, float], frame: Array = IDENTITY) -> None:
    for spring, compliance in springs.items():
        ET.SubElement(body, "joint", spring_joint(SPRING_OF_NEW, spring, compliance, frame))


def spring_joint(prefix: str, spring: Spring, compliance: float, F: Array) -> dict[str, str]:
    """The passive joint of a spring whose frame is F (4, 4) in the moved body's."""
    stiffness = 1.0 / compliance
    return {
        "name": prefix + spring.name, "type": MOTIONS[spring.kind],
        "pos": numbers(F[:3, 3]), "axis": numbers(F[:3, :3] @ spring.axis),
        "stiffness": repr(stiffness), "damping": repr(SETTLING * stiffness),
        "armature": _armature(stiffness),
    }  # fmt: skip


def _armature(stiffness: float) -> str:
    return repr(max(ARMATURE, ARMATURE_PER_STIFFNESS * stiffness))


def _motor(
    body: ET.Element, actuators: ET.Element, joint: Joint, name: str, compliance: float
) -> None:
    kp = 1.0 / compliance if compliance > 0 else RIGID
    moves = {"name": name, "type": MOTIONS[joint.kind], "axis": numbers(joint.axis)}
    drive = {"name": name, "joint": name, "kp": repr(kp), "kv": repr(SETTLING * kp)}
    # Limits are stated for what is commanded; the joint itself may yield past them.
    if math.isfinite(joint.lower) and math.isfinite(joint.upper):
        moves |= {"limited": "false", "range": numbers([joint.lower, joint.upper])}
        drive |= {"ctrllimited": "true", "ctrlrange": moves["range"]}
    ET.SubElement(body, "joint", moves, armature=_armature(kp))
    ET.SubElement(actuators, "position", drive)


def _compensate(
    root: ET.Element, body: ET.Element, T: Array, axis: Array, values: dict[str, float]
) -> None:
    """Its spring hangs on the link before the joint: opposite (a_x, a_y)."""
    x, y = transverse_axes(axis)
    point = -values["anchor_x"] * x - values["anchor_y"] * y
    place = T[:3, :3] @ point + T[:3, 3]
    ET.SubElement(body, "site", name="compensator_anchor", pos=numbers(place))
    spring = ET.SubElement(
        ET.SubElement(root, "tendon"), "spatial", name="compensator",
        stiffness=repr(values["stiffness"]), springlength=repr(values["free_length"]),
    )  # fmt: skip
    for site in ("compensator_anchor", "compensator_arm"):
        ET.SubElement(spring, "site", site=site)


# Where MuJoCo's arm of an exported MJCF comes to rest: the check that the file says the same.
#
# At rest the generalised force r(x) = passive + actuator − bias of all joints x is zero: a root of
# C r, C the compliances, so that soft and stiff joints are found alike.
TOLERANCE, AT_REST = 1e-13, 1e-10  # rad or m: last step, and what may be left


class MujocoRest:
    """A written arm in MuJoCo: a new file, whose joints its actuators drive, or the user's own as
    it is read back (`arm`), whose joints are held where they are commanded, its springs at rest.
    Of the user's own, joints beside the chain stay where they stand and only the springs move, so
    what the file has besides to be seen or to move it plays no part."""

    def __init__(self, text: str, arm: MjcfArm | None = None) -> None:
        self._mujoco = mujoco = import_mujoco("the check")
        self._arm, self._drives = arm, np.zeros(0, dtype=int)
        if arm is None:
            try:
                model = mujoco.MjModel.from_xml_string(text)
            except ValueError as error:
                raise InputError(f"MuJoCo refuses the exported MJCF: {error}") from None
            self._drives = np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
            commanded, yielding = model.actuator_trnid[self._drives, 0], np.arange(model.njnt)
        else:
            model, commanded = arm.model, np.array(arm.joints)
            # No contacts are sought: nothing touches a spring.
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
            names = [model.joint(j).name for j in range(model.njnt)]
            yielding = np.array([j for j, n in enumerate(names) if n.startswith(SPRING)], dtype=int)
        self.model, self._data = model, mujoco.MjData(model)
        # Newer MuJoCo states more of a joint's spring than the linear term.
        stiffness = np.array(model.jnt_stiffness, dtype=float).reshape(model.njnt, -1)[:, 0]
        stiffness[commanded[: len(self._drives)]] = model.actuator_gainprm[self._drives, 0]
        self._compliance, self._dofs = 1.0 / stiffness[yielding], model.jnt_dofadr[yielding]
        self._commanded, self._at = model.jnt_qposadr[commanded], model.jnt_qposadr[yielding]

    def sites(self, q: Array, force: Array, names: Sequence[str]) -> Array:
        """Positions (len(names), 3) in m in a new file's world, commanded to q (n,) under `force`
        (3,) N."""
        self._data.ctrl[self._drives] = q
        for axis, value in zip("xyz", force, strict=True):
            self._data.ctrl[self.model.actuator(f"load_{axis}").id] = value
        self._settle(q, lambda: 0.0)
        return np.array([self._data.site(name).xpos.copy() for name in names])

    def points(self, q: Array, force: Array, pieces: ExportNumbers) -> Array:
        """`pieces.points` (k, 3) in the world of the file; `force` in the tracker's axes."""
        arm, data = self._arm, self._data
        if arm is None:
            return self.sites(q, force, ["flange", *(f"marker_{name}" for name in pieces.markers)])
        R = arm.tree.placed(arm.base)[:3, :3] @ pieces.T_tracker_base[:3, :3].T
        load, (flange, place) = pieces.load_scale * R @ force, arm.flange_at

        def placed(points: Array) -> Array:
            T = transform(data.xpos[flange], data.xquat[flange]) @ place
            return np.asarray(points @ T[:3, :3].T + T[:3, 3])

        def applied() -> Array:
            found, at = np.zeros(self.model.nv), placed(pieces.load_point)
            self._mujoco.mj_applyFT(self.model, data, load, np.zeros(3), at, flange, found)
            return found

        self._settle(q, applied)
        return placed(pieces.points)

    def _settle(self, q: Array, load: Callable[[], Any]) -> None:
        mujoco, model, data = self._mujoco, self.model, self._data

        def residual(x: Array) -> Array:
            data.qpos[self._at] = x
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_fwdActuation(model, data)
            force = data.qfrc_passive + data.qfrc_actuator + load() - data.qfrc_bias
            return np.asarray(self._compliance * force[self._dofs])

        data.qpos[:] = model.qpos0
        data.qpos[self._commanded] = q
        found = root(residual, data.qpos[self._at], tol=TOLERANCE)
        if not (np.abs(residual(found.x)) <= AT_REST).all():
            raise ElastocalError(f"MuJoCo finds no rest of the exported arm near q = {q.tolist()}")


# The calibrated arm in the user's own MJCF: bodies moved, springs added, masses corrected.
#
# With X_i = Trans(p) J(a, −ref) the frame of joint i in its body's (elastocal.model.mjcf), E_i the
# error of the link before it and J_i(a_i) its offset's motion, the frame T of its body in its
# parent's becomes
#
#     T ← T X_i E_i J_i(a_i) X_i⁻¹
#
# and a flange's own T_f ← T_f E_n.  Joint values stay those that are commanded.  An identified
# spring of stiffness 1/k becomes a passive joint of its own before the driven one, so that the
# user's actuators, sensors and ranges stay as they are; keyframes get a zero for it.

ORIENTATIONS = ("quat", "axisangle", "xyaxes", "zaxis", "euler")
FLANGE = f"{PREFIX}flange"
MOST_JOINTS = 6  # of one body in MuJoCo
SMALLEST = 1e-9  # kg, kg m and of directions: less is rounding
# Of a spring's joint, whatever the defaults of the file say.
WITHOUT_DEFAULTS = {
    "limited": "false", "frictionloss": "0", "ref": "0", "springref": "0",
    "actuatorfrclimited": "false",
}  # fmt: skip


class NotInPlace(ElastocalError):
    """Why the user's file cannot take the corrections; a new file can."""


def corrected_mjcf(
    robot: Robot, pieces: ExportNumbers, frames: bool, note: str
) -> tuple[str, list[str]]:
    """Text of the robot's MJCF with the calibrated arm, and what to know of it; NotInPlace where it
    cannot take a correction.  `frames`: sites elastocal_marker_NAME and elastocal_load_point on the
    flange."""
    assert robot.mjcf is not None
    text = _MjcfText(MjcfArm.read(robot.mjcf, robot.base, robot.flange), pieces)
    if pulling := text.arm.pulling(text):
        raise NotInPlace(f"its tendon '{pulling[0]}' pulls at the arm, which the model does not")
    if AXES in text.arm.tree.frames:
        raise NotInPlace("an earlier export made it, with actuators for springs")
    if pieces.springs_at(f"link{pieces.chain.n_joints}"):
        raise NotInPlace("a spring behind the last joint has no joint to stand before")
    sprung: dict[int, int] = {}  # joint → springs put before it
    for i, j in enumerate(text.arm.joints):
        if not nothing(correction := pieces.correction(i)):
            body = int(text.model.jnt_bodyid[j])
            if mjcf.joints_of(text.model, body)[0] != j:
                name = pieces.chain.joints[i].name
                raise NotInPlace(
                    f"joint '{name}' shares its body with another; give it a body of its own"
                )
            X = mjcf.before(text.model, j)
            text.move(body, X @ correction @ np.linalg.inv(X))
        sprung[j] = text.add_springs(i, j)
    text.lengthen_keys(sprung)
    told = text.let_act() if pieces.springs else []
    told += text.correct_flange(frames)
    if pieces.masses:
        text.correct_masses()
    text.insert_in(text.tags[0], f"\n  {comment(note)}")
    return text.result(), told


class _MjcfText(XmlFile):
    """`bodies` in MuJoCo's order, the world first."""

    def __init__(self, arm: MjcfArm, pieces: ExportNumbers) -> None:
        super().__init__(arm.tree.path, arm.tree.path.read_bytes(), "an MJCF file")
        self.arm, self.model, self.pieces = arm, arm.model, pieces
        below = self.anywhere("body")
        self.bodies = [*self.anywhere("worldbody")[:1], *below]
        names = [arm.model.body(i).name for i in range(1, arm.model.nbody)]
        if [body.get("name") for body in below] != names:
            raise NotInPlace(
                "its bodies do not all stand in the file itself (<include>, <replicate>, <attach>)"
            )
        for b in arm.model.jnt_bodyid[arm.joints]:
            if len(self.joints(b)) != arm.model.body_jntnum[b]:
                raise NotInPlace(f"joints of body '{arm.bodies[b]}' stand in a <frame>")

    def joints(self, body: int) -> list[Tag]:
        return self.bodies[body].all("joint", "freejoint")

    def anywhere(self, name: str, above: str = "") -> list[Tag]:
        """Those that stand directly in `above` where that is given."""
        return [
            tag for tag in self.tags
            if tag.name == name and above in ("", tag.above.name if tag.above else "")
        ]  # fmt: skip

    def move(self, body: int, error: Array) -> None:
        """T ← T · error for the body's own attributes, whatever frames stand around it."""
        tag, model = self.bodies[body], self.model
        if tag.above is not None and tag.above.name == "frame":
            # What its attributes say, as MuJoCo understands them.
            kept = {k: v for k, v in tag.stated.items() if k in ("pos", *ORIENTATIONS)}
            stated = [item for one in self.anywhere("compiler") for item in one.stated.items()]
            how = {k: v for k, v in stated if k in ("angle", "eulerseq")}
            world = element("worldbody", {}, element("body", kept))
            alone = element("mujoco", {}, element("compiler", how), world)
            model, body = import_mujoco().MjModel.from_xml_string(alone), 1
        T = transform(model.body_pos[body], model.body_quat[body]) @ error
        self.set(tag, placed_body(None, T), ORIENTATIONS[1:])

    def add_springs(self, i: int, j: int) -> int:
        """Between link i and joint i, before the joint; returns how many."""
        pieces, model = self.pieces, self.model
        springs = pieces.springs_at(f"link{i}" if i else "base")
        springs |= pieces.springs_at(f"joint{i + 1}")
        body = int(model.jnt_bodyid[j])
        first, tags = int(model.body_jntadr[body]), self.joints(body)
        old = [k for k in range(first, j) if model.joint(k).name.startswith(SPRING)]
        for k in old:  # of an earlier export
            self.remove(tags[k - first])
        count = len(mjcf.joints_of(model, body)) + len(springs)
        if old and not springs:
            raise NotInPlace("springs of an earlier export would be lost")
        if springs and count > MOST_JOINTS:
            told = f"{count} joints would stand on one body, and MuJoCo takes {MOST_JOINTS}"
            raise NotInPlace(told)
        # The springs' frame in that of the moved body: before the joint turns by its offset.
        F = mjcf.before(model, j) @ np.linalg.inv(pieces.offset_motion(i))
        base = F if i else F @ np.linalg.inv(pieces.placement(0))  # the base's frame there
        placed = ((s, k, base if s.site == "base" else F) for s, k in springs.items())
        joints = (element("joint", spring_joint(SPRING, *one) | WITHOUT_DEFAULTS) for one in placed)
        self.insert(tags[j - first].start, "".join(f"{joint} " for joint in joints))
        return len(springs) - len(old)

    def lengthen_keys(self, sprung: dict[int, int]) -> None:
        addresses = {"qpos": self.model.jnt_qposadr, "qvel": self.model.jnt_dofadr}
        for tag in self.anywhere("key", "keyframe") if any(sprung.values()) else ():
            for name in addresses.keys() & tag.stated.keys():
                values = tag.stated[name].split()
                for at, j in sorted(((int(addresses[name][j]), j) for j in sprung), reverse=True):
                    values[at:at] = ["0"] * sprung[j]
                self.set(tag, {name: " ".join(values)})

    def let_act(self) -> list[str]:
        """Springs yield and weights act in the file, as they do in the model; what that changes."""
        # Flags as versions of MuJoCo have them.
        names = ["passive", "spring", *(["gravity"] if self.pieces.masses else [])]
        flags, kinds = self.anywhere("flag", "option"), import_mujoco().mjtDisableBit
        bits = {name: int(getattr(kinds, f"mjDSBL_{name.upper()}", 0)) for name in names}
        off = [name for name, bit in bits.items() if self.model.opt.disableflags & bit]
        for name in off:
            if not flags:
                raise NotInPlace(f'its <flag {name}="disable"/> stands in another file')
            self.set(flags[-1], {name: "enable"})
        what = "is switched on in this file, so that the springs yield to weights"
        told = [f"{name} {what}" for name in off]
        if not self.pieces.masses:
            return told
        # Gravity along the vertical that was identified, where the file has another.
        up = self.arm.tree.placed(self.arm.base)[:3, :3] @ self.pieces.T_tracker_base[:3, :3].T
        wanted = up @ [0.0, 0.0, -STANDARD_GRAVITY]
        if np.abs(self.model.opt.gravity - wanted).max() >= SMALLEST:
            self.set_in(self.tags[0], "option", {"gravity": numbers(wanted)})
        if self.model.opt.wind.any():
            self.set_in(self.tags[0], "option", {"wind": "0 0 0"})
            told.append("wind is 0 in this file, which would bend the springs")
        for b in (held := self.arm.weightless()):
            self.set(self.bodies[b], {"gravcomp": "0"})
        if held:
            bodies = listed((self.arm.bodies[b] for b in held), 4)
            told.append(f"gravcomp of {bodies} is 0 in this file, so that weights bend the springs")
        return told

    def correct_flange(self, frames: bool) -> list[str]:
        arm, pieces = self.arm, self.pieces
        error = pieces.error(pieces.chain.n_joints - 1)
        (body, at), told, T = arm.flange_at, [], np.eye(4)
        sites = {tag.get("name"): tag for tag in self.bodies[body].all("site")}
        placed: dict[str, Array] = {}
        if arm.flange in arm.tree.frames:  # a site
            T = at @ error
            placed = {} if nothing(error) else {arm.flange: T}
            if placed and arm.flange not in sites:
                raise NotInPlace(f"site '{arm.flange}' stands in a <frame>")
        elif not nothing(error) and arm.model.body_jntnum[body] == 0:
            self.move(body, error)
        elif not nothing(error):
            T, placed = error, {FLANGE: error}
            told.append(
                f"the flange is the body that the last joint moves: the calibrated one is site "
                f"'{FLANGE}', and what hangs on '{arm.flange}' stays where it was"
            )
        placed |= {name: T @ P for name, P in tool_frames(pieces).items() if frames}
        for name, place in placed.items():
            if name in sites:
                self.set(sites[name], placed_body(None, place), ORIENTATIONS[1:])
            else:
                site = placed_body(name, place) | {"size": "0.005", "group": "4"}
                self.insert_in(self.bodies[body], element("site", site))
        return told

    def correct_masses(self) -> None:
        """What each joint carries is what the model says, also where a flange moved with its
        mass."""
        model = self.model
        told = [tag.stated.get("inertiafromgeom") for tag in self.anywhere("compiler")]
        from_geoms = "true" in [value for value in told if value][-1:]
        now = MjcfArm.read(self.path, self.arm.base, self.arm.flange, self.result())
        for j, old, new in zip(self.arm.joints, now.chain.masses, self.pieces.masses, strict=False):
            mass = new.mass - old.mass
            moment = new.mass * new.com - old.mass * old.com
            if abs(mass) < SMALLEST and np.abs(moment).max() < SMALLEST:
                continue
            body = int(model.jnt_bodyid[j])
            whole = float(model.body_mass[body]) + mass
            if whole <= 0 or from_geoms:
                name = model.body(body).name
                raise NotInPlace(f"body '{name}' cannot take the mass that is missing")
            moment += model.body_mass[body] * model.body_ipos[body] + mass * model.jnt_pos[j]
            changed = {"mass": repr(whole), "pos": numbers(moment / whole)}
            if not self.bodies[body].first("inertial"):
                changed["quat"] = numbers(model.body_iquat[body])
                changed["diaginertia"] = numbers(model.body_inertia[body])
            self.set_in(self.bodies[body], "inertial", changed)
