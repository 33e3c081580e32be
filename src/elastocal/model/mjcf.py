"""MuJoCo model (MJCF) → nominal chain: what MuJoCo's own compiler makes of the file.

The compiler resolves angles, defaults, frames and included files; here only bodies, joints, sites
and masses are taken from it.  Meshes are loaded where a mass follows from one, and nowhere else.
With T_b the frame of body b in its parent's, p, a and r position, axis and `ref` of a joint,

    T_parent_body(q) = T_b Π_j Trans(p_j) J(a_j, q_j − r_j) Trans(−p_j)

which is a chain whose joint frames are T_b … Trans(p_j) J(a_j, −r_j).
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from elastocal.errors import InputError, require
from elastocal.files import read_bytes
from elastocal.model import rigid
from elastocal.model.chain import (
    MAX_JOINTS,
    MIN_JOINTS,
    Chain,
    Joint,
    JointKind,
    LinkMass,
    check_angles,
)
from elastocal.model.effects.loads import STANDARD_GRAVITY
from elastocal.model.urdf import MOST_IN_A_FINGER
from elastocal.model.xml_file import MAX_BYTES, as_utf8, check_bounds, xml_tree
from elastocal.text import did_you_mean, listed, printable
from elastocal.units import Array

WORLD = 0  # MuJoCo's number of the world body
# Springs that `elastocal export` adds; they are held at zero, so the nominal arm has none.
SPRING = "elastocal_spring_"
# MuJoCo wants masses of moving bodies; where a file's meshes are missing, these stand for them.
STAND_IN = 1e-6
SMALLEST_GRAVITY = 1e-3  # m/s²; below it there is none


def read_mjcf(path: str | Path, base: str | None = None, flange: str | None = None) -> Chain:
    """The serial chain of a MuJoCo model from the frame of `base` to that of `flange`.

    base: a body, default the world; flange: a body or a site, default as of `MjcfArm.read`.
    Placements in m, unit axes, limits in rad or m (infinite where a joint has none); one mass per
    joint in kg of all that it carries, side branches and what lies beyond the flange included,
    with its centre in the joint's frame.  There are none where the file leaves them to meshes
    that are not there.
    """
    return MjcfArm.read(path, base, flange).chain


@dataclass(frozen=True)
class MjcfArm:
    """A compiled MuJoCo model and the way through it from `base` to `flange`.

    `base`: number of a body.  `flange`: number of the body that is the flange, or has the site
    `site` that is (None: the body).  `unweighed`: bodies whose masses meshes that are not there
    would state.  `notes`: what MuJoCo and the reader say of the file.
    """

    path: Path
    name: str
    model: Any
    base: int
    flange: int
    site: int | None
    unweighed: frozenset[int] = frozenset()
    notes: tuple[str, ...] = ()

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
        if text is None and (path.suffix.lower() != ".xml" or as_utf8(path, data) != data):
            # MuJoCo's reader takes .xml in UTF-8 alone.
            text = as_utf8(path, data).decode("utf-8-sig")
        hint = '; this is a URDF, give it as urdf = "…"' if root.tag == "robot" else ""
        require(
            root.tag == "mujoco",
            f"{path}: the root element is <{printable(root.tag)}>, an MJCF file has <mujoco>{hint}",
        )
        check_bounds(path, data)
        spec = parsed(path, text)
        _check_units(path, spec)
        ties = ties_of(spec)
        model, unweighed, notes = _compiled(path, spec)
        names = {model.body(i).name: i for i in range(model.nbody) if model.body(i).name}
        start = WORLD if base is None else _find(path, "base body", base, names)
        if flange is None:
            arm = cls(path, spec.modelname or path.stem, model, start, start, None)
            end, site = arm._last_body(), None
        else:
            sites = {model.site(i).name: i for i in range(model.nsite) if model.site(i).name}
            found = _find(path, "flange", flange, names | {n: -1 for n in sites if n not in names})
            site = sites[flange] if found < 0 else None
            end = found if site is None else int(model.site_bodyid[site])
        arm = cls(
            path, spec.modelname or path.stem, model, start, end, site, unweighed, tuple(notes)
        )
        arm._check()
        check_open(arm, ties)
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
        return [j for body in self.way(self.flange) for j in self.joints_of(body)]

    @property
    def end_name(self) -> str:
        if self.site is not None:
            return str(self.model.site(self.site).name)
        return str(self.model.body(self.flange).name)

    def joint_name(self, j: int) -> str:
        """A joint's name, joint1 … in the order of the chain where the file gives none."""
        return self.model.joint(j).name or f"joint{self.joints.index(j) + 1}"

    def named(self, bodies: Iterable[int]) -> str:
        return listed((self.model.body(b).name or f"body {b}" for b in bodies), 4)

    def weightless(self) -> list[int]:
        """Moved bodies whose weight `gravcomp` of the file carries."""
        bodies = range(1, self.model.nbody)
        return [b for b in bodies if self.carrier(b) is not None and self.model.body_gravcomp[b]]

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
        masses = self.masses()
        notes = (*self.notes, *(self._weights_told() if masses else ()))
        return Chain(self.name, tuple(joints), T @ self.flange_in_body, masses, notes)

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
            if i != self.site and name and self.carrier(body) == self.joints[-1]:
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

    def carrier(self, body: int) -> int | None:
        """The last joint of the chain that moves a body, None where none does."""
        while body != WORLD:
            own = [j for j in self.joints_of(body) if j in self.joints]
            if own:
                return own[-1]
            body = int(self.model.body_parentid[body])
        return None

    def masses(self) -> tuple[LinkMass, ...]:
        """What each joint carries, in its frame; none where meshes that are not there would state
        the mass of a body between base and flange."""
        if self.unweighed.intersection(self.way(self.flange)):
            return ()
        world = self._world()
        mass, moment = dict.fromkeys(self.joints, 0.0), dict.fromkeys(self.joints, np.zeros(3))
        for body in range(1, self.model.nbody):
            if body not in self.unweighed and (j := self.carrier(body)) is not None:
                m = float(self.model.body_mass[body])
                place = world[body] @ [*self.model.body_ipos[body], 1.0]
                frame = world[int(self.model.jnt_bodyid[j])] @ shift(self.model.jnt_pos[j])
                mass[j] += m
                moment[j] = moment[j] + m * np.linalg.solve(frame, place)[:3]
        if not any(mass.values()):
            return ()
        both = [(mass[j], moment[j]) for j in self.joints]
        return tuple(LinkMass(m, s / m if m > 0 else np.zeros(3)) for m, s in both)

    def upright(self) -> tuple[Array, str]:
        """Rotation (3, 3) of the file's world that turns its gravity down, and who says so."""
        gravity = np.array(self.model.opt.gravity)
        size = float(np.linalg.norm(gravity))
        base = f"body '{self.model.body(self.base).name}'"
        if size < SMALLEST_GRAVITY:
            return np.eye(3), "guess: the file has no gravity; its z is taken as up"
        up = -gravity / size
        if np.abs(up - [0.0, 0.0, 1.0]).max() < 1e-9:
            return np.eye(3), f"of {base} in the file, z up"
        return _turn(up), f"of {base}, up against the file's gravity"

    def _weights_told(self) -> list[str]:
        """Sentences on weights that the file does not state, or does not let act."""
        import mujoco

        model, found = self.model, []
        size = float(np.linalg.norm(model.opt.gravity))
        if size < SMALLEST_GRAVITY or model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
            found.append("the file switches gravity off, while link_gravity = true lets it act")
        elif abs(size - STANDARD_GRAVITY) > 0.05:
            found.append(
                f"the file's gravity is {size:.4g} m/s², while weights act here with "
                f"{STANDARD_GRAVITY:.4g} m/s²"
            )
        if held := self.weightless():
            names = self.named(held)
            found.append(
                f"gravcomp of the file carries the weight of {names}: in MuJoCo nothing sags "
                "there, while link_gravity = true bends the joints"
            )
        return found

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
            most_of = [model.body(way[-1]).name or f"body {way[-1]}" for way in ends]
            have = "have" if len(most_of) > 1 else "has"
            told = f"; {listed(most_of)} {have} the most joints" if most_of else ""
            raise InputError(
                f"{self.path}: no single arm of {MIN_JOINTS} joints or more is found below "
                f"'{model.body(self.base).name}'{told}. Name base and flange, a body or a site"
            )
        # Fingers of unequal length, as a thumb has: no body is common to those with most joints.
        for body in common[:-1]:
            after = sum(len(self.joints_of(b)) for b in common[common.index(body) + 1 :])
            beside = {way[way.index(body) + 1] for way in ways if body in way[:-1]} - {*common}
            fingers = [b for b in beside if any(b in w and n > moved - after
                       for w, n in zip(ways, counts, strict=True))]  # fmt: skip
            if moved - after >= MIN_JOINTS and 0 < after <= MOST_IN_A_FINGER and len(fingers) > 1:
                return body
        return common[-1]

    def _check(self) -> None:
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
            lower, upper = self._limits(j)
            require(
                lower < upper,
                f"{where}: range {lower:g} {upper:g} leaves no room to move; correct it",
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
    with _quiet(), _refusals(path):
        if text is None:
            return mujoco.MjSpec.from_file(str(path))
        names = re.findall(r"""<include\s[^>]*?file\s*=\s*["']([^"']+)["']""", text)
        inside = {n: mjcf_bytes(path.parent / n) for n in names if (path.parent / n).is_file()}
        spec = mujoco.MjSpec.from_string(text, include=inside)
        spec.modelfiledir = f"{path.parent}/"
        return spec


@contextmanager
def _refusals(path: Path) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise InputError(f"{path}: MuJoCo cannot read it: {_sentence(error)}") from None


@contextmanager
def _quiet() -> Iterator[list[warnings.WarningMessage]]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        yield found


def compiled(spec: Any) -> tuple[Any, list[str]]:
    """MuJoCo's model of a spec, and its warnings.  Raises ValueError as it does."""
    with _quiet() as found:
        model = spec.compile()
    return model, [f"MuJoCo warns: {str(one.message).splitlines()[0]}" for one in found]


def _sentence(error: Exception) -> str:
    return "; ".join(line.strip() for line in str(error).splitlines() if line.strip())


def _turn(up: Array) -> Array:
    """The least rotation (3, 3) that takes the unit vector `up` to z."""
    from scipy.spatial.transform import Rotation

    axis = np.cross(up, [0.0, 0.0, 1.0])
    size = float(np.linalg.norm(axis))
    axis = axis / size if size > 1e-9 else np.array([1.0, 0.0, 0.0])
    return Rotation.from_rotvec(math.atan2(size, up[2]) * axis).as_matrix()


def _check_units(path: Path, spec: Any) -> None:
    """Raise InputError where the file's angles are in rad and no rad can be so large."""
    import mujoco

    kinds = mujoco.mjtOrientation
    for kind in ("body", "frame", "site") if not spec.compiler.degree else ():
        for one in getattr(spec, {"body": "bodies"}.get(kind, f"{kind}s")):
            stated = {kinds.mjORIENTATION_EULER: one.alt.euler}
            stated[kinds.mjORIENTATION_AXISANGLE] = one.alt.axisangle[3:]
            check_angles(
                f"{path}: {kind} '{one.name}'", tuple(map(float, stated.get(one.alt.type, ()))),
                'its compiler states angle="radian"',
            )  # fmt: skip


def _compiled(path: Path, spec: Any) -> tuple[Any, frozenset[int], list[str]]:
    """The model without what is to be seen or to move it, the bodies whose masses are not known as
    meshes are not there, and what to know of it."""
    import mujoco

    for kept in ("fusestatic", "discardvisual"):
        setattr(spec.compiler, kept, 0)
    from_geoms = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    # The geoms of a body that states its inertia say nothing more.
    stated = [] if from_geoms else [b for b in spec.bodies if b.explicitinertial]
    strip(spec, [g for b in stated for g in b.geoms])
    first: ValueError | None = None
    missing = _missing_meshes(path, spec)
    for lost in (missing, None):  # those, then all
        try:  # a spec that could not be compiled says so again at whatever is asked of it
            geoms = [g for g in spec.geoms if lost is None or g.meshname in lost]
            open_ = [b for b in spec.bodies if b not in stated and any(g in geoms for g in b.geoms)]
            strip(spec, geoms)
            if geoms:
                spec.compiler.boundmass = spec.compiler.boundinertia = STAND_IN
            model, notes = compiled(spec)
        except ValueError as error:
            first = first or error
            continue
        unweighed = frozenset(b.id for b in open_)
        if unweighed:
            names = listed((b.name or f"body {b.id}" for b in open_), 4)
            files = listed(missing.values(), 3) or "meshes that MuJoCo can read"
            lack = "is" if len(missing) == 1 else "are"
            notes.append(
                f"{files} {lack} missing, which would state the mass of {names}: taken as 0"
            )
        return model, unweighed, notes
    raise InputError(f"{path}: MuJoCo cannot read it: {_sentence(first or ValueError())}")


def _missing_meshes(path: Path, spec: Any) -> dict[str, str]:
    """Meshes that geoms use and whose files are not there: name → file."""
    used = {geom.meshname for geom in spec.geoms}
    folder = path.parent / (spec.compiler.meshdir or "")
    return {
        mesh.name: mesh.file
        for mesh in spec.meshes
        if mesh.name in used and mesh.file and not (folder / mesh.file).is_file()
    }


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


# Closed loops: <equality> that ties joints of the arm to each other.
#
# A chain of independent joints is read from the file, so none of them may depend on another.
# Bodies that constraints tie, directly or over bodies that float (<freejoint>, mocap), have to be
# carried by the same joint of the arm: otherwise those between are part of a loop.  Constraints on
# joint values (joint, fixed tendon) take one degree of freedom each: they bind the arm where a
# group of joints has more of them than joints beside the arm.

Tied = TypeVar("Tied", bound=Hashable)


@dataclass(frozen=True)
class Tie:
    """A constraint: pairs of `ends`, each (body or site, name), or the `joints` that it ties."""

    kind: str
    name: str
    ends: tuple[tuple[tuple[str, str], tuple[str, str]], ...] = ()
    joints: tuple[str, ...] = ()

    def __str__(self) -> str:
        tied = listed(f"'{name}'" for name in self.joints) or " and ".join(
            dict.fromkeys(f"{k} '{name or 'world'}'" for pair in self.ends for k, name in pair)
        )
        name = f" '{self.name}'" if self.name else ""
        return f"<equality><{self.kind}>{name} of {tied}"


def ties_of(spec: Any) -> list[Tie]:
    """The active constraints of a file, from MuJoCo's MjSpec of it."""
    import mujoco

    eq, found = mujoco.mjtEq, []
    tendons = {tendon.name: tendon for tendon in spec.tendons}
    for one in spec.equalities:
        names = [name for name in (one.name1, one.name2) if name]
        if not one.active:
            continue
        if one.type in (eq.mjEQ_CONNECT, eq.mjEQ_WELD):
            kind = "connect" if one.type == eq.mjEQ_CONNECT else "weld"
            what = "site" if one.objtype == mujoco.mjtObj.mjOBJ_SITE else "body"
            found.append(Tie(kind, one.name, (((what, one.name1), (what, one.name2)),)))
        elif one.type == eq.mjEQ_JOINT:
            found.append(Tie("joint", one.name, joints=tuple(names)))
        elif one.type == eq.mjEQ_TENDON:
            found += _of_tendons(one.name, [tendons[name] for name in names])
    return found


def _of_tendons(name: str, tendons: list[Any]) -> list[Tie]:
    """A tendon over joints ties these, one between sites their bodies."""
    import mujoco

    joints, ends = [], []
    for tendon in tendons:
        before = ""
        for wrap in getattr(tendon, "path", ()):
            if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT:
                joints.append(wrap.target.name)
            elif wrap.type == mujoco.mjtWrap.mjWRAP_SITE:
                if before:
                    ends.append((("site", before), ("site", wrap.target.name)))
                before = wrap.target.name
    ties = [Tie("tendon", name, joints=tuple(joints))] if joints else []
    return ties + ([Tie("tendon", name, ends=tuple(ends))] if ends else [])


def check_open(arm: Any, ties: list[Tie]) -> None:
    """Raise InputError, naming constraint and joints, where an `MjcfArm` is no open chain.

    A weld of what the last joint carries to the world or to a mocap body is no loop of the arm's:
    people drag the flange by it.
    """
    _check_values(arm, [tie for tie in ties if tie.joints])
    free, order = _floating(arm), {None: -1} | {j: k for k, j in enumerate(arm.joints)}
    tied = ((pair, tie) for tie in ties for pair in _bodies(arm, tie))
    for bodies, members in _groups(tied):
        carriers = {order[arm.carrier(body)] for body in bodies - free}
        if len(carriers) > 1:
            joint = arm.joint_name(arm.joints[min(carriers) + 1])
            raise InputError(
                f"{arm.path}: joint '{joint}' is part of a closed loop, by "
                f"{listed(map(str, dict.fromkeys(members)))}; loops are not supported between base "
                "and flange, remove the constraint or choose another flange"
            )


def _groups(ties: Iterable[tuple[Iterable[Tied], Tie]]) -> list[tuple[set[Tied], list[Tie]]]:
    """What constraints tie to each other, with the constraints that do."""
    groups: list[tuple[set[Tied], list[Tie]]] = []
    for what, tie in ties:
        names, members = set(what), [tie]
        for other in [g for g in groups if g[0] & names]:
            groups.remove(other)
            names, members = names | other[0], other[1] + members
        groups.append((names, members))
    return groups


def _check_values(arm: Any, ties: list[Tie]) -> None:
    own = {arm.model.joint(j).name for j in arm.joints} - {""}
    for names, members in _groups((tie.joints, tie) for tie in ties):
        # joint1 of <joint> follows joint2, as a mimic does in a URDF.
        follows = [tie for tie in members if tie.kind == "joint" and tie.joints[0] in own]
        bound = names & own and len(members) > len(names - own)
        coupled, several = sorted(names & own), len(names & own) > 1
        require(
            not follows and not bound,
            f"{arm.path}: joint{'s' * several} {listed(map(repr, coupled))} "
            f"{'are' if several else 'is'} coupled by "
            f"{listed(map(str, follows or members))}; coupled joints are not supported between "
            "base and flange, remove the constraint or choose another flange",
        )


def _bodies(arm: Any, tie: Tie) -> list[tuple[int, int]]:
    """The pairs of bodies that a constraint ties, without those that leave the arm open."""
    model, found = arm.model, []
    for ends in tie.ends:
        a, b = (
            WORLD if not name
            else int(model.site_bodyid[model.site(name).id]) if kind == "site"
            else int(model.body(name).id)
            for kind, name in ends
        )  # fmt: skip
        at_end = [arm.carrier(body) == arm.joints[-1] for body in (a, b)]
        still = [model.body_weldid[body] == WORLD for body in (a, b)]
        dragged = (at_end[0] and still[1]) or (at_end[1] and still[0])
        if not (tie.kind == "weld" and dragged):
            found.append((a, b))
    return found


def _floating(arm: Any) -> set[int]:
    import mujoco

    model, free = arm.model, mujoco.mjtJoint.mjJNT_FREE
    loose = {int(model.jnt_bodyid[j]) for j in range(model.njnt) if model.jnt_type[j] == free}
    return loose | {b for b in range(model.nbody) if model.body_mocapid[b] >= 0}
