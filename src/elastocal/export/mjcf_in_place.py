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

import numpy as np

from elastocal.cell.arm_description import Robot
from elastocal.errors import ElastocalError
from elastocal.export.exportable import (
    ExportNumbers,
    SpringValue,
    nothing,
    numbers,
    placed_body,
)
from elastocal.export.mjcf_file import joint_stiffness, settle, spring_joint, springs_at
from elastocal.export.urdf_file import PREFIX, tool_frames
from elastocal.model.effects.loads import STANDARD_GRAVITY
from elastocal.model.mjcf import SPRING, MjcfArm, import_mujoco, mjcf_bytes, transform
from elastocal.model.xml_file import Tag, XmlText, comment, element
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


class NotInPlace(ElastocalError):
    """Why the user's file cannot take the corrections; a new file can."""


class _MjcfText(XmlText):
    """The text of an MJCF that MuJoCo reads; `bodies` in MuJoCo's order, the world first."""

    def __init__(self, arm: MjcfArm) -> None:
        super().__init__(arm.path, mjcf_bytes(arm.path))
        self.root = self.tags[0]
        world = [tag for tag in self.tags if tag.name == "worldbody"]
        below = [tag for tag in self.tags if tag.name == "body" and tag.within("worldbody")]
        self.bodies = world[:1] + below
        names = [arm.model.body(i).name for i in range(1, arm.model.nbody)]
        if [body.stated.get("name", "") for body in below] != names:
            raise NotInPlace(
                "its bodies do not all stand in the file itself (<include>, <replicate>, <attach>)"
            )
        for b in arm.way(arm.flange):
            if len(self.joints(b)) != arm.model.body_jntnum[b]:
                raise NotInPlace(f"joints of body '{arm.model.body(b).name}' stand in a <frame>")

    def joints(self, body: int) -> list[Tag]:
        return self.bodies[body].all("joint", "freejoint")

    def anywhere(self, name: str, above: str = "") -> list[Tag]:
        """All tags of a name, those that stand directly in `above` where that is given."""
        return [
            tag for tag in self.tags
            if tag.name == name and above in ("", tag.above.name if tag.above else "")
        ]  # fmt: skip


def corrected_mjcf(
    robot: Robot, pieces: ExportNumbers, frames: bool, note: str
) -> tuple[str, list[str]]:
    """Text of the robot's MJCF with the calibrated arm, and what to know of it.

    `frames`: sites elastocal_marker_NAME and elastocal_load_point on the flange.

    Raises NotInPlace where the file cannot take a correction, with the reason.
    """
    assert robot.mjcf is not None
    arm = MjcfArm.read(robot.mjcf, robot.base, robot.flange)
    text = _MjcfText(arm)
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
    text.insert_in(text.root, f"\n  {comment(note)}")
    return text.result(), told


def _correct_joint(arm: MjcfArm, text: _MjcfText, pieces: ExportNumbers, i: int, j: int) -> None:
    if nothing(correction := pieces.correction(i)):
        return
    body = int(arm.model.jnt_bodyid[j])
    if arm.joints_of(body)[0] != j:
        raise NotInPlace(
            f"joint '{arm.joint_name(j)}' shares its body with another; give it a body of its own"
        )
    X = arm.before(j)
    _move(arm, text, body, X @ correction @ np.linalg.inv(X))


def _move(arm: MjcfArm, text: _MjcfText, body: int, error: Array) -> None:
    """T ← T · error for the body's own attributes, whatever frames stand around it, and in MuJoCo's
    model of the file."""
    tag, own = text.bodies[body], arm.local(body)
    if tag.above is not None and tag.above.name == "frame":
        own = _stated(text, tag)
    text.set(tag, _placed(own @ error), ORIENTATIONS[1:])
    for name, value in _placed(arm.local(body) @ error).items():
        getattr(arm.model, f"body_{name}")[body] = np.array(value.split(), dtype=float)


def _stated(text: _MjcfText, tag: Tag) -> Array:
    """T (4, 4) that a body's own attributes say, as MuJoCo understands them."""
    kept = {k: v for k, v in tag.stated.items() if k in ("pos", *ORIENTATIONS)}
    stated = [item for tag in text.anywhere("compiler") for item in tag.stated.items()]
    how = {k: v for k, v in stated if k in ("angle", "eulerseq")}
    world = element("worldbody", {}, element("body", kept))
    alone = element("mujoco", {}, element("compiler", how), world)
    model = import_mujoco().MjModel.from_xml_string(alone)
    return transform(model.body_pos[1], model.body_quat[1])


