"""MuJoCo model (MJCF) → nominal chain: what MuJoCo's own compiler makes of the file.

The compiler resolves angles, defaults, frames and included files; here only bodies, joints, sites
and masses are taken from it.  Meshes are loaded where a mass follows from one, and nowhere else.
With T_b the frame of body b in its parent's, p, a and r position, axis and `ref` of a joint,

    T_parent_body(q) = T_b Π_j Trans(p_j) J(a_j, q_j − r_j) Trans(−p_j)

which is a chain whose joint frames are T_b … Trans(p_j) J(a_j, −r_j).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from elastocal.errors import InputError, require
from elastocal.files import read_bytes
from elastocal.model import rigid
from elastocal.model.chain import MAX_JOINTS, MIN_JOINTS, Chain, Joint, JointKind, LinkMass
from elastocal.model.mjcf_bounds import check_bounds
from elastocal.model.urdf import MAX_BYTES, xml_tree
from elastocal.text import did_you_mean, listed, printable
from elastocal.units import Array

WORLD = 0  # MuJoCo's number of the world body
# Springs that `elastocal export` adds; they are held at zero, so the nominal arm has none.
SPRING = "elastocal_spring_"
# MuJoCo wants masses of moving bodies; where a file's meshes are missing, these stand for them.
STAND_IN = 1e-6


def read_mjcf(path: str | Path, base: str | None = None, flange: str | None = None) -> Chain:
    """The serial chain of a MuJoCo model from the frame of `base` to that of `flange`.

    base: a body, default the world; flange: a body or a site, default as of `MjcfArm.read`.
    Placements in m, unit axes, limits in rad or m (infinite where a joint has none); one mass per
    joint in kg of all that it carries, side branches and what lies beyond the flange included,
    with its centre in the joint's frame.  There are none where the file leaves them to meshes
    that are not there.

    Raises InputError for anything `MjcfArm.read` refuses.
    """
    return MjcfArm.read(path, base, flange).chain


@dataclass(frozen=True)
class MjcfArm:
    """A compiled MuJoCo model and the way through it from `base` to `flange`.

    `base`: number of a body.  `flange`: number of the body that is the flange, or has the site
    `site` that is (None: the body).  `weighed`: the masses of the bodies are those of the file.
    """

    path: Path
    name: str
    model: Any
    base: int
    flange: int
    site: int | None
    weighed: bool

    @classmethod
    def read(
        cls,
        path: str | Path,
        base: str | None = None,
        flange: str | None = None,
        text: str | None = None,
    ) -> MjcfArm:
        """The arm of an MJCF file, or of a `text` that is to stand in its place.

        Without `flange` it is the body from which on the bodies with the most joints branch off,
        as fingers do from a hand.  Raises InputError where MuJoCo is not installed or cannot read
        the file, where a name is unknown or a choice open, and where the joints on the way are
        none that a chain has.
        """
        path = Path(path)
        data = mjcf_bytes(path) if text is None else text.encode("utf-8")
        root = xml_tree(path, data, "an MJCF file")
        hint = '; this is a URDF, give it as urdf = "…"' if root.tag == "robot" else ""
        require(
            root.tag == "mujoco",
            f"{path}: the root element is <{printable(root.tag)}>, an MJCF file has <mujoco>{hint}",
        )
        check_bounds(path, data)
        spec = parsed(path, text)
        coupled, tied = _couplings(spec)
        model, weighed = _compiled(path, spec)
        names = {model.body(i).name: i for i in range(model.nbody) if model.body(i).name}
        start = WORLD if base is None else _find(path, "base body", base, names)
        if flange is None:
            arm = cls(path, spec.modelname or path.stem, model, start, start, None, weighed)
            end, site = arm._last_body(), None
        else:
            sites = {model.site(i).name: i for i in range(model.nsite) if model.site(i).name}
            found = _find(path, "flange", flange, names | {n: -1 for n in sites if n not in names})
            site = sites[flange] if found < 0 else None
            end = found if site is None else int(model.site_bodyid[site])
        arm = cls(path, spec.modelname or path.stem, model, start, end, site, weighed)
        arm._check(coupled, tied)
        return arm

    def way(self, body: int) -> list[int]:
        """Bodies from below the base to `body`; none where it is not below the base."""
        found: list[int] = []
        while body != self.base:
            if body == WORLD:
                return []
            found.append(body)
            body = int(self.model.body_parentid[body])
        return found[::-1]

    def joints_of(self, body: int) -> list[int]:
        """The joints of a body in their order, without springs of an earlier export."""
        first = int(self.model.body_jntadr[body])
        own = range(first, first + int(self.model.body_jntnum[body]))
        return [j for j in own if not self.model.joint(j).name.startswith(SPRING)]

    @cached_property
    def joints(self) -> list[int]:
        """The moving joints from base to flange."""
        return [j for body in self.way(self.flange) for j in self.joints_of(body)]

    @property
    def end_name(self) -> str:
        """The name of the flange in the file, "" where it has none."""
        if self.site is not None:
            return str(self.model.site(self.site).name)
        return str(self.model.body(self.flange).name)

    def joint_name(self, j: int) -> str:
        """A joint's name, joint1 … in the order of the chain where the file gives none."""
        return self.model.joint(j).name or f"joint{self.joints.index(j) + 1}"

    def local(self, body: int) -> Array:
        """T_parent_body (4, 4) with all joints at `ref`."""
        return transform(self.model.body_pos[body], self.model.body_quat[body])

    def placed(self, body: int) -> Array:
        """T_world_body (4, 4) with all joints at `ref`."""
        return self._world()[body]

    def before(self, j: int) -> Array:
        """X (4, 4): the chain's frame of joint j in its body's, Trans(p) J(a, −r)."""
        kind, axis = self._kind(j), np.array(self.model.jnt_axis[j])
        ref = float(self.model.qpos0[self.model.jnt_qposadr[j]])
        turned = ca.DM(rigid.joint_motion(kind, axis, -ref)).full()
        return np.asarray(shift(self.model.jnt_pos[j]) @ turned)

    @cached_property
    def chain(self) -> Chain:
        """The nominal chain; names as in the file."""
        joints: list[Joint] = []
        T = np.eye(4)
        for body in self.way(self.flange):
            T = T @ self.local(body)
            for j in self.joints_of(body):
                lower, upper = self._limits(j)
                axis = np.array(self.model.jnt_axis[j])
                placement = T @ self.before(j)
                joints.append(
                    Joint(self.joint_name(j), self._kind(j), placement, axis, lower, upper)
                )
                T = shift(-self.model.jnt_pos[j])
        return Chain(self.name, tuple(joints), T @ self.flange_in_body, self.masses())

    @property
    def flange_in_body(self) -> Array:
        """T_body_flange (4, 4): of a site its place in its body."""
        if self.site is None:
            return np.eye(4)
        return transform(self.model.site_pos[self.site], self.model.site_quat[self.site])

    def sites(self) -> dict[str, Array]:
        """Name → place (3,) in m in the flange frame of every site that moves with the flange."""
        world = self._world()
        T = world[self.flange] @ self.flange_in_body
        found = {}
        for i in range(self.model.nsite):
            body, name = int(self.model.site_bodyid[i]), self.model.site(i).name
            if i != self.site and name and self._carrier(body) == self.joints[-1]:
                place = world[body] @ [*self.model.site_pos[i], 1.0]
                found[name] = np.linalg.solve(T, place)[:3]
        return found

    def _kind(self, j: int) -> JointKind:
        import mujoco

        slides = self.model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE
        return "prismatic" if slides else "revolute"

    def _limits(self, j: int) -> tuple[float, float]:
        if not self.model.jnt_limited[j]:
            return -np.inf, np.inf
        lower, upper = map(float, self.model.jnt_range[j])
        return lower, upper

    def _world(self) -> list[Array]:
        """`placed` for every body."""
        found = [np.eye(4)]
        for body in range(1, self.model.nbody):
            found.append(found[int(self.model.body_parentid[body])] @ self.local(body))
        return found

    def _carrier(self, body: int) -> int | None:
        """The last joint of the chain that moves a body, None where none does."""
        while body != WORLD:
            own = [j for j in self.joints_of(body) if j in self.joints]
            if own:
                return own[-1]
            body = int(self.model.body_parentid[body])
        return None

    def masses(self) -> tuple[LinkMass, ...]:
        """What each joint carries, in its frame; none where the file's meshes would state it."""
        if not self.weighed:
            return ()
        world = self._world()
        mass, moment = dict.fromkeys(self.joints, 0.0), dict.fromkeys(self.joints, np.zeros(3))
        for body in range(1, self.model.nbody):
            if (j := self._carrier(body)) is not None:
                m = float(self.model.body_mass[body])
                place = world[body] @ [*self.model.body_ipos[body], 1.0]
                frame = world[int(self.model.jnt_bodyid[j])] @ shift(self.model.jnt_pos[j])
                mass[j] += m
                moment[j] = moment[j] + m * np.linalg.solve(frame, place)[:3]
        if not any(mass.values()):
            return ()
        both = [(mass[j], moment[j]) for j in self.joints]
        return tuple(LinkMass(m, s / m if m > 0 else np.zeros(3)) for m, s in both)

    def _last_body(self) -> int:
        """The last body that all bodies with the most joints on their way have in common."""
        model = self.model
        ways = [self.way(body) for body in range(1, model.nbody)]
        counts = [sum(len(self.joints_of(b)) for b in way) for way in ways]
        most = max(counts, default=0)
        leaves = [w for w, n in zip(ways, counts, strict=True) if n == most and w]
        # A body that others go on from is on their ways and decides nothing.
        inner = {b for way in leaves for b in way[:-1]}
        ends = [way for way in leaves if way[-1] not in inner] if most else []
        common = [b for b in (ends[0] if ends else []) if all(b in way for way in ends)]
        moved = sum(len(self.joints_of(b)) for b in common)
        if moved < MIN_JOINTS:
            told = listed(model.body(way[-1]).name or f"body {way[-1]}" for way in ends) or "none"
            raise InputError(
                f"{self.path}: no single arm of {MIN_JOINTS} joints or more is found below "
                f"'{model.body(self.base).name}'; the bodies with the most joints are {told}. Name "
                "base and flange, a body or a site"
            )
        return common[-1]

    def _check(self, coupled: set[str], tied: set[str]) -> None:
        """Raise InputError unless the way is one of 4 to 9 hinges and slides of their own."""
        import mujoco

        base, end = self.model.body(self.base).name, self.end_name
        way = self.way(self.flange)
        require(
            bool(way),
            f"{self.path}: flange '{end}' is not below base '{base}'; name a body that carries it, "
            "or leave base out for the world",
        )
        for j in self.joints:
            where = f"{self.path}: joint '{self.joint_name(j)}'"
            kind = mujoco.mjtJoint(int(self.model.jnt_type[j]))
            simple = kind in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
            word = "free" if kind == mujoco.mjtJoint.mjJNT_FREE else "a ball"
            require(
                simple,
                f"{where} is {word} joint between base and flange; only hinges and slides can be, "
                "name a base below it",
            )
            require(
                self.model.joint(j).name not in coupled,
                f"{where} is coupled by <equality>; coupled joints are not supported between base "
                "and flange, remove the constraint or choose another flange",
            )
            lower, upper = self._limits(j)
            require(
                lower < upper,
                f"{where}: range {lower:g} {upper:g} leaves no room to move; correct it",
            )
        for body in way[:-1]:
            name = self.model.body(body).name
            require(
                not name or name not in tied,
                f"{self.path}: body '{name}' is part of a closed loop (<equality><connect>); loops "
                "are not supported between base and flange",
            )
        names = [self.joint_name(j) for j in self.joints]
        require(
            MIN_JOINTS <= len(names) <= MAX_JOINTS,
            f"{self.path}: {len(names)} joints between '{base}' and '{end}' "
            f"({listed(names) or 'none'}); {MIN_JOINTS} to {MAX_JOINTS} are supported, name base "
            "and flange accordingly",
        )


