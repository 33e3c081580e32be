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

import numpy as np

from elastocal.cell.arm_description import Robot
from elastocal.errors import ElastocalError
from elastocal.export.exportable import (
    ExportNumbers,
    nothing,
    numbers,
    placed_body,
)
from elastocal.export.mjcf_file import joint_stiffness, settle, spring_joint
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


def corrected_mjcf(
    robot: Robot, pieces: ExportNumbers, frames: bool, note: str
) -> tuple[str, list[str]]:
    """Text of the robot's MJCF with the calibrated arm, and what to know of it.

    `frames`: sites elastocal_marker_NAME and elastocal_load_point on the flange.

    Raises NotInPlace where the file cannot take a correction, with the reason.
    """
    assert robot.mjcf is not None
    text = _MjcfText(MjcfArm.read(robot.mjcf, robot.base, robot.flange), pieces)
    if pieces.springs_at(f"link{pieces.chain.n_joints}"):
        raise NotInPlace("a spring behind the last joint has no joint to stand before")
    sprung: dict[int, int] = {}  # joint → springs put before it
    for i, j in enumerate(text.arm.joints):
        text.correct_joint(i, j)
        sprung[j] = text.add_springs(i, j)
    if any(sprung.values()):
        text.lengthen_keys(sprung)
    told = text.let_act() if pieces.yielding else []
    told += text.correct_flange(frames)
    text.correct_masses()
    text.insert_in(text.tags[0], f"\n  {comment(note)}")
    return text.result(), told


