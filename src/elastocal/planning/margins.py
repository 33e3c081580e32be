"""How far a pose is from breaking the cell's rules, as smooth expressions of its joints."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product

import casadi as ca
import numpy as np

from elastocal.cell.work_cell import Cell
from elastocal.cell.workspace_rules import HalfSpace, Solid
from elastocal.model import rigid
from elastocal.model.chain import Chain
from elastocal.model.effects.loads import STANDARD_GRAVITY
from elastocal.planning.bodies import HANGING, WORLD, Body, Pair, data_base, few_points, mesh_hull
from elastocal.planning.collision import arm_frames
from elastocal.planning.feasibility import POSE_SLACK
from elastocal.units import Array

# Conservative stand-ins for `feasibility`, which has the last word: clearances by sphere
# covers, half-spaces, rope angle, static torque, and of the tracker's sight range and incidence
# (whether something stands in the line of sight is left to the final check).  The arm is nominal.
#
# A clearance between two bodies holds if every sphere of a cover of one keeps it to the other:
# conservative, and differentiable where the exact distance of two convex bodies is not.

SMOOTHING = 1e-3  # m over which several distances blend into one
MOST_SPHERES = 6  # spheres along an edge of a box
MOST_ALONG = 12  # and along the axis of a cylinder or capsule
ROUNDING = 1e-4  # m by which edges and corners are rounded off, on the safe side


def margins(cell: Cell, chain: Chain, pairs: Iterable[Pair], forces: Array) -> ca.Function | None:
    """q (n,) → margins (m,), all ≥ 0 where the rules hold under the `forces` (k, 3) N of a pose.

    `pairs` are those of `cell_pairs`.  Margins are in m, those of angles differences of cosines,
    of torques relative.  None where the cell has no rules.
    """
    q = ca.SX.sym("q", chain.n_joints)
    arm = _Frames.of(cell, chain, q)
    loaded = bool(np.any(forces))
    found = [
        *(_clearance(arm, pair) for pair in pairs if loaded or not pair.hangs),
        *(_rope_angle(cell, arm) if loaded else ()),
        *_sight(cell, arm),
        *_torques(cell, chain, arm, q, forces),
    ]
    if not found:
        return None
    return ca.Function("margins", [q], [ca.vertcat(*found)], {"cse": True})


@dataclass(frozen=True)
class _Frames:
    """Frames (4, 4) of everything that carries bodies, in the data's frame."""

    carriers: dict[int, ca.SX]
    flange: ca.SX
    load_point: ca.SX

    @classmethod
    def of(cls, cell: Cell, chain: Chain, q: ca.SX) -> _Frames:
        frames, flange = arm_frames(chain, data_base(cell), q)
        carriers = {WORLD: ca.SX.eye(4), **dict(enumerate(frames))}
        load_point = rigid.point(flange, rigid.constant(cell.tool.load_point))
        carriers[HANGING] = rigid.transform(translation=load_point)
        return cls(carriers, flange, load_point)

    def point(self, body: Body, p: Array) -> ca.SX:
        """A point (3,) of the carrier's frame in the data's frame."""
        return rigid.point(self.carriers[body.carrier], rigid.constant(p))

    def seen_from(self, body: Body, p: ca.SX) -> ca.SX:
        """A point (3,) of the data's frame in the carrier's."""
        T = self.carriers[body.carrier]
        return T[:3, :3].T @ (p - T[:3, 3])


def _clearance(arm: _Frames, pair: Pair) -> ca.SX:
    """Distance less the clearance; of two bodies the one that spheres fit better is covered."""
    a, b = pair.body, pair.other
    if isinstance(b, HalfSpace):
        points, radius = few_points(a.solid)
        normal = rigid.constant(b.normal)
        distances = [ca.dot(normal, arm.point(a, p) - rigid.constant(b.point)) for p in points]
    else:
        if excess(b.solid) < excess(a.solid):
            a, b = b, a
        points, radius = sphere_cover(a.solid)
        distances = [signed_distance(b.solid, arm.seen_from(b, arm.point(a, p))) for p in points]
    return smooth_min(ca.vertcat(*distances), SMOOTHING) - radius - (pair.margin + POSE_SLACK)


def _rope_angle(cell: Cell, arm: _Frames) -> Iterator[ca.SX]:
    load = cell.workspace.load
    if load is not None and load.max_angle is not None and load.rope_axis is not None:
        axis = load.rope_axis / np.linalg.norm(load.rope_axis)
        down = -(arm.flange[2, :3] @ rigid.constant(axis))
        yield down - np.cos(load.max_angle)


def _sight(cell: Cell, arm: _Frames) -> Iterator[ca.SX]:
    rules = cell.workspace.visibility
    if rules is None or rules.min_markers is not None:  # which of them are seen may change
        return
    tracker = rigid.constant(cell.tracker.position)
    for name, marker in cell.tool.markers.items():
        sight = tracker - rigid.point(arm.flange, rigid.constant(marker))
        distance = ca.sqrt(ca.sumsqr(sight) + rigid.TINY)
        near, far = rules.range
        if near > 0:
            yield distance - near
        if np.isfinite(far):
            yield far - distance
        normal = rules.normals.get(name)
        if normal is not None and rules.max_incidence is not None:
            towards = arm.flange[:3, :3] @ rigid.constant(normal / np.linalg.norm(normal))
            yield ca.dot(towards, sight) / distance - np.cos(rules.max_incidence)


