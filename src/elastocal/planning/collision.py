"""Collision, sight and load of whole batches of poses, and moves certified free of collision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

from elastocal.cell import Cell, HalfSpace, HangingLoad, Solid
from elastocal.model import rigid
from elastocal.model.chain import Chain
from elastocal.model.effects.statics import GravityCompensator
from elastocal.model.evaluate import BatchFunction
from elastocal.model.symbolic import SymbolicArm
from elastocal.planning.bodies import (
    HANGING,
    WORLD,
    Body,
    Pair,
    coal_shape,
    data_base,
    hull,
    rotation_to,
    touches,
)
from elastocal.units import Array, BoolArray, pose_at

# Where everything stands in a batch of poses, from the chain's one symbolic description.


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
    """Frames of the rigid nominal arm in whole batches."""

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
        model = arm_model(kinematics, free)
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

        `placed` (N, 7 free): position and quaternion (x, y, z, w) of every free body.
        """
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


def hits_by_pair(
    kinematics: Kinematics, pairs: Sequence[Pair], poses: Poses, extra: float = 0.0
) -> dict[str, BoolArray]:
    return {
        " and ".join(pair.names): Collisions(kinematics, [pair]).hits(poses, extra)
        for pair in pairs
    }


def arm_model(kinematics: Kinematics, free: int = 0) -> Any:
    import pinocchio as pin

    model, parent = pin.Model(), 0
    unaligned = {
        "revolute": pin.JointModelRevoluteUnaligned,
        "prismatic": pin.JointModelPrismaticUnaligned,
    }
    for i, joint in enumerate(kinematics.chain.joints):
        placement = kinematics.T_data_base @ joint.placement if i == 0 else joint.placement
        moving = unaligned[joint.kind](np.array(joint.axis))
        parent = model.addJoint(parent, moving, _se3(placement), f"joint{i + 1}")
    load_point = (kinematics.chain.flange_placement @ [*kinematics.load_point, 1.0])[:3]
    model.addJoint(parent, pin.JointModelSpherical(), _se3(pose_at(load_point)), "hanging")
    for i in range(free):
        model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), f"free{i + 1}")
    return model


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
        geometry.addGeometryObject(pin.GeometryObject(item.name, joint, _se3(placement), shape))
    return geometry


def _se3(T: Array) -> Any:
    import pinocchio as pin

    return pin.SE3(np.array(T[:3, :3]), np.array(T[:3, 3]))


# What the tracker sees: range, incidence on the reflector, free line of sight.

# The beam ends this many of its radii before the marker: a reflector on a surface is then seen
# at incidences up to acos(1/4) = 75° from the surface's normal.
END = 4.0
SHORTEST = 1e-3  # m: nothing fits into a shorter beam


def marker_positions(poses: Poses, markers: Sequence[Array]) -> Array:
    T = poses.flange
    return np.asarray(np.einsum("nij,mj->nmi", T[:, :3, :3], np.array(markers))) + T[:, None, :3, 3]


def incidence(
    poses: Poses, markers: Sequence[Array], normals: Sequence[Array], eye: Array
) -> Array:
    to_eye = eye - marker_positions(poses, markers)
    axes = np.einsum("nij,mj->nmi", poses.flange[:, :3, :3], np.array(normals))
    across = np.linalg.norm(np.cross(axes, to_eye), axis=2)
    return np.asarray(np.arctan2(across, np.einsum("nmi,nmi->nm", axes, to_eye)))


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


# Whether the load may hang: rope angle and static joint torques.


def rope_angle(poses: Poses, axis: Array) -> Array:
    """Angle (N,) between the vertical and `axis` (3,) of the flange, in which the rope leaves
    it."""
    turned = poses.flange[:, :3, :3] @ (np.asarray(axis) / np.linalg.norm(axis))
    return np.asarray(np.arctan2(np.hypot(turned[:, 0], turned[:, 1]), -turned[:, 2]))


class StaticTorque:
    """τ = ∂V/∂q (N, n) in N m (N for a prismatic joint): what the joints bear at rest, V the
    potential of force, link weights and gravity compensator at the rigid pose and nominal
    values."""

    def __init__(self, cell: Cell, chain: Chain) -> None:
        kept = tuple(e for e in cell.model.effects if e.name == GravityCompensator.name)
        model = replace(cell.model, effects=kept, observe="position")
        tool = replace(cell.tool, markers={"tool": np.zeros(3)})
        symbolic = SymbolicArm(chain, replace(cell, tool=tool, model=model))
        arm, nominal = symbolic.arm, ca.DM([p.nominal for p in symbolic.parameters])
        torque = ca.gradient(arm.potential, arm.q_commanded)
        torque = ca.substitute(torque, symbolic.p, nominal)
        self._compiled = BatchFunction([arm.inputs["q"], arm.inputs["force"]], [torque])

    def __call__(self, poses: Poses) -> Array:
        return self._compiled(poses.q, poses.force)[0][..., 0]


# How far a body can move during a part of a joint interpolation, at most.


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
        sizes = [len(points) for _, points, _ in parts]
        self._first = np.cumsum([0, *sizes[:-1]])
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


# Are joint interpolations free of collision?  Certified, not sampled.

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
        revolute = [joint.kind == "revolute" for joint in kinematics.chain.joints]
        self._revolute = np.array(revolute, dtype=float)

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
                half = width[rows, None] * np.abs(step[m])
                certain[rows], refused = self._interval(poses, half)
                free[m[refused]] = False
            left = ~certain & free[move]
            move, middle, width = (np.repeat(v[left], 2) for v in (move, middle, width / 2))
            middle[::2] -= width[::2]
            middle[1::2] += width[1::2]
        return free

    def _interval(self, poses: Poses, half: Array) -> tuple[BoolArray, BoolArray]:
        """Intervals (K,) that are free for certain, and those that refuse their move."""
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
        load = self._load
        if load is not None and load.rope_axis is not None and load.max_angle is not None:
            most = load.max_angle + ROPE_TOLERANCE
            angle = np.where(poses.loaded, rope_angle(poses, load.rope_axis), 0.0)
            certain &= angle + half @ self._revolute <= most
            refused |= angle > most
        return certain, refused
