"""The calibrated arm in the user's own MJCF: bodies moved, springs added, masses corrected.

With X_i = Trans(p) J(a, −ref) the frame of joint i in its body's (elastocal.model.mjcf), E_i the
error of the link before it and J_i(a_i) its offset's motion, the frame T of its body in its
parent's becomes

    T ← T X_i E_i J_i(a_i) X_i⁻¹

and a flange's own T_f ← T_f E_n.  Joint values stay those that are commanded.  An identified spring
of stiffness 1/k becomes a passive joint of its own before the driven one, so that the user's
actuators, sensors and ranges stay as they are; keyframes get a zero for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET
from xml.parsers import expat

import numpy as np

from elastocal.cell.arm_description import Robot
from elastocal.errors import ElastocalError
from elastocal.export.exportable import ExportNumbers, SpringValue, numbers, placed_body
from elastocal.export.mjcf_file import RIGID, spring_joint, springs_at
from elastocal.export.urdf_file import (
    PREFIX,
    XmlText,
    comment,
    correction_of_joint,
    element,
    error_of_link,
    nothing,
    tag_end,
    tool_frames,
)
from elastocal.model.effects.loads import STANDARD_GRAVITY
from elastocal.model.mjcf import (
    SPRING,
    MjcfArm,
    compiled,
    mjcf_bytes,
    parsed,
    strip,
    transform,
)
from elastocal.model.urdf import as_utf8
from elastocal.text import listed
from elastocal.units import Array

ORIENTATIONS = ("quat", "axisangle", "xyaxes", "zaxis", "euler")
FLANGE = f"{PREFIX}flange"
MOST_JOINTS = 6  # of one body in MuJoCo
SMALLEST = 1e-9  # kg, kg m and of directions: less is rounding
# Of a spring's joint, whatever the defaults of the file say.
WITHOUT_DEFAULTS = {
    "limited": "false", "frictionloss": "0", "ref": "0", "springref": "0",
    "actuatorfrclimited": "false",
}  # fmt: skip


# Of an element of a spec, what makes it the one it is.
KEPT = ("id", "name", "signature", "classname", "info")


class NotInPlace(ElastocalError):
    """Why the user's file cannot take the corrections; a new file can."""


@dataclass
class BodyTags:
    """Where the tags of a body stand, in bytes; `framed`: inside a <frame>."""

    start: int
    name: str
    framed: bool
    joints: list[int] = field(default_factory=list)
    inertial: int | None = None
    sites: dict[str, int] = field(default_factory=dict)


@dataclass
class MjcfText(XmlText):
    """The text of an MJCF file; `bodies` in MuJoCo's order, the world first."""

    bodies: list[BodyTags] = field(default_factory=list)
    keys: list[tuple[int, dict[str, str]]] = field(default_factory=list)
    compiler: dict[str, str] = field(default_factory=dict)
    option: int | None = None
    flags: int | None = None
    root: int = 0


def read_mjcf_text(path: Path) -> MjcfText:
    """The MJCF at `path` (which MuJoCo reads) with its bodies located."""
    found = MjcfText(as_utf8(path, mjcf_bytes(path)))
    found.bodies.append(BodyTags(0, "world", False))
    parser = expat.ParserCreate()
    stack: list[str] = []
    inside: list[BodyTags] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        at, above = parser.CurrentByteIndex, stack[-1] if stack else ""
        stack.append(tag)
        if tag == "mujoco" and len(stack) == 1:
            found.root = at
        elif tag == "worldbody":
            inside.append(found.bodies[0])
        elif tag == "body" and inside:
            inside.append(BodyTags(at, attributes.get("name", ""), above == "frame"))
            found.bodies.append(inside[-1])
        elif inside and tag in ("joint", "freejoint") and above == "body":
            inside[-1].joints.append(at)
        elif inside and tag == "inertial" and above == "body":
            inside[-1].inertial = at
        elif inside and tag == "site" and above in ("body", "worldbody"):
            inside[-1].sites[attributes.get("name", "")] = at
        elif tag == "compiler":
            found.compiler |= attributes
        elif tag == "key" and above == "keyframe":
            found.keys.append((at, attributes))
        elif tag == "option" and found.option is None:
            found.option = at
        elif tag == "flag" and above == "option":
            found.flags = at

    def end(tag: str) -> None:
        stack.pop()
        if tag in ("body", "worldbody") and inside:
            inside.pop()

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(found.data, True)
    return found


