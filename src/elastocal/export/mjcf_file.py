"""The calibrated arm as MJCF, whose rest under load is the model's static equilibrium."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from elastocal.errors import ElastocalError, InputError
from elastocal.export.exportable import ExportNumbers, SpringValue, numbers, placed_body
from elastocal.model.chain import Chain, Joint, LinkMass
from elastocal.model.effects.compliances import transverse_axes
from elastocal.model.effects.loads import STANDARD_GRAVITY
from elastocal.model.mjcf import import_mujoco
from elastocal.units import Array

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


def calibrated_mjcf(
    pieces: ExportNumbers,
    note: str,
    inertias: Sequence[Array] = (),
    compensator: dict[str, float] | None = None,
    base_frame: bool = False,
) -> str:
    """MJCF text of the exported pieces.

    Joints and their actuators (control: commanded rad or m) are called as in the robot's file;
    actuators load_x, load_y, load_z (control: N at the load point, axes of the tracker).  Sites:
    flange, load_point, marker_NAME.  The world is the robot's base, or with `base_frame` the
    tracker's frame.  `inertias`: (3, 3) kg m² per link about its centre of mass in its joint's
    axes; `compensator`: values of `gravity_compensator` by key, with `joint` its 0-based index.
    """
    chain = pieces.chain
    root = ET.Element("mujoco", model=chain.name)
    root.append(ET.Comment(f" {note.replace('--', '- -')} "))
    ET.SubElement(root, "compiler", angle="radian", balanceinertia="true", autolimits="false")
    R = np.eye(3) if base_frame else pieces.T_tracker_base[:3, :3].T
    ET.SubElement(
        root, "option", gravity=numbers(R @ [0.0, 0.0, -STANDARD_GRAVITY]),
        integrator="implicitfast",
    )  # fmt: skip
    world = ET.SubElement(root, "worldbody")
    tracker = np.eye(4)
    tracker[:3, :3] = R
    ET.SubElement(world, "site", placed_body("tracker_axes", tracker))
    actuators = ET.Element("actuator")
    body = _body(world, "base", pieces.T_tracker_base if base_frame else np.eye(4))
    _passive(body, pieces.springs_at("base"))
    before: list[SpringValue] = []
    for i, (joint, name) in enumerate(zip(chain.joints, motor_names(chain), strict=True)):
        drive, in_series = _drive(pieces, i)
        offset, T = pieces.offset_motion(i), pieces.placement(i)
        if before:  # on a body of their own: MuJoCo takes six joints at most in one
            body, T = _body(body, f"link{i}_end", T), np.eye(4)
            _passive(body, before)
        compensated = compensator if compensator and compensator["joint"] == i else None
        if compensated:
            _compensate(root, body, T, joint.axis, compensated)
        mass = pieces.masses[i] if pieces.masses else None
        body = _body(body, f"link{i + 1}", T @ offset, mass, inertias[i] if inertias else None)
        # Their axes stand before the body was turned by the joint's offset.
        _passive(body, in_series, np.asarray(np.linalg.inv(offset)))
        _motor(body, actuators, joint, name, drive)
        if compensated:
            # The offset turns the frame about the axis before the joint moves, and the model's
            # angle counts it; so the arm's end stands at angle zero of the joint's own frame.
            arm = compensated["compensator_arm"] * transverse_axes(joint.axis)[0]
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
    _sites_and_load(flange, actuators, pieces)
    root.append(actuators)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _drive(pieces: ExportNumbers, i: int) -> tuple[float, list[SpringValue]]:
    """Compliance of joint i's drive, and the springs before it.

    Springs across the axis stand between the joint's own and its motion: turns about different
    axes do not commute, and so that spring is a passive joint as well, with a rigid drive.
    """
    axis = tuple(map(float, pieces.chain.joints[i].axis))
    springs = pieces.springs_at(f"joint{i + 1}")
    if all(s.axis == axis and s.kind == pieces.chain.joints[i].kind for s in springs):
        return sum(s.compliance for s in springs), []
    return 0.0, springs


def _body(
    parent: ET.Element, name: str, T: Array, mass: LinkMass | None = None,
    inertia: Array | None = None,
) -> ET.Element:  # fmt: skip
    body = ET.SubElement(parent, "body", placed_body(name, T))
    mass = LinkMass(0.0, np.zeros(3)) if mass is None else mass
    inertial = {"pos": numbers(mass.com), "mass": repr(max(float(mass.mass), NO_MASS))}
    if inertia is not None and min(np.diag(inertia)) > NO_INERTIA:
        entries = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
        inertial["fullinertia"] = numbers(entries)
    else:
        inertial["diaginertia"] = numbers([NO_INERTIA] * 3)
    ET.SubElement(body, "inertial", inertial)
    return body


def _passive(body: ET.Element, springs: Sequence[SpringValue], frame: Array | None = None) -> None:
    for spring in springs:
        placed = np.eye(4) if frame is None else frame
        ET.SubElement(body, "joint", spring_joint("spring_", spring, placed))


def spring_joint(prefix: str, spring: SpringValue, F: Array) -> dict[str, str]:
    """Attributes of the passive joint of a spring whose frame is F (4, 4) in the moved body's."""
    stiffness = 1.0 / spring.compliance
    return {
        "name": prefix + spring.name,
        "type": MOTIONS[spring.kind],
        "pos": numbers(F[:3, 3]),
        "axis": numbers(F[:3, :3] @ spring.axis),
        "stiffness": repr(stiffness),
        "damping": repr(SETTLING * stiffness),
        "armature": _armature(stiffness),
    }


