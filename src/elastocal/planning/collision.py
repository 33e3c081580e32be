"""The bodies of a cell: arm, tool, load, obstacles, what carries them, what must keep apart; their
collision and sight in whole batches of poses, and moves certified free of collision."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import combinations, product
from pathlib import Path
from typing import Any, Literal, get_args

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from elastocal.cell import CarriedBody, Cell, HalfSpace, HangingLoad, Solid, Workspace
from elastocal.files import check_regular
from elastocal.messages import InputError, check_known, require, said_of
from elastocal.model import rigid
from elastocal.model.chain import Chain
from elastocal.model.evaluate import BatchFunction
from elastocal.model.urdf import urdf_file
from elastocal.units import Array, BoolArray, pose_at

MESH_BYTES = 100_000_000
MESH_HEAD = 100_000
DAE_UNIT = re.compile(rb"""<unit\b[^>]*\bmeter\s*=\s*["']([^"']+)""")
CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))


def hull(solid: Solid, boxed: bool = False) -> tuple[Array, float]:
    """Points (k, 3) in the carrier's frame and a radius by which their convex hull is grown: the
    solid, or what a cylinder, and a mesh that is `boxed` (k ≤ 8, along its own axes), lies
    inside."""
    if solid.shape == "mesh":
        points, radius = mesh_hull(solid)[0], 0.0
        if boxed:
            low, high = points.min(axis=0), points.max(axis=0)
            points = (low + high) / 2 + CORNERS * (high - low)
    elif solid.shape == "box":
        points, radius = CORNERS * solid.size, 0.0
    elif solid.shape == "sphere":
        points, radius = np.zeros((1, 3)), float(solid.size[0])
    else:
        half = np.array([0.0, 0.0, solid.size[1] / 2])
        points, radius = np.stack([-half, half]), float(solid.size[0])
    return points @ solid.placement[:3, :3].T + solid.placement[:3, 3], radius


def support(solid: Solid, direction: Array) -> float:
    """max d·x over the solid, for a unit direction d (3,) in the carrier's frame; exact."""
    points, radius = hull(solid)
    if solid.shape == "cylinder":
        along = float(solid.placement[:3, 2] @ direction)
        radius *= float(np.sqrt(max(1.0 - along**2, 0.0)))
    return float((points @ direction).max()) + radius


def touches(solid: Solid, point: Array, within: float) -> bool:
    """At most `within` m from a point (3,) in the carrier's frame."""
    import coal

    there = coal.Transform3s(np.eye(3), np.array(point, dtype=float))
    here = coal.Transform3s(solid.placement[:3, :3].copy(), solid.placement[:3, 3].copy())
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    return bool(coal.collide(coal_shape(solid), here, coal.Sphere(within), there, request, result))


def capsule_between(name: str, a: Array, b: Array, radius: float) -> Solid:
    """A sphere where the cap centres coincide."""
    length = float(np.linalg.norm(b - a))
    if length < 1e-9:
        return Solid(name, "sphere", np.array([radius]), pose_at((a + b) / 2))
    placement = pose_at((a + b) / 2, rotation_to((b - a) / length))
    return Solid(name, "capsule", np.array([radius, length]), placement)