def corrected_mjcf(
    robot: Robot, pieces: ExportNumbers, frames: bool, note: str
) -> tuple[str, list[str]]:
    """Text of the robot's MJCF with the calibrated arm, and what to know of it.

    `frames`: sites elastocal_marker_NAME and elastocal_load_point on the flange.

    Raises NotInPlace where the file cannot take a correction, with the reason.
    """
    assert robot.mjcf is not None
    arm = MjcfArm.read(robot.mjcf, robot.base, robot.flange)
    text = read_mjcf_text(arm.path)
    _check_located(arm, text)
    told: list[str] = []
    sprung: dict[int, int] = {}  # joint → springs put before it
    if springs_at(pieces, f"link{pieces.chain.n_joints}"):
        raise NotInPlace("a spring behind the last joint has no joint to stand before")
    for i, j in enumerate(arm.joints):
        _correct_joint(arm, text, pieces, i, j)
        sprung[j] = _add_springs(arm, text, pieces, i, j)
    if any(sprung.values()):
        _lengthen_keys(arm, text, sprung)
    if springs_of(pieces):
        told += _let_act(arm, text, pieces)
    told += _flange_and_sites(arm, text, pieces, frames)
    _correct_masses(arm, text, pieces)
    text.insert(tag_end(text.data, text.root), f"\n  <!-- {comment(note)} -->")
    return text.result(), told


def _check_located(arm: MjcfArm, text: MjcfText) -> None:
    model = arm.model
    names = [model.body(i).name for i in range(model.nbody)]
    if [body.name for body in text.bodies] != names:
        raise NotInPlace(
            "its bodies do not all stand in the file itself (<include>, <replicate>, <attach>)"
        )
    for body in arm.way(arm.flange):
        if len(text.bodies[body].joints) != model.body_jntnum[body]:
            raise NotInPlace(f"joints of body '{names[body]}' stand in a <frame>")


def _correct_joint(arm: MjcfArm, text: MjcfText, pieces: ExportNumbers, i: int, j: int) -> None:
    if nothing(correction := correction_of_joint(pieces, i)):
        return
    body = int(arm.model.jnt_bodyid[j])
    if arm.joints_of(body)[0] != j:
        raise NotInPlace(
            f"joint '{arm.joint_name(j)}' shares its body with another; give it a body of its own"
        )
    X = arm.before(j)
    _move(arm, text, body, X @ correction @ np.linalg.inv(X))


def _move(arm: MjcfArm, text: MjcfText, body: int, error: Array) -> None:
    """T ← T · error for the body's own attributes, whatever frames stand around it, and in MuJoCo's
    model of the file."""
    start = text.bodies[body].start
    own = arm.local(body)
    if text.bodies[body].framed:
        own = _stated(arm, text, start)
    text.set_attributes(start, _placed(own @ error), ORIENTATIONS[1:])
    for name, value in _placed(arm.local(body) @ error).items():
        getattr(arm.model, f"body_{name}")[body] = np.array(value.split(), dtype=float)


def _stated(arm: MjcfArm, text: MjcfText, start: int) -> Array:
    """T (4, 4) that a body's own attributes say, as MuJoCo understands them."""
    import mujoco

    tag = text.data[start : tag_end(text.data, start)].decode("utf-8")
    given = ET.fromstring(tag if tag.endswith("/>") else f"{tag[:-1]}/>").attrib
    kept = {k: v for k, v in given.items() if k in ("pos", *ORIENTATIONS)}
    how = {k: v for k, v in text.compiler.items() if k in ("angle", "eulerseq")}
    alone = (
        f"<mujoco>{element('compiler', how)}<worldbody>{element('body', kept)}</worldbody></mujoco>"
    )
    model = mujoco.MjModel.from_xml_string(alone)
    return transform(model.body_pos[1], model.body_quat[1])