def _armature(stiffness: float) -> str:
    return repr(max(ARMATURE, ARMATURE_PER_STIFFNESS * stiffness))


def motor_names(chain: Chain) -> list[str]:
    """The names of joints and their actuators: the file's, but for those that stand for others."""
    taken = {f"load_{axis}" for axis in "xyz"}
    names = [joint.name for joint in chain.joints]
    good = len(set(names)) == len(names) and not any(
        name in taken or name.startswith("spring_") for name in names
    )
    return names if good else [f"joint{i}" for i in range(1, chain.n_joints + 1)]


def _motor(
    body: ET.Element, actuators: ET.Element, joint: Joint, name: str, compliance: float
) -> None:
    kp = 1.0 / compliance if compliance > 0 else RIGID
    ET.SubElement(
        body, "joint", name=name, type=MOTIONS[joint.kind], axis=numbers(joint.axis),
        armature=_armature(kp),
    )  # fmt: skip
    drive = {"name": name, "joint": name, "kp": repr(kp), "kv": repr(SETTLING * kp)}
    # Limits are stated for what is commanded; the joint itself may yield past them.
    if math.isfinite(joint.lower) and math.isfinite(joint.upper):
        drive |= {"ctrllimited": "true", "ctrlrange": numbers([joint.lower, joint.upper])}
    ET.SubElement(actuators, "position", drive)


def _sites_and_load(flange: ET.Element, actuators: ET.Element, pieces: ExportNumbers) -> None:
    """Flange, load point and markers; forces in N along the tracker's axes, which keep their
    direction while the arm moves."""
    load = np.eye(4)
    load[:3, 3] = pieces.load_point
    placed = {f"marker_{name}": T for name, T in pieces.markers.items()}
    for name, T in {"flange": np.eye(4), "load_point": load, **placed}.items():
        ET.SubElement(flange, "site", placed_body(name, T))
    for axis, unit in zip("xyz", np.eye(3, 6), strict=True):
        ET.SubElement(
            actuators, "motor", name=f"load_{axis}", site="load_point", refsite="tracker_axes",
            gear=numbers(pieces.load_scale * unit),
        )  # fmt: skip