def rotation_to(z: Array) -> Array:
    """Rotations (..., 3, 3) whose third column is the unit vector z (..., 3)."""
    across = np.where(np.abs(z[..., :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    x = np.cross(across, z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def coal_shape(solid: Solid) -> Any:
    """Centred at the solid's placement; a mesh is its convex hull, a solid body: a triangle surface
    would not see what lies inside it."""
    import coal

    if solid.shape != "mesh":
        return getattr(coal, solid.shape.capitalize())(*solid.size.tolist())
    points, triangles = mesh_hull(solid)
    corners, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    corners.extend(points)
    faces.extend(coal.Triangle(*corner) for corner in triangles.tolist())
    return coal.Convex(corners, faces)


def mesh_hull(solid: Solid) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (k, 3) in the solid's own frame, and triangles."""
    if solid.mesh is None:
        raise InputError(f"body '{solid.name}' is a mesh, but no file is given for it")
    return _mesh_hull(solid.mesh, tuple(solid.size.tolist()), solid.name)


@lru_cache(maxsize=256)
def _mesh_hull(path: Path, scale: tuple[float, ...], name: str) -> tuple[Array, NDArray[np.int64]]:
    import coal

    with said_of(f"mesh of body '{name}'"):
        check_regular(path, "mesh", MESH_BYTES)
    try:
        # COLLADA files state the unit of their lengths, which coal does not look at.
        head = path.read_bytes()[:MESH_HEAD] if path.suffix.lower() == ".dae" else b""
        size = np.array(scale) * float((DAE_UNIT.search(head) or (0, 1.0))[1])
        return outward(np.array(coal.MeshLoader().load(str(path), size).vertices()))
    except QhullError:
        raise InputError(f"mesh '{path}' of body '{name}' is flat: it encloses no volume") from None
    except Exception as error:  # assimp's failures surface as several kinds
        raise InputError(
            f"mesh '{path}' of body '{name}' cannot be read: {error}; STL, OBJ and DAE can"
        ) from None


def outward(cloud: Array) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (k, 3) of the convex hull of points (n, 3), and its triangles, turned outwards."""
    found = ConvexHull(cloud)
    used, index = np.unique(found.simplices, return_inverse=True)
    points, triangles = cloud[used], index.reshape(found.simplices.shape)
    # coal wants every normal to point outwards; Qhull's simplices are in no order.
    a, b, c = (points[triangles[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), found.equations[:, :3]) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return points, triangles.astype(np.int64)


# What carries a body that no joint moves; i ≥ 0 stands for the frame of joint i.

WORLD = -1  # fixed in the data's frame
HANGING = -2  # at the load point, axes parallel to the data's frame
PARENTS = 6  # directories above the URDF in which a ROS package may lie


def urdf_bodies(cell: Cell, chain: Chain) -> list[tuple[Solid, int]]:
    """(solid, carrier) of every <collision> element; those on the base in the base's frame.  Joints
    off the chain stand still at their neutral position, as in the kinematics."""
    import pinocchio as pin

    path = cell.robot.urdf
    where = f'{cell.source}: [workspace] geometry = "urdf"'
    if path is None:
        raise InputError(f"{where}, but the robot has no URDF; give link_radius_mm instead")
    folders = [str(folder) for folder in path.resolve().parents[:PARENTS]]
    try:
        model = pin.buildModelFromUrdf(str(path))
        geometry = pin.buildGeomFromUrdf(
            model, str(path), pin.GeometryType.COLLISION, package_dirs=folders
        )
    except Exception as error:  # missing files and unreadable ones alike
        raise InputError(
            f"{where}: {path}: {' '.join(str(error).split()).rstrip('.')}; put the mesh files "
            "where the URDF looks for them (beside it, or in a package directory above it), or "
            "give link_radius_mm instead"
        ) from None
    # What the reader cannot make out it leaves out, and the arm would strike with it.
    read = Counter(model.frames[item.parentFrame].name for item in geometry.geometryObjects)
    for link in urdf_file(path).root.all("link"):
        require(
            len(link.all("collision")) == read[link.get("name")],
            f"{where}: {path}: a <collision> of link '{link.get('name')}' cannot be read; it takes "
            "box size, cylinder radius and length, sphere radius, mesh filename (scale: 3 numbers)",
        )
    if not geometry.ngeoms:
        raise InputError(
            f"{where}: {path} has no <collision> elements; give link_radius_mm instead"
        )
    moving = [joint.name for joint in chain.joints]
    locked = [model.getJointId(name) for name in list(model.names)[1:] if name not in moving]
    model, geometry = pin.buildReducedModel(model, geometry, locked, pin.neutral(model))
    base, T_root_base = cell.robot.base, pin.SE3.Identity()
    if base is not None:
        T_root_base = model.frames[model.getFrameId(base, pin.FrameType.BODY)].placement
    found = []
    for item in geometry.geometryObjects:
        on_base = item.parentJoint == 0
        T = T_root_base.inverse() * item.placement if on_base else item.placement
        carrier = WORLD if on_base else moving.index(model.names[item.parentJoint])
        found.append((_solid(item, T.homogeneous, path), carrier))
    return found


def _solid(item: Any, placement: np.ndarray, path: Path) -> Solid:
    import coal

    shape = item.geometry
    if isinstance(shape, coal.Box):
        return Solid(item.name, "box", 2 * np.array(shape.halfSide), placement)
    if isinstance(shape, coal.Sphere):
        return Solid(item.name, "sphere", np.array([shape.radius]), placement)
    if isinstance(shape, coal.Cylinder | coal.Capsule):
        kind = "cylinder" if isinstance(shape, coal.Cylinder) else "capsule"
        size = np.array([shape.radius, 2 * shape.halfLength])
        return Solid(item.name, kind, size, placement)  # type: ignore[arg-type]
    if not item.meshPath:
        raise InputError(f"{path}: collision element '{item.name}' is of an unknown shape")
    scale = np.array(item.meshScale, dtype=float).reshape(3)
    return Solid(item.name, "mesh", scale, placement, Path(item.meshPath))


# All bodies of a cell in one list: arm, tool, hanging load, obstacles, each with its carrier.
# The arm is rigid here, at its nominal geometry: clearances must cover deflections of a few mm.

Kind = Literal["arm", "carried", "load", "rope", "obstacle"]
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Body:
    """A solid and what moves it: `carrier` i ≥ 0 the frame of joint i (0-based, after its motion),
    WORLD or HANGING, in which `solid.placement` is."""

    solid: Solid
    carrier: int
    kind: Kind

    @property
    def name(self) -> str:
        return self.solid.name

    @property
    def hangs(self) -> bool:
        return self.carrier == HANGING


def data_base(cell: Cell) -> Array:
    """T_data_base (4, 4) of the nominal cell."""
    nominal = cell.model.nominal
    position = np.zeros(3) if nominal.base_position is None else nominal.base_position
    return pose_at(position, nominal.base_rotation)


def cell_bodies(cell: Cell, chain: Chain) -> tuple[Body, ...]:
    workspace = cell.workspace
    bodies = (
        *_arm(cell, chain),
        *(_carried(body, cell, chain) for body in workspace.bodies),
        *(() if workspace.load is None else hanging(workspace.load)),
        *(Body(solid, WORLD, "obstacle") for solid in workspace.obstacles),
    )
    names = [body.name for body in bodies]
    for k, name in enumerate(names):
        require(
            name not in names[:k],
            f"{cell.source}: [workspace] has two bodies named '{name}'; rename one "
            "(base, link1 … and rope are taken)",
        )
    return bodies


def _arm(cell: Cell, chain: Chain) -> Iterator[Body]:
    workspace = cell.workspace
    where = f"{cell.source}: [workspace]"
    require(
        not (workspace.urdf_geometry and workspace.link_radius),
        f'{where} gives link_radius and geometry = "urdf"; the arm can have only one',
    )
    if workspace.urdf_geometry:
        for solid, carrier in urdf_bodies(cell, chain):
            placed = _moved(data_base(cell), solid) if carrier == WORLD else solid
            yield Body(placed, carrier, "arm")
    elif workspace.link_radius:
        yield from skeleton(chain, workspace.link_radius, data_base(cell), where)


def skeleton(
    chain: Chain, radius: tuple[float, ...], T_data_base: Array, where: str
) -> Iterator[Body]:
    """Capsules along the chain: link i from joint i's origin to joint i+1's at zero offset, the
    last to the flange, "base" from the base's origin to joint 1; none where a radius is 0."""
    radius = radius * chain.n_joints if len(radius) == 1 else radius
    require(
        len(radius) == chain.n_joints,
        f"{where} link_radius_mm has {len(radius)} values, but robot '{chain.name}' has "
        f"{chain.n_joints} links; give one for each, or one for all",
    )
    ends = [T[:3, 3] for T in chain.link_ends]
    foot, first = T_data_base[:3, 3], (T_data_base @ chain.joints[0].placement)[:3, 3]
    if radius[0] > 0 and np.linalg.norm(first - foot) > 0:
        yield Body(capsule_between("base", foot, first, radius[0]), WORLD, "arm")
    for i, (end, r) in enumerate(zip(ends, radius, strict=True)):
        if r > 0:
            yield Body(capsule_between(f"link{i + 1}", np.zeros(3), end, r), i, "arm")


def _carried(body: CarriedBody, cell: Cell, chain: Chain) -> Body:
    places = {"base": (WORLD, data_base(cell))}
    places |= {f"link{i + 1}": (i, np.eye(4)) for i in range(chain.n_joints)}
    places["flange"] = chain.n_joints - 1, chain.flange_placement
    told = f"{cell.source}: [workspace] body '{body.solid.name}' is on '{body.on}'"
    check_known(body.on, places, told, "valid:")
    carrier, T = places[body.on]
    return Body(_moved(T, body.solid), carrier, "carried")


def hanging(load: HangingLoad) -> Iterator[Body]:
    """The rope, straight down from the load point, and the load, its top at the rope's end; they do
    not turn with the flange."""
    if load.rope > 0:
        foot = np.array([0.0, 0.0, -load.rope])
        yield Body(capsule_between("rope", np.zeros(3), foot, load.rope_radius), HANGING, "rope")
    lowered = pose_at([0.0, 0.0, -load.rope - support(load.solid, UP)])
    yield Body(_moved(lowered, load.solid), HANGING, "load")


def _moved(T: Array, solid: Solid) -> Solid:
    return replace(solid, placement=T @ solid.placement)


# Which bodies must keep apart, and how far: the pairs that collision checks look at.

Rule = Literal["mounting_plane", "keep_out", "load_height", "obstacle", "self_collision"]
RULES: tuple[Rule, ...] = get_args(Rule)
FLOOR = "min_height"  # name of the half-space under the hanging load
TOUCH = 1e-6  # m: a body this near to the load point holds the rope
STANDING = 0.01  # m of joint 2 above z = 0 from which the base's frame is taken to be its foot
THIN = 1e-3  # m: radius of links and tool points of which the cell states no bodies


@dataclass(frozen=True)
class Pair:
    """`body` must stay `margin` m away from `other`, or the pose breaks `rule`."""

    body: Body
    other: Body | HalfSpace
    margin: float
    rule: Rule

    @property
    def hangs(self) -> bool:
        return self.body.hangs or (isinstance(self.other, Body) and self.other.hangs)

    @property
    def names(self) -> tuple[str, str]:
        return self.body.name, self.other.name


def cell_pairs(cell: Cell, chain: Chain, bodies: tuple[Body, ...]) -> tuple[Pair, ...]:
    """Every moving body against every obstacle (`clearance`) and every half-space (no margin),
    links and tool against the mounting plane, and the arm's bodies, carried bodies, rope and load
    among themselves (`self_clearance`), except bodies of the same carrier, neighbouring links,
    links that joints hold together whatever the pose, the rope with what holds it, and
    `ignored_pairs`."""
    workspace = cell.workspace
    valid = [body.name for body in bodies] + [space.name for space in workspace.keep_out]
    for name in sum(workspace.ignored_pairs, ()):
        told = f"{cell.source}: [workspace] ignored_pairs names '{name}', but the cell has no such"
        check_known(name, valid, f"{told} body", "valid:")
    ignored = {frozenset(pair) for pair in workspace.ignored_pairs}
    moving = [body for body in bodies if body.carrier != WORLD]
    own = [body for body in bodies if body.kind != "obstacle"]
    obstacles = [body for body in bodies if body.kind == "obstacle"]
    pairs = [Pair(body, space, 0.0, "keep_out") for body in moving for space in workspace.keep_out]
    if (plane := mounting_plane(cell, chain)) is not None:
        # What joint 1 turns stays at its height.
        drawn = (b for b in (*moving, *_outline(cell, chain, bodies)) if b.carrier > 0)
        pairs += [Pair(body, plane, 0.0, "mounting_plane") for body in drawn]
    if (load := workspace.load) is not None and load.min_height is not None:
        floor = HalfSpace(FLOOR, load.min_height * UP, UP)
        pairs += [Pair(body, floor, 0.0, "load_height") for body in bodies if body.kind == "load"]
    pairs += [Pair(b, o, workspace.clearance, "obstacle") for b in moving for o in obstacles]
    if workspace.self_collision:
        # The rope hangs from the bodies of the last link that contain or touch the load point.
        last = [body for body in own if body.carrier == chain.n_joints - 1]
        point = (chain.flange_placement @ [*cell.tool.load_point, 1.0])[:3]
        holding = {body.name for body in last if touches(body.solid, point, TOUCH)}
        pairs += [
            Pair(b, a, workspace.self_clearance, "self_collision")
            for a, b in combinations(own, 2)
            if not _joined(a, b, workspace, chain, holding)
        ]
    return tuple(pair for pair in pairs if frozenset(pair.names) not in ignored)


def mounting_plane(cell: Cell, chain: Chain) -> HalfSpace | None:
    """The side of z = 0 of the base on which the arm is; None where it does not count.  It is known
    where joint 1 turns about the base's z and joint 2 lies off the plane."""
    asked, stated = cell.workspace.mounting_plane, cell.workspace
    if asked is False or (asked is None and (stated.keep_out or stated.obstacles)):
        return None
    first = chain.joints[0]
    upright = first.kind == "revolute" and abs((first.placement[:3, :3] @ first.axis)[2]) > 1 - 1e-6
    height = float((first.placement @ chain.link_ends[0])[2, 3])
    if upright and abs(height) > STANDING:
        T = data_base(cell)
        return HalfSpace("mounting plane", T[:3, 3], np.sign(height) * T[:3, 2])
    if asked:
        raise InputError(
            f"{cell.source}: key workspace.mounting_plane is true, but the base's frame "
            f"of robot '{chain.name}' does not stand on it: joint 1 does not turn about its z, or "
            "joint 2 lies at z = 0; state the plane as [[workspace.keep_out]]"
        )
    return None


def _outline(cell: Cell, chain: Chain, bodies: tuple[Body, ...]) -> Iterator[Body]:
    """Load point and markers, and the links as thin capsules where they have no bodies."""
    if not any(body.kind == "arm" for body in bodies):
        yield from skeleton(chain, (THIN,), data_base(cell), cell.name)
    tool = {f"marker {name}": p for name, p in cell.tool.markers.items()}
    for name, point in {"load point": cell.tool.load_point, **tool}.items():
        solid = Solid(name, "sphere", np.array([THIN]), chain.flange_placement @ pose_at(point))
        yield Body(solid, chain.n_joints - 1, "carried")


def _joined(a: Body, b: Body, workspace: Workspace, chain: Chain, holding: set[str]) -> bool:
    if a.carrier == b.carrier:
        return True
    if a.hangs or b.hangs:
        hung, other = (a, b) if a.hangs else (b, a)
        rope = workspace.load.rope if workspace.load is not None else 0.0
        return other.name in holding and (hung.kind == "rope" or rope == 0)
    if a.kind != "arm" or b.kind != "arm":
        return False
    i, j = sorted((a.carrier, b.carrier))
    slides = any(chain.joints[k].kind == "prismatic" for k in range(i + 1, j + 1))
    if j == i + 1 or workspace.urdf_geometry or slides:
        return j == i + 1
    # Links of a skeleton whose ends are never further apart than the links between are long are in
    # contact at every pose, as in a spherical wrist.
    between = chain.link_ends[i + 1 : j]
    length = sum(float(np.linalg.norm(T[:3, 3])) for T in between)
    return length <= hull(a.solid)[1] + hull(b.solid)[1] + workspace.self_clearance


@dataclass(frozen=True)
class Poses:
    """N poses: `q` (N, n), `force` (N, 3) N at the load point in the data's frame, and
    `frames` (N, n + 2, 4, 4), such that frames[:, body.carrier] places a body: joints 1 … n after
    their motion, the hanging frame, the data's frame."""

    q: Array
    force: Array
    frames: Array
    flange_placement: Array

    def __len__(self) -> int:
        return len(self.q)

    @property
    def loaded(self) -> BoolArray:
        return np.asarray((self.force != 0).any(axis=1))

    @cached_property
    def flange(self) -> Array:
        return np.asarray(self.frames[:, self.q.shape[1] - 1] @ self.flange_placement)

    def take(self, index: NDArray) -> Poses:
        return Poses(self.q[index], self.force[index], self.frames[index], self.flange_placement)


class Kinematics:
    def __init__(self, cell: Cell, chain: Chain) -> None:
        self.chain = chain
        self.T_data_base = data_base(cell)
        self.load_point = np.asarray(cell.tool.load_point, dtype=float)
        q = ca.SX.sym("q", chain.n_joints)
        *frames, flange = rigid.nominal_frames(chain, q, rigid.constant(self.T_data_base))
        self._compiled = BatchFunction([q], [*frames, rigid.point(flange, self.load_point)])

    def poses(self, q: Array, force: Array) -> Poses:
        q = np.ascontiguousarray(np.atleast_2d(q), dtype=float)
        n = self.chain.n_joints
        frames = np.zeros((len(q), n + 2, 4, 4))
        *joints, hanging = self._compiled(q)
        for i, T in enumerate(joints):
            frames[:, i] = T
        frames[:, n:] = np.eye(4)
        frames[:, n, :3, 3] = hanging[..., 0]
        force = np.broadcast_to(np.asarray(force, dtype=float), (len(q), 3))
        return Poses(q, force, frames, self.chain.flange_placement)


# Collision in pinocchio and coal, which tests every pair with its security margin (Pan, Chitta &
# Manocha 2012).  The model is the chain on T_data_base, its universe the data's frame, with one
# spherical joint more at the load point, which undoes the rotation of the last link.

# m: at a margin of 0 coal takes bodies that lie symmetrically in each other for free, as their
# distance is then 0 but for rounding.
NOTHING = 1e-9


class Collisions:
    """Tests a fixed list of pairs; `free` bodies more, carried by n + 1, n + 2, …, may be placed at
    will in every pose."""

    def __init__(self, kinematics: Kinematics, pairs: Sequence[Pair], free: int = 0) -> None:
        import pinocchio as pin

        self._margins = np.array([pair.margin for pair in pairs])
        chain, model, parent = kinematics.chain, pin.Model(), 0
        for i, joint in enumerate(chain.joints):
            placement = kinematics.T_data_base @ joint.placement if i == 0 else joint.placement
            moving = getattr(pin, f"JointModel{joint.kind.capitalize()}Unaligned")(
                joint.axis.copy()
            )
            parent = model.addJoint(parent, moving, pin.SE3(np.array(placement)), f"joint{i + 1}")
        load_point = (chain.flange_placement @ [*kinematics.load_point, 1.0])[:3]
        model.addJoint(parent, pin.JointModelSpherical(), pin.SE3(pose_at(load_point)), "hanging")
        for i in range(free):
            model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), f"free{i + 1}")
        geometry = geometry_of(kinematics, [item for p in pairs for item in (p.body, p.other)])
        hangs = np.array([pair.hangs for pair in pairs], dtype=bool)
        self._pools = []
        for own in (np.flatnonzero(~hangs), np.flatnonzero(hangs)):
            tested = geometry.copy()
            for k in own.tolist():
                a, b = (tested.getGeometryId(name) for name in pairs[k].names)
                tested.addCollisionPair(pin.CollisionPair(a, b))
            self._pools.append((own, pin.GeometryPool(model, tested, 1)))

    def hits(
        self, poses: Poses, extra: float | Array = 0.0, placed: Array | None = None
    ) -> BoolArray:
        """(N,): some pair is nearer than its margin plus `extra` m, for all pairs or for each.
        `placed` (N, 7 free): position and quaternion (x, y, z, w) of every free body."""
        import pinocchio as pin

        last = poses.frames[:, poses.q.shape[1] - 1, :3, :3]
        upright = Rotation.from_matrix(last.transpose(0, 2, 1)).as_quat()
        configuration = np.hstack([poses.q, upright, *([] if placed is None else [placed])])
        margins, found = self._margins + extra + NOTHING, np.zeros(len(poses), dtype=bool)
        for (own, pool), counts in zip(self._pools, (~found, poses.loaded), strict=True):
            left = np.flatnonzero(counts & ~found)
            if not len(own) or not len(left):
                continue
            requests = pool.getGeometryData(0).collisionRequests
            for request, margin in zip(requests, margins[own], strict=True):
                request.security_margin = margin
            rows = configuration[left].T
            found[left] = np.array(pin.computeCollisionsInParallel(1, pool, rows, True))
        return found


def geometry_of(kinematics: Kinematics, items: Sequence[Body | HalfSpace]) -> Any:
    import coal
    import pinocchio as pin

    geometry = pin.GeometryModel()
    for item in items:
        if geometry.existGeometryName(item.name):
            continue
        if isinstance(item, HalfSpace):
            shape = coal.Halfspace(np.array(item.normal), float(item.normal @ item.point))
            joint, placement = 0, np.eye(4)
        else:
            shape, placement = coal_shape(item.solid), item.solid.placement
            fixed = {WORLD: 0, HANGING: kinematics.chain.n_joints + 1}
            joint = fixed.get(item.carrier, item.carrier + 1)
        placed = pin.SE3(np.array(placement))
        geometry.addGeometryObject(pin.GeometryObject(item.name, joint, placed, shape))
    return geometry


# The beam ends this many of its radii before the marker: a reflector on a surface is then seen
# at incidences up to acos(1/4) = 75° from the surface's normal.
END = 4.0
SHORTEST = 1e-3  # m: nothing fits into a shorter beam


def marker_positions(poses: Poses, markers: Sequence[Array]) -> Array:
    T = poses.flange
    return np.asarray(np.einsum("nij,mj->nmi", T[:, :3, :3], np.array(markers))) + T[:, None, :3, 3]


class Sight:
    """Beams from the tracker to the markers, tested as capsules against bodies.

    A beam is the capsule of `radius` from the tracker to the point END radii before the marker.
    coal's capsules have a fixed length, so two of length l = 2^k ≤ d' < 2 l stand for one of length
    d', one from the tracker, one up to its end; their union is exactly that beam.  A body that
    contains the tracker's position is the instrument itself and hides nothing.
    """

    def __init__(
        self, kinematics: Kinematics, bodies: Sequence[Body], eye: Array, radius: float
    ) -> None:
        self._kinematics, self._eye, self._radius = kinematics, np.asarray(eye, float), radius
        self.bodies = tuple(
            body
            for body in bodies
            if not (body.carrier == WORLD and touches(body.solid, self._eye, radius + SHORTEST))
        )
        self._by_length: dict[int, Collisions] = {}

    def past(self, body: Body) -> Sight:
        """As if there were no other body."""
        return Sight(self._kinematics, [body], self._eye, self._radius)

    def blocked(self, poses: Poses, marker: Array) -> BoolArray:
        line = marker_positions(poses, [marker])[:, 0] - self._eye
        distance = np.linalg.norm(line, axis=1)
        length = distance - max(END * self._radius, SHORTEST)
        hidden = np.zeros(len(poses), dtype=bool)
        octave = np.floor(np.log2(np.maximum(length, SHORTEST))).astype(int)
        octave[length <= SHORTEST] = np.iinfo(int).min
        for k in np.unique(octave[length > SHORTEST]):
            rows = np.flatnonzero(octave == k)
            along = line[rows] / distance[rows, None]
            half = 2.0**k / 2
            turned = Rotation.from_matrix(rotation_to(along)).as_quat()
            near = self._eye + half * along
            far = self._eye + (length[rows, None] - half) * along
            placed = np.hstack([near, turned, far, turned])
            hidden[rows] = self._beams(int(k)).hits(poses.take(rows), placed=placed)
        return hidden

    def _beams(self, k: int) -> Collisions:
        if k not in self._by_length:
            n, size = self._kinematics.chain.n_joints, np.array([self._radius, 2.0**k])
            beams = [Body(Solid(f"beam {i}", "capsule", size), n + i, "obstacle") for i in (1, 2)]
            pairs = [Pair(beam, body, 0.0, "obstacle") for beam in beams for body in self.bodies]
            self._by_length[k] = Collisions(self._kinematics, pairs, free=2)
        return self._by_length[k]


def rope_angle(poses: Poses, load: HangingLoad) -> Array:
    """(N,) between the vertical and the axis in which the rope leaves; 0 where nothing hangs."""
    assert load.rope_axis is not None  # stated with the largest angle
    turned = poses.flange[:, :3, :3] @ (load.rope_axis / np.linalg.norm(load.rope_axis))
    angle = np.arctan2(np.hypot(turned[:, 0], turned[:, 1]), -turned[:, 2])
    return np.where(poses.loaded, angle, 0.0)


class MotionBound:
    """By how much the distance of a pair can change from an interval's middle to anywhere in it.

    While joint k moves by at most h_k from its value at the middle, a point carried by joint i
    moves in the frame before joint j by at most

        S_j = S_{j+1} + h_j ρ_j,   ρ_j = lever_j + S_{j+1}   (revolute; h_j for a prismatic one)

    with S_{i+1} = 0 and lever_j its distance from axis j at the middle.  The ball by which a
    sphere or capsule is grown turns into itself and does not count.  The distance of a body
    on joint i from one on joint a < i changes by at most S_{a+1}, from one in the data's frame by
    S_1 (Schwarzer, Saha & Latombe 2005, here with the levers at the middle instead of the longest
    ones).  The hanging load moves with the load point and does not turn: S_1 of that point, and
    of the other body too if that moves.
    """

    def __init__(self, kinematics: Kinematics, pairs: Sequence[Pair]) -> None:
        chain, n = kinematics.chain, kinematics.chain.n_joints
        kept_apart = (item for p in pairs for item in (p.body, p.other) if isinstance(item, Body))
        bodies = {item.name: item for item in kept_apart}.values()
        # Two directions across each revolute axis, in the joint's frame.
        self._across = [
            null_space(joint.axis[None]).T if joint.kind == "revolute" else None
            for joint in chain.joints
        ]
        load_point = (chain.flange_placement @ [*kinematics.load_point, 1.0])[None, :3]
        # The points and radii whose motion bounds that of all bodies on a joint; the load point.
        parts = [(i, *_reach([b for b in bodies if b.carrier == i])) for i in range(n)]
        parts.append((n - 1, load_point, np.zeros(1)))
        self._first = np.cumsum([0, *(len(points) for _, points, _ in parts[:-1])])
        self._carried = [(carrier, points.T) for carrier, points, _ in parts]
        self._radii = np.concatenate([radii for _, _, radii in parts])
        # Each pair's bound is one entry of S, or the sum of two.
        at = np.zeros((2, 2, len(pairs)), dtype=int)
        at[1, 1] = n  # S after the last joint is zero
        for k, pair in enumerate(pairs):
            other = pair.other.carrier if isinstance(pair.other, Body) else WORLD
            inner, outer = sorted((pair.body.carrier, other))
            at[0, :, k] = (n, 0) if inner == HANGING else (outer, inner + 1)
            if inner == HANGING and outer != WORLD:
                at[1, :, k] = outer, 0
        self._at = at

    def __call__(self, poses: Poses, half: Array) -> Array:
        """Changes (N, pairs) in m for middles `poses` and half-widths h (N, n) in rad or m."""
        n = half.shape[1]
        S = np.zeros((len(poses), n + 1, n + 1))  # of what joint 1 to n carry and the load point
        T = poses.frames[..., :3, :]
        placed = [T[:, c, :, :3] @ points + T[:, c, :, 3:] for c, points in self._carried]
        world = np.concatenate(placed, axis=2)
        for j in reversed(range(n)):
            S[:, j:, j] = S[:, j:, j + 1] + half[:, j, None]
            if (across := self._across[j]) is not None:
                start, frame = self._first[j], poses.frames[:, j]
                turned = across @ frame[:, :3, :3].transpose(0, 2, 1)
                arm = turned @ world[:, :, start:] - turned @ frame[:, :3, 3:]
                levers = np.hypot(arm[:, 0], arm[:, 1]) + self._radii[start:]
                lever = np.maximum.reduceat(levers, self._first[j:] - start, axis=1)
                S[:, j:, j] = S[:, j:, j + 1] + half[:, j, None] * (lever + S[:, j:, j + 1])
        (one, upto), (two, upto_two) = self._at
        return np.asarray(S[:, one, upto] + S[:, two, upto_two])


def _reach(bodies: Sequence[Body]) -> tuple[Array, Array]:
    """Points (k, 3) on a joint and what any point of its bodies may be further out (k,)."""
    if not bodies:  # its origin, which bounds nothing that is asked for
        return np.zeros((1, 3)), np.zeros(1)
    found = [(b.solid.shape, *hull(b.solid, boxed=True)) for b in bodies]
    radii = [np.full(len(own), (shape == "cylinder") * radius) for shape, own, radius in found]
    return np.concatenate([own for _, own, _ in found]), np.concatenate(radii)


# A move that keeps its margins by less than this, in m, may be refused.
RESOLUTION = 2.5e-5
LARGEST = 0.3  # m: longer displacements are cut before they are tested
ROPE_TOLERANCE = 1e-3  # rad by which the rope's angle may pass its limit on the way
CHUNK = 8192  # intervals at a time
DOWN = np.array([0.0, 0.0, -1.0])  # any force: the load hangs


class Paths:
    """Moves q(t) = q_from + t (q_to − q_from), t in [0, 1], all joints together.

    An interval of t in which the distance of a pair changes by at most s from that at its middle
    (`MotionBound`) is free if at the middle every pair keeps its margin + s; else it is halved
    (adaptive bisection: Schwarzer, Saha & Latombe 2005).  So "free" holds for every t and not for
    samples of it; a move is refused where a middle breaks a margin or an interval with
    s ≤ RESOLUTION cannot be certified.  The load is taken to hang still.
    """

    def __init__(
        self, kinematics: Kinematics, pairs: Sequence[Pair], load: HangingLoad | None
    ) -> None:
        self._kinematics, self._load = kinematics, load
        self._collisions = Collisions(kinematics, pairs)
        self._bound = MotionBound(kinematics, pairs)
        self._turning = kinematics.chain.turning.astype(float)

    def free(self, q_from: Array, q_to: Array, loaded: BoolArray) -> BoolArray:
        free = np.ones(len(q_from), dtype=bool)
        move = np.arange(len(q_from))
        middle, width = np.full(len(move), 0.5), np.full(len(move), 0.5)
        step = q_to - q_from
        force = np.where(loaded[:, None], DOWN, 0.0)
        while len(move):
            certain = np.zeros(len(move), dtype=bool)
            for start in range(0, len(move), CHUNK):
                rows = slice(start, start + CHUNK)
                m, t = move[rows], middle[rows, None]
                poses = self._kinematics.poses(q_from[m] + t * step[m], force[m])
                certain[rows], refused = self._interval(poses, width[rows, None] * np.abs(step[m]))
                free[m[refused]] = False
            left = ~certain & free[move]
            move, middle, width = (np.repeat(v[left], 2) for v in (move, middle, width / 2))
            middle[::2] -= width[::2]
            middle[1::2] += width[1::2]
        return free

    def _interval(self, poses: Poses, half: Array) -> tuple[BoolArray, BoolArray]:
        change = self._bound(poses, half)
        moved = change.max(axis=1, initial=0.0)
        # One batch per octave: its intervals share the largest change of every pair.
        octave = np.ceil(np.log2(np.maximum(moved / RESOLUTION, 1.0))).astype(int)
        certain = np.zeros(len(poses), dtype=bool)
        for k in np.unique(octave[moved <= LARGEST]):
            rows = np.flatnonzero(octave == k)
            certain[rows] = ~self._collisions.hits(poses.take(rows), change[rows].max(axis=0))
        doubtful = np.flatnonzero(~certain)
        refused = np.zeros(len(poses), dtype=bool)
        refused[doubtful] = self._collisions.hits(poses.take(doubtful)) | (octave[doubtful] == 0)
        if (load := self._load) is not None and load.max_angle is not None:
            most, angle = load.max_angle + ROPE_TOLERANCE, rope_angle(poses, load)
            certain &= angle + half @ self._turning <= most
            refused |= angle > most
        return certain, refused
