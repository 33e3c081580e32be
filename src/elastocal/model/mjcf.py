"""MuJoCo model (MJCF) → the links and joints of a robot: what MuJoCo's own compiler makes of it.

The compiler resolves angles, defaults, frames and included files; here only bodies, joints, sites
and masses are taken from it.  Meshes are loaded where a mass follows from one, and nowhere else.
With T_b the frame of body b in its parent's, p, a and r position, axis and `ref` of a joint,

    T_parent_body(q) = T_b Π_j Trans(p_j) J(a_j, q_j − r_j) Trans(−p_j)

so that X_j = Trans(p_j) J(a_j, −r_j) is the frame of joint j at zero in its body's.  Behind each
joint stands a link without mass, and the body on the last one.
"""

from __future__ import annotations

import copy
import math
import os
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # whose `spatial` loads where it is used

from elastocal.files import check_size
from elastocal.messages import InputError, listed, printable, quoted, require
from elastocal.model import rigid
from elastocal.model.chain import Chain, LinkMass, check_angles
from elastocal.model.effects.statics import STANDARD_GRAVITY
from elastocal.model.urdf import MAX_BYTES, MOVING, FileJoint, Tag, Tree, XmlFile
from elastocal.units import Array, pose_at

WORLD = 0  # MuJoCo's number of the world body
# Springs that `elastocal export` adds to a file, and those in a new one, which has the site AXES;
# they are held at zero, so the nominal arm has none.
SPRING, SPRING_OF_NEW, AXES = "elastocal_spring_", "spring_", "tracker_axes"
# MuJoCo wants masses of moving bodies; where a file's meshes are missing, these stand for them.
STAND_IN = 1e-6
MOST_MESH_BYTES = 100_000_000  # a larger one is taken as missing
SMALLEST_GRAVITY = 1e-3  # m/s²; below it there is none


def read_mjcf(path: str | Path, base: str | None = None, flange: str | None = None) -> Chain:
    """The serial chain of a MuJoCo model from the frame of `base`, a body, default the world, to
    that of `flange`, a body or a site, default as of `MjcfArm.read`.  There are no masses where the
    file leaves them to meshes that are not there."""
    return MjcfArm.read(path, base, flange).chain