class _MjcfText(XmlText):
    """The text of an MJCF that MuJoCo reads, and what is to be changed in it; `bodies` in MuJoCo's
    order, the world first."""

    def __init__(self, arm: MjcfArm, pieces: ExportNumbers) -> None:
        super().__init__(arm.path, mjcf_bytes(arm.path))
        self.arm, self.model, self.pieces = arm, arm.model, pieces
        below = [tag for tag in self.tags if tag.name == "body" and tag.within("worldbody")]
        self.bodies = [*self.anywhere("worldbody")[:1], *below]
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

    def place(self, tag: Tag, T: Array) -> None:
        self.set(tag, _pose(T), ORIENTATIONS[1:])

    def move(self, body: int, error: Array) -> None:
        """T ← T · error for the body's own attributes, whatever frames stand around it, and in
        MuJoCo's model of the file."""
        tag, own = self.bodies[body], self.arm.local(body)
        if tag.above is not None and tag.above.name == "frame":
            own = self.stated(tag)
        self.place(tag, own @ error)
        for name, value in _pose(self.arm.local(body) @ error).items():
            getattr(self.model, f"body_{name}")[body] = np.array(value.split(), dtype=float)

    def stated(self, tag: Tag) -> Array:
        """T (4, 4) that a body's own attributes say, as MuJoCo understands them."""
        kept = {k: v for k, v in tag.stated.items() if k in ("pos", *ORIENTATIONS)}
        stated = [item for tag in self.anywhere("compiler") for item in tag.stated.items()]
        how = {k: v for k, v in stated if k in ("angle", "eulerseq")}
        world = element("worldbody", {}, element("body", kept))
        alone = element("mujoco", {}, element("compiler", how), world)
        model = import_mujoco().MjModel.from_xml_string(alone)
        return transform(model.body_pos[1], model.body_quat[1])

    def correct_joint(self, i: int, j: int) -> None:
        if nothing(correction := self.pieces.correction(i)):
            return
        body = int(self.model.jnt_bodyid[j])
        if self.arm.joints_of(body)[0] != j:
            raise NotInPlace(
                f"joint '{self.arm.joint_name(j)}' shares its body with another; give it a body of "
                "its own"
            )
        X = self.arm.before(j)
        self.move(body, X @ correction @ np.linalg.inv(X))

    def add_springs(self, i: int, j: int) -> int:
        """Put the springs between link i and joint i before the joint; returns how many."""
        pieces, model = self.pieces, self.model
        before = pieces.springs_at(f"link{i}" if i else "base")
        springs = [*before, *pieces.springs_at(f"joint{i + 1}")]
        body = int(model.jnt_bodyid[j])
        first = int(model.body_jntadr[body])
        tags = self.joints(body)
        old = [k for k in range(first, j) if model.joint(k).name.startswith(SPRING)]
        for k in old:  # of an earlier export
            self.remove(tags[k - first])
        if old and not springs:
            raise NotInPlace("springs of an earlier export would be lost")
        count = len(self.arm.joints_of(body)) + len(springs)
        if springs and count > MOST_JOINTS:
            told = f"{count} joints would stand on one body, and MuJoCo takes {MOST_JOINTS}"
            raise NotInPlace(told)
        # The springs' frame in that of the moved body: before the joint turns by its offset.
        F = self.arm.before(j) @ np.linalg.inv(pieces.offset_motion(i))
        base = F if i else F @ np.linalg.inv(pieces.placement(0))  # the base's frame there
        placed = [(s, base if s.site == "base" else F) for s in springs]
        joints = (element("joint", spring_joint(SPRING, *one) | WITHOUT_DEFAULTS) for one in placed)
        self.insert(tags[j - first].start, "".join(f"{joint} " for joint in joints))
        return len(springs) - len(old)

    def lengthen_keys(self, sprung: dict[int, int]) -> None:
        """Zeros for the new joints in the positions and velocities of keyframes."""
        for tag in self.anywhere("key", "keyframe"):
            for name, address in (
                ("qpos", self.model.jnt_qposadr),
                ("qvel", self.model.jnt_dofadr),
            ):
                if name not in tag.stated:
                    continue
                values = tag.stated[name].split()
                for j in sorted(sprung, key=lambda j: -address[j]):
                    at = int(address[j])
                    values[at:at] = ["0"] * sprung[j]
                self.set(tag, {name: " ".join(values)})

    def let_act(self) -> list[str]:
        """Let springs yield and weights act in the file, as they do in the model; what that
        changes."""
        told = self.enable("passive", "spring")
        if not self.pieces.masses:
            return told
        # Gravity along the vertical that was identified, where the file has another.
        up = self.arm.placed(self.arm.base)[:3, :3] @ self.pieces.T_tracker_base[:3, :3].T
        wanted = up @ [0.0, 0.0, -STANDARD_GRAVITY]
        if np.abs(self.model.opt.gravity - wanted).max() >= SMALLEST:
            self.set_in(self.tags[0], "option", {"gravity": numbers(wanted)})
        told += self.enable("gravity")
        moved = [b for b in range(1, self.model.nbody) if self.arm.carrier(b) is not None]
        held = [b for b in moved if self.model.body_gravcomp[b]]
        for b in held:
            self.set(self.bodies[b], {"gravcomp": "0"})
        if held:
            names = listed((self.model.body(b).name or f"body {b}" for b in held), 4)
            told.append(f"gravcomp of {names} is 0 in this file, so that weights bend the springs")
        return told

    def enable(self, *names: str) -> list[str]:
        """Switch on what <flag> of the file switches off, of these."""
        import mujoco

        told = []
        for name in names:
            bit = getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}", 0)  # as versions differ
            if self.model.opt.disableflags & int(bit):
                flags = self.anywhere("flag", "option")
                if not flags:
                    raise NotInPlace(f'its <flag {name}="disable"/> stands in another file')
                self.set(flags[-1], {name: "enable"})
                what = f"{name} is switched on in this file"
                told.append(f"{what}, so that the springs yield to weights")
        return told

    def correct_flange(self, frames: bool) -> list[str]:
        arm, pieces = self.arm, self.pieces
        error = pieces.error(pieces.chain.n_joints - 1)
        body, told, T = arm.flange, [], np.eye(4)
        sites = {tag.stated.get("name", ""): tag for tag in self.bodies[body].all("site")}
        extra: dict[str, Array] = {}
        if arm.site is not None:
            T = arm.flange_in_body @ error
            if not nothing(error):
                if arm.end_name not in sites:
                    raise NotInPlace(f"site '{arm.end_name}' stands in a <frame>")
                self.place(sites[arm.end_name], T)
        elif not nothing(error) and arm.model.body_jntnum[body] == 0:
            self.move(body, error)
        elif not nothing(error):
            T, extra = error, {FLANGE: error}
            told.append(
                f"the flange is the body that the last joint moves: the calibrated one is site "
                f"'{FLANGE}', and what hangs on '{arm.end_name}' stays where it was"
            )
        tool = tool_frames(pieces) if frames else {}
        for name, place in (extra | {n: T @ P for n, P in tool.items()}).items():
            if name in sites:
                self.place(sites[name], place)
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
        masses = zip(self.arm.joints, self.arm.masses(), self.pieces.masses, strict=False)
        for j, old, new in masses:
            mass = new.mass - old.mass
            moment = new.mass * new.com - old.mass * old.com
            if abs(mass) < SMALLEST and np.abs(moment).max() < SMALLEST:
                continue
            body = int(model.jnt_bodyid[j])
            whole = float(model.body_mass[body]) + mass
            if whole <= 0 or from_geoms:
                name = model.body(body).name
                raise NotInPlace(f"body '{name}' cannot take the mass that is missing")
            moment = (
                model.body_mass[body] * model.body_ipos[body] + moment + mass * model.jnt_pos[j]
            )
            changed = {"mass": repr(whole), "pos": numbers(moment / whole)}
            stated = {
                "quat": numbers(model.body_iquat[body]),
                "diaginertia": numbers(model.body_inertia[body]),
            }
            given = self.bodies[body].first("inertial")
            self.set_in(self.bodies[body], "inertial", changed if given else changed | stated)


def _pose(T: Array) -> dict[str, str]:
    """`pos` and `quat` of a transform (4, 4)."""
    placed = placed_body("", T)
    return {name: placed[name] for name in ("pos", "quat")}


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