def _placed(T: Array) -> dict[str, str]:
    """`pos` and `quat` of a transform (4, 4)."""
    placed = placed_body("", T)
    return {name: placed[name] for name in ("pos", "quat")}


def _add_springs(arm: MjcfArm, text: MjcfText, pieces: ExportNumbers, i: int, j: int) -> int:
    """Put the springs between link i and joint i before the joint; returns how many."""
    before = springs_at(pieces, f"link{i}" if i else "base")
    springs = [*before, *springs_at(pieces, f"joint{i + 1}")]
    body = int(arm.model.jnt_bodyid[j])
    first = int(arm.model.body_jntadr[body])
    tags = text.bodies[body].joints
    old = [k for k in range(first, j) if arm.model.joint(k).name.startswith(SPRING)]
    for k in old:  # of an earlier export
        start = tags[k - first]
        end = tag_end(text.data, start)
        text.edits.append((start, end, b""))
    if not springs:
        if old:
            raise NotInPlace("springs of an earlier export would be lost")
        return 0
    count = len(arm.joints_of(body)) + len(springs)
    if count > MOST_JOINTS:
        raise NotInPlace(f"{count} joints would stand on one body, and MuJoCo takes {MOST_JOINTS}")
    # The springs' frame in that of the moved body: before the joint turns by its offset.
    F = arm.before(j) @ np.linalg.inv(pieces.offset_motion(i))
    base = F if i else F @ np.linalg.inv(pieces.placement(0))  # the base's frame in that body's
    placed = [(s, base if s.site == "base" else F) for s in springs]
    joints = (element("joint", spring_joint(SPRING, *one) | WITHOUT_DEFAULTS) for one in placed)
    text.insert(tags[j - first], "".join(f"{joint} " for joint in joints))
    return len(springs) - len(old)


def _correct_masses(arm: MjcfArm, text: MjcfText, pieces: ExportNumbers) -> None:
    """What each joint carries is what the model says, also where a flange moved with its mass."""
    model = arm.model
    for j, old, new in zip(arm.joints, arm.masses(), pieces.masses, strict=False):
        mass = new.mass - old.mass
        moment = new.mass * new.com - old.mass * old.com
        if abs(mass) < SMALLEST and np.abs(moment).max() < SMALLEST:
            continue
        body = int(model.jnt_bodyid[j])
        whole = float(model.body_mass[body]) + mass
        if whole <= 0 or text.compiler.get("inertiafromgeom") == "true":
            raise NotInPlace(f"body '{model.body(body).name}' cannot take the mass that is missing")
        moment = model.body_mass[body] * model.body_ipos[body] + moment + mass * model.jnt_pos[j]
        changed = {"mass": repr(whole), "pos": numbers(moment / whole)}
        tags = text.bodies[body]
        if tags.inertial is not None:
            text.set_attributes(tags.inertial, changed)
            continue
        stated = {
            "quat": numbers(model.body_iquat[body]),
            "diaginertia": numbers(model.body_inertia[body]),
        }
        text.insert(tag_end(text.data, tags.start), element("inertial", changed | stated))


def _lengthen_keys(arm: MjcfArm, text: MjcfText, sprung: dict[int, int]) -> None:
    """Zeros for the new joints in the positions and velocities of keyframes."""
    for start, attributes in text.keys:
        changed = {}
        for name, address in (("qpos", arm.model.jnt_qposadr), ("qvel", arm.model.jnt_dofadr)):
            if name in attributes:
                values = attributes[name].split()
                for j, count in sorted(sprung.items(), key=lambda pair: -address[pair[0]]):
                    at = int(address[j])
                    values[at:at] = ["0"] * count
                changed[name] = " ".join(values)
        if changed:
            text.set_attributes(start, changed)