def transform(position: Sequence[float] | Array, quaternion: Sequence[float] | Array) -> Array:
    """(4, 4) of a position (3,) in m and a quaternion (w, x, y, z)."""
    from scipy.spatial.transform import Rotation

    w, x, y, z = quaternion
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), position
    return T


def shift(position: Sequence[float] | Array) -> Array:
    """Trans(p) (4, 4)."""
    return transform(position, (1.0, 0.0, 0.0, 0.0))


def import_mujoco(what: str = "a MuJoCo model") -> Any:
    """The package, which `what` needs; InputError where it is not installed."""
    try:
        import mujoco
    except ImportError:
        raise InputError(
            f"{what} needs MuJoCo, which is not installed; run: pip install elastocal[mujoco]"
        ) from None
    return mujoco


def mjcf_bytes(path: Path) -> bytes:
    """The content of an MJCF file.  Raises InputError where it cannot be read or is too large."""
    return read_bytes(path, "MuJoCo model", MAX_BYTES)


def parsed(path: Path, text: str | None = None) -> Any:
    """MuJoCo's MjSpec of a file, or of a `text` that is to stand in its place."""
    mujoco = import_mujoco()
    try:
        if text is None:
            return mujoco.MjSpec.from_file(str(path))
        names = re.findall(r"""<include\s[^>]*?file\s*=\s*["']([^"']+)["']""", text)
        inside = {n: mjcf_bytes(path.parent / n) for n in names if (path.parent / n).is_file()}
        spec = mujoco.MjSpec.from_string(text, include=inside)
        spec.modelfiledir = f"{path.parent}/"
        return spec
    except ValueError as error:
        raise InputError(f"{path}: MuJoCo cannot read it: {_sentence(error)}") from None