def _torques(cell: Cell, chain: Chain, arm: _Frames, q: ca.SX, forces: Array) -> Iterator[ca.SX]:
    """1 − (τ/limit)² with τ = −∂V/∂q, V the potential of the load and, where known, the links."""
    limits = np.array(cell.workspace.torque_limits)
    if not len(limits):
        return
    weights = ca.SX(0)
    for i, body in enumerate(chain.masses if cell.model.link_gravity else ()):
        height = rigid.point(arm.carriers[i], rigid.constant(body.com))[2]
        weights += body.mass * STANDARD_GRAVITY * height
    for force in forces:
        potential = weights - ca.dot(rigid.constant(force), arm.load_point)
        yield 1 - (ca.gradient(potential, q) / limits) ** 2


def sphere_cover(solid: Solid) -> tuple[Array, float]:
    """Centres (k, 3) in the carrier's frame and the radius of equal spheres that cover a solid.

    A solid is cut into about cubic cells and a sphere put around each; a capsule's spheres
    stand on its axis, ends included.
    """
    solid = _boxed(solid)
    if solid.shape == "sphere":
        centres, radius = np.zeros((1, 3)), float(solid.size[0])
    elif solid.shape == "box":
        counts = [min(int(np.ceil(e / solid.size.min() - 1e-9)), MOST_SPHERES) for e in solid.size]
        centres = np.array(list(product(*(_midpoints(k) for k in counts)))) * solid.size
        radius = float(np.linalg.norm(solid.size / counts)) / 2
    else:
        r, length = (float(s) for s in solid.size)
        count = int(np.clip(np.ceil(length / r), 1, MOST_ALONG))
        along = (
            _midpoints(count) if solid.shape == "cylinder" else np.linspace(-0.5, 0.5, count + 1)
        )
        centres = np.outer(along * length, [0.0, 0.0, 1.0])
        radius = float(np.hypot(r, length / count / 2))
    T = solid.placement
    return centres @ T[:3, :3].T + T[:3, 3], radius


def excess(solid: Solid) -> float:
    """How much too thick the cover of a solid is, in m."""
    radius = sphere_cover(solid)[1]
    boxed = _boxed(solid)
    return radius - float(boxed.size.min() / 2 if boxed.shape == "box" else boxed.size[0])


def signed_distance(solid: Solid, point: ca.SX) -> ca.SX:
    """Distance in m of a point (3,) in the carrier's frame from a solid, negative inside.

    Never larger than the true one, smaller by 2 `ROUNDING` at most; a mesh is the box around it.
    Outside |max(p − h, 0)|, inside max(p − h), with h the half extents of a box, or the radius
    and half length of a cylinder; differentiable outside.
    """
    solid = _boxed(solid)
    T = np.linalg.inv(solid.placement)
    p = rigid.constant(T[:3, :3]) @ point + rigid.constant(T[:3, 3])
    if solid.shape == "sphere":
        return ca.sqrt(ca.sumsqr(p) + rigid.TINY) - float(solid.size[0])
    if solid.shape == "capsule":
        beyond = ca.fmax(ca.fabs(p[2]) - float(solid.size[1]) / 2, 0)
        return ca.sqrt(ca.sumsqr(p[:2]) + beyond**2 + rigid.TINY) - float(solid.size[0])
    if solid.shape == "box":
        past = ca.fabs(p) - rigid.constant(solid.size / 2)
    else:
        across = ca.sqrt(ca.sumsqr(p[:2]) + ROUNDING**2) - ROUNDING
        past = ca.vertcat(across - float(solid.size[0]), ca.fabs(p[2]) - float(solid.size[1]) / 2)
    outside = ca.sqrt(ca.sumsqr(ca.fmax(past, 0)) + ROUNDING**2) - ROUNDING
    return outside + ca.fmin(ca.mmax(past), 0)


def smooth_min(values: ca.SX, width: float) -> ca.SX:
    """−w log Σ exp(−v/w): at most min v, and below it by no more than w log(number)."""
    least = ca.mmin(values)
    return least - width * ca.log(ca.sum1(ca.exp((least - values) / width)))


def _midpoints(count: int) -> Array:
    return (np.arange(count) + 0.5) / count - 0.5


def _boxed(solid: Solid) -> Solid:
    """A mesh as the box around it in its own axes; any other solid unchanged."""
    if solid.shape != "mesh":
        return solid
    points = mesh_hull(solid)[0]
    low, high = points.min(axis=0), points.max(axis=0)
    middle = np.eye(4)
    middle[:3, 3] = (low + high) / 2
    return Solid(solid.name, "box", high - low, solid.placement @ middle)