@dataclass(frozen=True)
class MjcfArm:
    """A compiled MuJoCo model, its links and joints, and the names of base and flange.  `bodies`:
    names of links by the number of the body, which for one without a name is "body 5".
    `unweighed`: numbers of those whose masses meshes that are not there would state. `told`: what
    MuJoCo and the reader say of the file."""

    model: Any
    tree: Tree
    base: str
    flange: str
    bodies: tuple[str, ...]
    unweighed: frozenset[int]
    told: tuple[str, ...]

    @classmethod
    def read(
        cls, path: str | Path, base: str | None = None, flange: str | None = None,
        text: str | None = None,
    ) -> MjcfArm:  # fmt: skip
        """The arm of an MJCF file, or of a `text` in its place; without `flange` it is
        `Tree.last_link`."""
        path = Path(path)
        if text is None:
            file = XmlFile.read(path, "MuJoCo model", "an MJCF file")
            if path.suffix.lower() != ".xml" or file.data != path.read_bytes():
                # MuJoCo's reader takes .xml in UTF-8 alone.
                text = file.data.decode("utf-8-sig")
        else:
            file = XmlFile(path, text.encode("utf-8"), "an MJCF file")
        root = file.root.name
        hint = '; this is a URDF, give it as urdf = "…"' * (root == "robot")
        wrong = f"{path}: the root element is <{printable(root)}>, an MJCF file has <mujoco>{hint}"
        require(root == "mujoco", wrong)
        check_bounds(file)
        spec = parsed(path, text)
        _check_units(path, spec)
        model, unweighed, told = _compiled(path, spec)
        bodies = tuple(model.body(b).name or f"body {b}" for b in range(model.nbody))
        tree = _tree(path, spec.modelname or path.stem, model, bodies, unweighed)
        arm = cls(model, tree, *tree.ends(base, flange), bodies, unweighed, tuple(told))
        arm.check_open()
        if pulling := arm.pulling(file):
            spring = f"tendon {listed(map(repr, pulling), 4)} of the file pulls at the arm"
            why = "which is not read; if the arm has such a spring, fit gravity_compensator"
            arm = replace(arm, told=(*arm.told, f"{spring}, {why}"))
        return arm

    @cached_property
    def moving(self) -> tuple[FileJoint, ...]:
        return self.tree.serial_chain(self.base, self.flange)

    @property
    def joints(self) -> list[int]:
        return [joint.number for joint in self.moving]

    @cached_property
    def _carriers(self) -> dict[str, tuple[int, Array]]:
        return self.tree.carriers(self.moving)

    @property
    def flange_at(self) -> tuple[int, Array]:
        """The number of the body that carries the flange, and its place (4, 4) there."""
        link, T = self.tree.link_of(self.flange)
        return self.bodies.index(link), T

    def pulling(self, file: XmlFile) -> list[str]:
        """Tendons of a file that are springs from one link of the arm, or its base, to another."""
        found = []
        for tag in (tag for one in file.root.all("tendon") for tag in one.all("spatial")):
            sites = (self.tree.frames.get(site.get("site")) for site in tag.all("site"))
            ends = {self._carriers.get(site[0], (-1,))[0] for site in sites if site}
            if len(ends) > 1 and any(_numbers(tag.get("stiffness"))):
                found.append(tag.get("name"))
        return found

    def weightless(self) -> list[int]:
        """Moved bodies whose weight `gravcomp` of the file carries."""
        held = np.flatnonzero(self.model.body_gravcomp)
        return [int(b) for b in held if self.bodies[b] in self._carriers]

    @cached_property
    def chain(self) -> Chain:
        found = self.tree.chain(self.base, self.flange)
        way = {joint.child for joint in self.tree.joints_between(self.base, self.flange)}
        if any(self.bodies[b] in way for b in self.unweighed):
            found = replace(found, masses=())
        told = self._weights_told() if found.masses else ()
        return replace(found, notes=(*self.told, *told))

    def upright(self) -> tuple[Array, str]:
        """Rotation (3, 3) of the file's world that turns its gravity down, and who says so."""
        size = float(np.linalg.norm(self.model.opt.gravity))
        if size < SMALLEST_GRAVITY:
            return np.eye(3), "guess: the file has no gravity; its z is taken as up"
        up = -np.array(self.model.opt.gravity) / size
        if np.abs(up - [0.0, 0.0, 1.0]).max() < 1e-9:
            return np.eye(3), f"of body '{self.base}' in the file, z up"
        # The shortest turn; about x where the file stands on its head.
        turn = np.diag([1.0, -1.0, -1.0])
        if np.abs(up[:2]).max() > 1e-9:
            Rotation = scipy.spatial.transform.Rotation
            turn = Rotation.align_vectors([0.0, 0.0, 1.0], up)[0].as_matrix()
        return turn, f"of body '{self.base}', up against the file's gravity"

    def _weights_told(self) -> list[str]:
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
            names = listed((self.bodies[b] for b in held), 4)
            found.append(
                f"gravcomp of the file carries the weight of {names}: in MuJoCo nothing sags "
                "there, while link_gravity = true bends the joints"
            )
        return found

    def check_open(self) -> None:
        """InputError, naming joints and constraints, where <equality> of the file makes joints of
        the arm depend on each other: a chain of independent joints is read from it.

        J of all constraints has columns of the arm's joints and of others, as those of free bodies
        and passive rods.  With N the left null space of J_others, N J_arm is what no motion of
        these makes good: zero where the arm is an open chain.
        """
        import mujoco

        model, own = copy.copy(self.model), self.model.jnt_dofadr[self.joints]
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        data = mujoco.MjData(model)
        mujoco.mj_fwdPosition(model, data)
        rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        rows &= ~np.isin(data.efc_id, [e for e in range(model.neq) if self._drags(e)])
        J, which = data.efc_J.reshape(-1, model.nv)[rows], data.efc_id[rows]
        springs = [j for j in range(model.njnt) if is_spring(model, j)]
        others = np.delete(J, [*own, *model.jnt_dofadr[springs]], axis=1)
        beside = np.hstack([others, np.zeros((len(J), 1))])
        N = scipy.linalg.null_space(beside.T).T if len(J) else J[:0, :0]
        left = N @ J[:, own] if len(J) else np.zeros((0, len(own)))
        if np.abs(left).max(initial=0.0) < BOUND:
            return
        bound, joints = np.abs(left) >= BOUND, self.chain.joints
        tied = [repr(joints[k].name) for k in np.flatnonzero(bound.any(axis=0))]
        weight = np.abs(N[bound.any(axis=1)]).max(axis=0)
        told = listed(_constraint(model, e) for e in dict.fromkeys(which[weight >= BOUND]))
        they = f"joints {listed(tied)} are" if len(tied) > 1 else f"joint {tied[0]} is"
        raise InputError(
            f"{self.tree.path}: {they} bound by {told}; coupled joints and closed loops "
            "are not supported between base and flange, remove the constraint or choose another "
            "flange"
        )

    def _drags(self, e: int) -> bool:
        """Whether a constraint holds what the last joint carries, or any body, to where people drag
        it: a mocap body, and by a weld the world."""
        import mujoco

        model, kinds = self.model, mujoco.mjtEq
        kind = kinds(int(model.eq_type[e]))
        if kind not in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
            return False
        ends = [int(model.eq_obj1id[e]), int(model.eq_obj2id[e])]
        if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
            ends = [int(model.site_bodyid[site]) for site in ends]
        last = [self._carriers.get(self.bodies[b], (-1,))[0] == len(self.joints) - 1 for b in ends]
        still = [model.body_weldid[b] == WORLD for b in ends]
        held = any(one and other for one, other in zip(last, still[::-1], strict=True))
        return any(model.body_mocapid[b] >= 0 for b in ends) or (held and kind == kinds.mjEQ_WELD)