def _placed(T: Array) -> dict[str, str]:
    """`pos` and `quat` of a transform (4, 4)."""
    placed = placed_body("", T)
    return {name: placed[name] for name in ("pos", "quat")}


def _add_springs(arm: MjcfArm, text: _MjcfText, pieces: ExportNumbers, i: int, j: int) -> int:
    """Put the springs between link i and joint i before the joint; returns how many."""
    before = springs_at(pieces, f"link{i}" if i else "base")
    springs = [*before, *springs_at(pieces, f"joint{i + 1}")]
    body = int(arm.model.jnt_bodyid[j])
    first = int(arm.model.body_jntadr[body])
    tags = text.joints(body)
    old = [k for k in range(first, j) if arm.model.joint(k).name.startswith(SPRING)]
    for k in old:  # of an earlier export
        text.remove(tags[k - first])
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
    text.insert(tags[j - first].start, "".join(f"{joint} " for joint in joints))
    return len(springs) - len(old)


def _correct_masses(arm: MjcfArm, text: _MjcfText, pieces: ExportNumbers) -> None:
    """What each joint carries is what the model says, also where a flange moved with its mass."""
    model = arm.model
    told = [tag.stated.get("inertiafromgeom") for tag in text.anywhere("compiler")]
    from_geoms = "true" in [value for value in told if value][-1:]
    for j, old, new in zip(arm.joints, arm.masses(), pieces.masses, strict=False):
        mass = new.mass - old.mass
        moment = new.mass * new.com - old.mass * old.com
        if abs(mass) < SMALLEST and np.abs(moment).max() < SMALLEST:
            continue
        body = int(model.jnt_bodyid[j])
        whole = float(model.body_mass[body]) + mass
        if whole <= 0 or from_geoms:
            raise NotInPlace(f"body '{model.body(body).name}' cannot take the mass that is missing")
        moment = model.body_mass[body] * model.body_ipos[body] + moment + mass * model.jnt_pos[j]
        changed = {"mass": repr(whole), "pos": numbers(moment / whole)}
        stated = {
            "quat": numbers(model.body_iquat[body]),
            "diaginertia": numbers(model.body_inertia[body]),
        }
        given = text.bodies[body].first("inertial")
        text.set_in(text.bodies[body], "inertial", changed if given else changed | stated)


def _lengthen_keys(arm: MjcfArm, text: _MjcfText, sprung: dict[int, int]) -> None:
    """Zeros for the new joints in the positions and velocities of keyframes."""
    for tag in text.anywhere("key", "keyframe"):
        changed = {}
        for name, address in (("qpos", arm.model.jnt_qposadr), ("qvel", arm.model.jnt_dofadr)):
            if name in tag.stated:
                values = tag.stated[name].split()
                for j, count in sorted(sprung.items(), key=lambda pair: -address[pair[0]]):
                    at = int(address[j])
                    values[at:at] = ["0"] * count
                changed[name] = " ".join(values)
        if changed:
            text.set(tag, changed)


def springs_of(pieces: ExportNumbers) -> list[SpringValue]:
    """The springs that yield."""
    return [s for s in pieces.springs if s.compliance > 0]


def _let_act(arm: MjcfArm, text: _MjcfText, pieces: ExportNumbers) -> list[str]:
    """Let springs yield and weights act in the file, as they do in the model; what that changes."""
    told = _enabled(arm, text, ("passive", "spring"))
    if not pieces.masses:
        return told
    _turn_gravity(arm, text, pieces)
    told += _enabled(arm, text, ("gravity",))
    moved = [b for b in range(1, arm.model.nbody) if arm.carrier(b) is not None]
    held = [b for b in moved if arm.model.body_gravcomp[b]]
    for b in held:
        text.set(text.bodies[b], {"gravcomp": "0"})
    if held:
        names = listed((arm.model.body(b).name or f"body {b}" for b in held), 4)
        told.append(f"gravcomp of {names} is 0 in this file, so that weights bend the springs")
    return told


def _enabled(arm: MjcfArm, text: _MjcfText, names: Sequence[str]) -> list[str]:
    """Switch on what <flag> of the file switches off, of these."""
    import mujoco

    told = []
    for name in names:
        bit = getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}", 0)  # as versions differ
        if arm.model.opt.disableflags & int(bit):
            flags = text.anywhere("flag", "option")
            if not flags:
                raise NotInPlace(f'its <flag {name}="disable"/> stands in another file')
            text.set(flags[-1], {name: "enable"})
            told.append(f"{name} is switched on in this file, so that the springs yield to weights")
    return told