def _sentence(error: Exception) -> str:
    return "; ".join(line.strip() for line in str(error).splitlines() if line.strip())


def _couplings(spec: Any) -> tuple[set[str], set[str]]:
    """Joints that others drive, and bodies of closed loops, as <equality> states them."""
    import mujoco

    coupled, tied = set(), set()
    for one in spec.equalities:
        if one.active and one.type == mujoco.mjtEq.mjEQ_JOINT:
            coupled.add(one.name1)
        elif one.active and one.type == mujoco.mjtEq.mjEQ_CONNECT:
            tied |= {one.name1, one.name2}
    return coupled, tied


def _compiled(path: Path, spec: Any) -> tuple[Any, bool]:
    """The model without what is to be seen or to move it, and whether its masses are the file's."""
    import mujoco

    for kept in ("fusestatic", "discardvisual"):
        setattr(spec.compiler, kept, 0)
    from_geoms = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    # The geoms of a body that states its inertia say nothing more.
    idle = [] if from_geoms else [g for b in spec.bodies if b.explicitinertial for g in b.geoms]
    strip(spec, idle)
    try:
        return spec.compile(), True
    except ValueError as error:
        first = error
    strip(spec, list(spec.geoms))
    spec.compiler.boundmass = spec.compiler.boundinertia = STAND_IN
    try:
        return spec.compile(), False
    except ValueError:
        raise InputError(f"{path}: MuJoCo cannot read it: {_sentence(first)}") from None


def strip(spec: Any, geoms: Iterable[Any]) -> None:
    """Take out geoms, and all that frames and masses do without."""
    for geom in geoms:
        spec.delete(geom)
    for one in (*spec.geoms, *spec.sites):
        one.material = ""
    meshes = {geom.meshname for geom in spec.geoms}
    for kind in (
        "keys", "sensors", "actuators", "tendons", "equalities", "pairs", "excludes", "tuples",
        "skins", "flexes", "materials", "textures",
    ):  # fmt: skip
        for one in list(getattr(spec, kind)):
            spec.delete(one)
    for mesh in list(spec.meshes):
        if mesh.name not in meshes:
            spec.delete(mesh)


def _find(path: Path, role: str, name: str, there: dict[str, int]) -> int:
    require(
        name in there,
        f"{path}: {role} '{name}' is not there{did_you_mean(name, there)}; there are "
        f"{listed(there)}",
    )
    return there[name]