BOUND = 1e-6  # of m or rad per rad or m; what is less is rounding


def _constraint(model: Any, e: int) -> str:
    """ "<equality><weld> 'name' of body 'a' and body 'b'"."""
    import mujoco

    kind = mujoco.mjtEq(int(model.eq_type[e])).name.removeprefix("mjEQ_").lower()
    sites = model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE
    what = kind if kind in ("joint", "tendon") else "site" if sites else "body"
    ends = (int(i) for i in (model.eq_obj1id[e], model.eq_obj2id[e]) if i >= 0)
    names = " and ".join(f"{what} {getattr(model, what)(i).name!r}" for i in ends)
    own = f" '{name}'" if (name := model.equality(e).name) else ""
    return f"<equality><{kind}>{own} of {names}"


def _tree(
    path: Path, name: str, model: Any, bodies: Sequence[str], unweighed: Iterable[int]
) -> Tree:
    links = {bodies[WORLD]: LinkMass(0.0, np.zeros(3))}
    joints = []
    for b in range(1, model.nbody):
        parent = bodies[int(model.body_parentid[b])]
        T = transform(model.body_pos[b], model.body_quat[b])
        for j in joints_of(model, b):
            child = f"{bodies[b]} after joint {j}"
            links[child] = LinkMass(0.0, np.zeros(3))
            joints.append(_joint(model, j, parent, child, T))
            parent, T = child, pose_at(-model.jnt_pos[j])
        joints.append(FileJoint("", "fixed", parent, bodies[b], T, np.zeros(3)))
        mass = 0.0 if b in unweighed else float(model.body_mass[b])
        links[bodies[b]] = LinkMass(mass, np.array(model.body_ipos[b]))
    frames = {
        site: (bodies[model.site_bodyid[i]], transform(model.site_pos[i], model.site_quat[i]))
        for i in range(model.nsite)
        if (site := model.site(i).name) and site not in links
    }
    return Tree(path, name, links, tuple(joints), "bodies and sites", frames)


KINDS = "free", "a ball joint", "prismatic", "revolute"  # of joints, as MuJoCo numbers them


def _joint(model: Any, j: int, parent: str, child: str, T: Array) -> FileJoint:
    name, kind = model.joint(j).name, KINDS[model.jnt_type[j]]
    if kind not in MOVING:
        return FileJoint(name, kind, parent, child, T, np.zeros(3), number=j)
    # A range that does not limit is that of commands, as `export` writes it.
    stated = model.jnt_limited[j] or model.jnt_range[j].any()
    lower, upper = map(float, model.jnt_range[j] if stated else (-np.inf, np.inf))
    return FileJoint(
        name, kind, parent, child, T @ before(model, j), np.array(model.jnt_axis[j]),
        (lower, upper), rest=float(model.qpos0[model.jnt_qposadr[j]]), number=j,
    )  # fmt: skip


def joints_of(model: Any, body: int) -> list[int]:
    """The joints of a body in their order, without springs of an earlier export."""
    first = int(model.body_jntadr[body])
    own = range(first, first + int(model.body_jntnum[body]))
    return [j for j in own if not is_spring(model, j)]


def is_spring(model: Any, j: int) -> bool:
    made = any(model.site(i).name == AXES for i in range(model.nsite))
    return bool(model.joint(j).name.startswith((SPRING, SPRING_OF_NEW) if made else SPRING))


def before(model: Any, j: int) -> Array:
    """X (4, 4): the frame of joint j at zero in its body's, Trans(p) J(a, −r)."""
    rest = float(model.qpos0[model.jnt_qposadr[j]])
    turned = rigid.moved(KINDS[model.jnt_type[j]], model.jnt_axis[j], -rest)
    return pose_at(model.jnt_pos[j]) @ turned