def springs_of(pieces: ExportNumbers) -> list[SpringValue]:
    """The springs that yield."""
    return [s for s in pieces.springs if s.compliance > 0]


def _let_act(arm: MjcfArm, text: MjcfText, pieces: ExportNumbers) -> list[str]:
    """Let springs yield and weights act in the file, as they do in the model; what that changes."""
    told = _enabled(arm, text, ("passive", "spring"))
    if not pieces.masses:
        return told
    _turn_gravity(arm, text, pieces)
    told += _enabled(arm, text, ("gravity",))
    moved = [b for b in range(1, arm.model.nbody) if arm.carrier(b) is not None]
    held = [b for b in moved if arm.model.body_gravcomp[b]]
    for b in held:
        text.set_attributes(text.bodies[b].start, {"gravcomp": "0"})
    if held:
        names = listed((arm.model.body(b).name or f"body {b}" for b in held), 4)
        told.append(f"gravcomp of {names} is 0 in this file, so that weights bend the springs")
    return told


def _enabled(arm: MjcfArm, text: MjcfText, names: Sequence[str]) -> list[str]:
    """Switch on what <flag> of the file switches off, of these."""
    import mujoco

    told = []
    for name in names:
        bit = getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}", 0)  # as versions differ
        if arm.model.opt.disableflags & int(bit):
            if text.flags is None:
                raise NotInPlace(f'its <flag {name}="disable"/> stands in another file')
            text.set_attributes(text.flags, {name: "enable"})
            told.append(f"{name} is switched on in this file, so that the springs yield to weights")
    return told


def _turn_gravity(arm: MjcfArm, text: MjcfText, pieces: ExportNumbers) -> None:
    """Gravity along the vertical that was identified, where the file has another."""
    base = arm.placed(arm.base)[:3, :3]
    wanted = -STANDARD_GRAVITY * base @ pieces.T_tracker_base[:3, :3].T @ [0.0, 0.0, 1.0]
    if np.abs(arm.model.opt.gravity - wanted).max() < SMALLEST:
        return
    if text.option is not None:
        text.set_attributes(text.option, {"gravity": numbers(wanted)})
    else:
        line = element("option", {"gravity": numbers(wanted)})
        text.insert(tag_end(text.data, text.root), f"\n  {line}")


def _flange_and_sites(
    arm: MjcfArm, text: MjcfText, pieces: ExportNumbers, frames: bool
) -> list[str]:
    error = error_of_link(pieces, pieces.chain.n_joints - 1)
    body, told = arm.flange, []
    tags, T = text.bodies[body], np.eye(4)
    extra: dict[str, Array] = {}
    if arm.site is not None:
        T = arm.flange_in_body @ error
        if not nothing(error):
            if arm.end_name not in tags.sites:
                raise NotInPlace(f"site '{arm.end_name}' stands in a <frame>")
            text.set_attributes(tags.sites[arm.end_name], _placed(T), ORIENTATIONS[1:])
    elif not nothing(error):
        if arm.model.body_jntnum[body] == 0:
            _move(arm, text, body, error)
        else:
            T, extra = error, {FLANGE: error}
            told.append(
                f"the flange is the body that the last joint moves: the calibrated one is site "
                f"'{FLANGE}', and what hangs on '{arm.end_name}' stays where it was"
            )
    tool = tool_frames(pieces) if frames else {}
    for name, place in (extra | {n: T @ P for n, P in tool.items()}).items():
        if name in tags.sites:
            text.set_attributes(tags.sites[name], _placed(place), ORIENTATIONS[1:])
        else:
            site = element("site", placed_body(name, place) | {"size": "0.005", "group": "4"})
            text.insert(tag_end(text.data, tags.start), site)
    return told


# The written file in MuJoCo: its arm alone, held at commanded joints, at rest under load.


HELD = f"{PREFIX}held_"  # sites of the check