def _turn_gravity(arm: MjcfArm, text: _MjcfText, pieces: ExportNumbers) -> None:
    """Gravity along the vertical that was identified, where the file has another."""
    base = arm.placed(arm.base)[:3, :3]
    wanted = -STANDARD_GRAVITY * base @ pieces.T_tracker_base[:3, :3].T @ [0.0, 0.0, 1.0]
    if np.abs(arm.model.opt.gravity - wanted).max() < SMALLEST:
        return
    stated = {"gravity": numbers(wanted)}
    if options := text.anywhere("option"):
        text.set(options[0], stated)
    else:
        text.insert_in(text.root, f"\n  {element('option', stated)}")


def _flange_and_sites(
    arm: MjcfArm, text: _MjcfText, pieces: ExportNumbers, frames: bool
) -> list[str]:
    error = pieces.error(pieces.chain.n_joints - 1)
    body, told = arm.flange, []
    T = np.eye(4)
    sites = {tag.stated.get("name", ""): tag for tag in text.bodies[body].all("site")}
    extra: dict[str, Array] = {}
    if arm.site is not None:
        T = arm.flange_in_body @ error
        if not nothing(error):
            if arm.end_name not in sites:
                raise NotInPlace(f"site '{arm.end_name}' stands in a <frame>")
            text.set(sites[arm.end_name], _placed(T), ORIENTATIONS[1:])
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
        if name in sites:
            text.set(sites[name], _placed(place), ORIENTATIONS[1:])
        else:
            site = placed_body(name, place) | {"size": "0.005", "group": "4"}
            text.insert_in(text.bodies[body], element("site", site))
    return told


class HeldArm:
    """The written arm in MuJoCo, its joints held where they are commanded, its springs at rest.

    Joints beside the chain stay where they stand; weights act where the model has them.  Only the
    springs move, so what the file has besides to be seen or to move it plays no part.
    """

    def __init__(self, text: str, robot: Robot, pieces: ExportNumbers) -> None:
        assert robot.mjcf is not None
        flange = FLANGE if f'name="{FLANGE}"' in text else robot.flange
        self._arm = arm = MjcfArm.read(robot.mjcf, robot.base, flange, text)
        self._pieces, self._mujoco, model = pieces, import_mujoco(), arm.model
        if not pieces.masses:
            model.opt.gravity[:] = 0.0
        # No contacts are sought: nothing touches a spring.
        model.opt.disableflags |= int(self._mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        self._data = self._mujoco.MjData(model)
        springs = [j for j in range(model.njnt) if model.joint(j).name.startswith(SPRING)]
        self._moved = model.jnt_qposadr[springs]
        self._turned = model.jnt_dofadr[springs]
        self._held = model.jnt_qposadr[arm.joints]
        self._compliance = 1.0 / joint_stiffness(model)[springs]
        self.T_world_base = arm.placed(arm.base)

    def __call__(self, q: Array, force: Array) -> Array:
        """Positions (k, 3) of `pieces.points` in the file's world: commanded to q (n,), under
        `force` (3,) N in the tracker's axes.  Raises ElastocalError where no rest is found."""
        model, data, mujoco = self._arm.model, self._data, self._mujoco
        pieces, flange = self._pieces, self._arm.flange
        R = self.T_world_base[:3, :3] @ pieces.T_tracker_base[:3, :3].T
        load = pieces.load_scale * R @ force
        data.qpos[:] = model.qpos0
        data.qpos[self._held] = q

        def placed(points: Array) -> Array:
            T = transform(data.xpos[flange], data.xquat[flange]) @ self._arm.flange_in_body
            return np.asarray(points @ T[:3, :3].T + T[:3, 3])

        def residual(x: Array) -> Array:
            data.qpos[self._moved] = x
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            applied = np.zeros(model.nv)
            at = placed(pieces.load_point)
            mujoco.mj_applyFT(model, data, load, np.zeros(3), at, flange, applied)
            acting = data.qfrc_passive + applied - data.qfrc_bias
            return np.asarray(self._compliance * acting[self._turned])

        settle(residual, np.zeros(len(self._compliance)), q)
        return placed(pieces.points)