def transform(position: Sequence[float] | Array, quaternion: Sequence[float] | Array) -> Array:
    """(4, 4) of a position (3,) in m and a quaternion (w, x, y, z)."""
    turn = scipy.spatial.transform.Rotation.from_quat(quaternion, scalar_first=True)
    return pose_at(position, turn.as_matrix())


def import_mujoco(what: str = "a MuJoCo model") -> Any:
    try:
        import mujoco
    except ImportError:
        told = "needs MuJoCo, which is not installed; run: pip install elastocal[mujoco]"
        raise InputError(f"{what} {told}") from None
    return mujoco


def parsed(path: Path, text: str | None = None) -> Any:
    mujoco = import_mujoco()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if text is None:
                return mujoco.MjSpec.from_file(str(path))
            names = re.findall(r"""<include\s[^>]*?file\s*=\s*["']([^"']+)["']""", text)
            named = {name: path.parent / name for name in names}
            inside = {name: each.read_bytes() for name, each in named.items() if each.is_file()}
            spec = mujoco.MjSpec.from_string(text, include=inside)
            spec.modelfiledir = f"{path.parent}/"
            return spec
    except ValueError as error:
        raise InputError(f"{path}: MuJoCo cannot read it: {_sentence(error)}") from None


def _sentence(error: Exception) -> str:
    return "; ".join(line.strip() for line in str(error).splitlines() if line.strip())


def _check_units(path: Path, spec: Any) -> None:
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
    # Nor do height fields, which stand still.
    fields = [g for g in spec.geoms if g.hfieldname]
    strip(spec, [*fields, *(g for b in stated for g in b.geoms if not g.hfieldname)])
    first: ValueError | None = None
    used, folder = {g.meshname for g in spec.geoms}, path.parent / (spec.compiler.meshdir or "")
    wanted = {m.name: m.file for m in spec.meshes if m.name in used and m.file}
    missing = {
        name: file for name, file in wanted.items()
        if not (at := folder / file).is_file() or at.stat().st_size > MOST_MESH_BYTES
    }  # fmt: skip
    for lost in (missing, None):  # those, then all
        try:  # a spec that could not be compiled says so again at whatever is asked of it
            geoms = [g for g in spec.geoms if lost is None or g.meshname in lost]
            open_ = [b for b in spec.bodies if b not in stated and any(g in geoms for g in b.geoms)]
            strip(spec, geoms)
            if geoms:
                spec.compiler.boundmass = spec.compiler.boundinertia = STAND_IN
            with warnings.catch_warnings(record=True) as found:
                warnings.simplefilter("always")
                model = spec.compile()
        except ValueError as error:
            first = first or error
            continue
        notes = [f"MuJoCo warns: {str(one.message).splitlines()[0]}" for one in found]
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


def strip(spec: Any, geoms: Iterable[Any]) -> None:
    """Take out geoms, and all that frames, masses and constraints between joints do without."""
    import mujoco

    eq = mujoco.mjtEq
    ties = [one for one in spec.equalities if one.type == eq.mjEQ_TENDON]
    tied = {name for one in ties for name in (one.name1, one.name2)}
    kept = (eq.mjEQ_CONNECT, eq.mjEQ_WELD, eq.mjEQ_JOINT, eq.mjEQ_TENDON)
    gone = [e for e in spec.equalities if e.type not in kept]
    gone += [t for t in spec.tendons if t.name not in tied]
    for one in (*gone, *geoms):
        spec.delete(one)
    for one in (*spec.geoms, *spec.sites):
        one.material = ""
    meshes = {geom.meshname for geom in spec.geoms}
    for kind in (
        "keys", "sensors", "actuators", "pairs", "excludes", "tuples",
        "skins", "flexes", "materials", "textures", "hfields", "meshes",
    ):  # fmt: skip
        for one in list(getattr(spec, kind)):
            if kind != "meshes" or one.name not in meshes:
                spec.delete(one)


# What an MJCF file asks of MuJoCo, counted before MuJoCo sees it.  Its reader takes memory and time
# by numbers in the file, however small that is.