def held_arm(text: str, robot: Robot, pieces: ExportNumbers) -> tuple[Any, Array, list[str]]:
    """MuJoCo's model of the written arm with its springs, each joint driven by a stiff actuator.

    With it T_world_base (4, 4), and the sites of `pieces.points`.  Actuators joint1 … and load_x …
    are as `calibrated_mjcf` has them; joints beside the chain are held where they stand.  Weights
    act where the model has them.
    """
    import mujoco

    assert robot.mjcf is not None
    flange = FLANGE if f'name="{FLANGE}"' in text else robot.flange
    arm = MjcfArm.read(robot.mjcf, robot.base, flange, text)
    spec, model = parsed(robot.mjcf, text), arm.model
    strip(spec, list(spec.geoms))
    spec.compiler.boundmass = spec.compiler.boundinertia = SMALLEST
    compiled(spec)  # gives numbers to bodies and joints
    for body in spec.bodies:
        body.explicitinertial = 1
        body.mass, body.inertia = model.body_mass[body.id], model.body_inertia[body.id]
        body.ipos, body.iquat = model.body_ipos[body.id], model.body_iquat[body.id]
        body.fullinertia = np.full(6, np.nan)  # told by the two above
    driven = {j: f"joint{i + 1}" for i, j in enumerate(arm.joints)}
    for joint, j in [(joint, joint.id) for joint in spec.joints]:  # numbers change with the first
        if j in driven:
            joint.name, joint.frictionloss = f"{HELD}{driven[j]}", 0.0
            joint.stiffness = joint.damping = 0.0 * joint.stiffness
            joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        elif not joint.name.startswith(SPRING):
            spec.delete(joint)
    last = next(body for body in spec.bodies if body.id == arm.flange)
    names = [f"{HELD}{k}" for k in range(len(pieces.points))]
    for name, point in zip(
        [*names, f"{HELD}load"], [*pieces.points, pieces.load_point], strict=True
    ):
        site = plain(last.add_site(name=name), "site")
        site.pos = (arm.flange_in_body @ [*point, 1.0])[:3]
    spec.option.gravity = model.opt.gravity if pieces.masses else np.zeros(3)
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    T_base = arm.placed(arm.base)
    tracker = placed_body("tracker_axes", T_base @ np.linalg.inv(pieces.T_tracker_base))
    place, turn = (np.array(tracker[k].split(), dtype=float) for k in ("pos", "quat"))
    site = plain(spec.worldbody.add_site(name="tracker_axes"), "site")
    site.pos, site.quat = place, turn
    for name in driven.values():
        drive = plain(spec.add_actuator(name=name), "actuator")
        drive.target, drive.trntype = f"{HELD}{name}", mujoco.mjtTrn.mjTRN_JOINT
        drive.gainprm, drive.biasprm = _first(RIGID), _first(0, -RIGID)
        drive.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    for k, axis in enumerate("xyz"):
        gear = np.eye(6)[k] * pieces.load_scale
        load = plain(spec.add_actuator(name=f"load_{axis}"), "actuator")
        load.target, load.refsite, load.gear = f"{HELD}load", "tracker_axes", gear
        load.trntype, load.gainprm = mujoco.mjtTrn.mjTRN_SITE, _first(1.0)
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    return compiled(spec)[0], T_base, names


def plain(made: Any, kind: str) -> Any:
    """An element just added to a spec without what the defaults of the file give it."""
    import mujoco

    empty = mujoco.MjSpec()
    bare = empty.worldbody.add_site() if kind == "site" else empty.add_actuator()
    for name in dir(bare):
        value = None if name.startswith("_") or name in KEPT else getattr(bare, name)
        if isinstance(value, float | int | str | np.ndarray) or type(value).__name__[:3] == "mjt":
            setattr(made, name, value)
    if kind == "site":
        made.alt.type = bare.alt.type
    return made


def _first(*values: float) -> Array:
    """The ten parameters of a gain or bias, which begin with `values`."""
    return np.array([*values, *([0.0] * (10 - len(values)))])