def _compensate(
    root: ET.Element, body: ET.Element, T: Array, axis: Array, values: dict[str, float]
) -> None:
    """The compensator's spring, which hangs on the link before the joint: opposite (a_x, a_y)."""
    x, y = transverse_axes(axis)
    point = -values["compensator_anchor_x"] * x - values["compensator_anchor_y"] * y
    place = T[:3, :3] @ point + T[:3, 3]
    ET.SubElement(body, "site", name="compensator_anchor", pos=numbers(place))
    spring = ET.SubElement(
        ET.SubElement(root, "tendon"), "spatial", name="compensator",
        stiffness=repr(values["compensator_stiffness"]),
        springlength=repr(values["compensator_free_length"]),
    )  # fmt: skip
    for site in ("compensator_anchor", "compensator_arm"):
        ET.SubElement(spring, "site", site=site)


# Where MuJoCo's arm of an exported MJCF comes to rest: the check that the file says the same.
#
# At rest the generalised force r(x) = passive + actuator − bias of all joints x is zero.  Newton's
# method on C r, C the compliances, so that soft and stiff joints are found alike.

MAX_STEPS = 30
TOLERANCE = 1e-12  # last step, rad or m
DIFFERENCE_STEP = 1e-6  # rad or m


class MujocoRest:
    """An exported MJCF in MuJoCo.  Raises InputError where MuJoCo is missing or refuses it."""

    def __init__(self, text: str) -> None:
        self._mujoco = mujoco = import_mujoco("the check")
        try:
            self.model = mujoco.MjModel.from_xml_string(text)
        except ValueError as error:
            raise InputError(f"MuJoCo refuses the exported MJCF: {error}") from None
        self._data = mujoco.MjData(self.model)
        joint, kinds = mujoco.mjtTrn.mjTRN_JOINT, self.model.actuator_trntype
        self._drives = [k for k in range(self.model.nu) if kinds[k] == joint]
        self._driven = [
            int(self.model.jnt_dofadr[self.model.actuator_trnid[k, 0]]) for k in self._drives
        ]
        stiffness = joint_stiffness(self.model)
        stiffness[self._driven] = self.model.actuator_gainprm[self._drives, 0]
        self._compliance = 1.0 / stiffness

    def sites(self, q: Array, force: Array, names: Sequence[str]) -> Array:
        """Positions (len(names), 3) in m in the MJCF's world, at rest: commanded to q (n,) under
        `force` (3,) N.

        Raises ElastocalError where no rest is found.
        """
        control = np.zeros(self.model.nu)
        control[self._drives] = q
        for axis, value in zip("xyz", force, strict=True):
            control[self.model.actuator(f"load_{axis}").id] = value
        self._data.ctrl[:] = control
        x = np.zeros(self.model.nv)
        x[self._driven] = q
        settle(self._residual, x, q)
        return np.array([self._data.site(name).xpos.copy() for name in names])

    def _residual(self, x: Array) -> Array:
        data = self._data
        data.qpos[:] = x
        data.qvel[:] = 0.0
        self._mujoco.mj_fwdPosition(self.model, data)
        self._mujoco.mj_fwdVelocity(self.model, data)
        self._mujoco.mj_fwdActuation(self.model, data)
        force = data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias
        return np.asarray(self._compliance * force)


def joint_stiffness(model: Any) -> Array:
    """(joints,) N m/rad or N/m; newer MuJoCo states more than the linear term."""
    return np.array(model.jnt_stiffness, dtype=float).reshape(model.njnt, -1)[:, 0]


def settle(residual: Callable[[Array], Array], x: Array, q: Array) -> None:
    """Find where `residual` of joints (n,) is zero, from x on, and evaluate it there last.

    Raises ElastocalError, which names the commanded q, where there is no such place.
    """
    for _ in range(MAX_STEPS):
        r = residual(x)
        h = DIFFERENCE_STEP * np.eye(len(x))
        slope = np.array([residual(x + dx) - residual(x - dx) for dx in h]).reshape(h.shape).T
        step = np.linalg.solve(slope / (2 * DIFFERENCE_STEP), r)
        x = x - step
        if not np.isfinite(x).all():
            break
        if np.max(np.abs(step), initial=0.0) < TOLERANCE:
            residual(x)
            return
    raise ElastocalError(f"MuJoCo finds no rest of the exported arm near q = {q.tolist()}")