# A humanoid with hands and keyframes has 1500.  MuJoCo's compiler takes 1 s for so many bodies with
# free joints; its time grows with their square, and that of 20 000 is beyond a minute.
MOST_ELEMENTS = 5000
CELLS = 200  # points of a height field that count as one element
# The largest numbers of attributes that MuJoCo sets memory aside by.
LARGEST: dict[str, dict[str, float]] = {
    "size": {"nuserdata": 1e6, "nkey": 1e3, "njmax": 1e6, "nconmax": 1e6, "nstack": 1e8,
             "memory": 4e9} | {f"nuser_{kind}": 1e3 for kind in
             ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")},
    "numeric": {"size": 1e5},
    "mesh": {"params": 200, "octree_maxdepth": 8},
    "composite": {"subgrid": 10},
}  # fmt: skip
NAMES = ("name", "class", "childclass", "model", "prefix", "file")
NAN = re.compile(r"(?i)(?<!\S)[-+]?nan(?!\S)")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?")
_UNITS = {unit: 1024.0**k for k, unit in enumerate("KMGTPE", start=1)}


def check_bounds(file: XmlFile) -> None:
    """InputError, naming file and element, where an MJCF file asks for more than an arm needs.
    Counted are elements as often as they are replicated, included or attached, and sizes; included
    models are regular files in its folder."""
    weight = _Model(file.path).weight_of(file)
    told = f"makes {weight:.3g} elements of all it replicates and includes; more than"
    remedy = f"{MOST_ELEMENTS} are no arm, so keep the arm alone"
    require(weight <= MOST_ELEMENTS, f"{file.path}: {told} {remedy}")


class _Model:
    def __init__(self, path: Path) -> None:
        self._folder = path.parent
        # The folder as it is named, and that of the file where the name is a link.
        self._roots = path.parent.resolve(), path.resolve().parent
        self._weights: dict[Path, float] = {}
        self._text = 0

    def weight_of(self, file: XmlFile) -> float:
        """How many elements MuJoCo makes of a file and all that it includes."""
        path, real = file.path, file.path.resolve()
        if real not in self._weights:
            self._weights[real] = math.nan  # until it is known
            self._text += len(file.data)
            check_size(path, "MuJoCo model with all it includes", self._text, MAX_BYTES)
            self._weights[real] = self._weight(file, file.root)
        told = f"{path}: includes itself; take out the <include>"
        require(not math.isnan(self._weights[real]), told)
        return self._weights[real]

    def _weight(self, file: XmlFile, tag: Tag) -> float:
        for key, text in tag.stated.items():
            stated = f"{file.path}: <{printable(tag.name)} {printable(key)}={quoted(text)}>"
            most = LARGEST.get(tag.name, {}).get(key, math.inf)
            for wrong, told in (
                (key not in NAMES and NAN.search(text), "is no number; correct it"),
                (most < math.inf and max(_numbers(text), default=0.0) > most,
                 f"asks for more than {most:g}, which no arm needs; take it out"),
                ((tag.name, key) == ("flexcomp", "file"),
                 "makes a body of every vertex of a file, which no arm needs; take it out"),
            ):  # fmt: skip
                require(not wrong, f"{stated} {told}")
        inside = 1 + sum(self._weight(file, child) for child in tag.inside)
        return _count(tag) * (inside + sum(self._named(file, tag)))

    def _named(self, file: XmlFile, tag: Tag) -> Iterator[float]:
        name = tag.get("file")
        if tag.name == "attach":
            models = {one.get("name") or Path(one.get("file")).stem: one.get("file")
                      for one in file.tags if one.name == "model"}  # fmt: skip
            name = models.get(tag.get("model"), "")
        if tag.name not in ("include", "model", "attach") or not name:
            return
        # Beside the model or beside the file itself, as versions of MuJoCo differ.
        for found in {self._folder / name, file.path.parent / name}:
            if os.path.lexists(found):
                inside = any(found.resolve().is_relative_to(root) for root in self._roots)
                told = f"includes {printable(name)}, which is outside its folder; put a copy there"
                require(inside, f"{file.path}: {told}")
                yield self.weight_of(XmlFile.read(found, "included model", "an MJCF file"))


def _numbers(text: str) -> list[float]:
    """Sizes of the numbers in a text, of one with a unit ("2G") too."""
    found = _NUMBER.finditer(text)
    return [abs(float(m[0])) * _UNITS.get(text[m.end() : m.end() + 1].upper(), 1.0) for m in found]


def _count(tag: Tag) -> float:
    """How often MuJoCo makes what an element states; a dimension that is 0 or not there counts as
    one, and a vertex or segment is a body with three joints and a geom."""

    def size(*keys: str) -> float:
        return math.prod(max(n, 1.0) for key in keys for n in _numbers(tag.get(key)))

    if tag.name == "replicate":
        return size("count")
    if tag.name == "hfield":
        return 1 + size("nrow", "ncol") / CELLS
    if tag.name in ("composite", "flexcomp"):
        vertices = (len(tag.get(key).split()) / 3 for key in ("point", "vertex"))
        return 5 * max(size("count"), *vertices)
    return 1.0
