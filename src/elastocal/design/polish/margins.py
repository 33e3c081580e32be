"""How far a pose is from breaking the cell's rules, as smooth expressions of its joints.

Conservative stand-ins for `design.feasibility`, which has the last word: clearances by sphere
covers, half-spaces, rope angle, static torque, and of the tracker's sight range and incidence
(whether something stands in the line of sight is left to the final check).  The arm is nominal.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.cell_workspace import HalfSpace
from elastocal.design.feasibility.bodies import Body, data_base
from elastocal.design.feasibility.carriers import HANGING, WORLD
from elastocal.design.feasibility.contact_rules import POSE_SLACK
from elastocal.design.feasibility.pairs import Pair
from elastocal.design.feasibility.shapes import few_points
from elastocal.design.polish.covers import excess, signed_distance, smooth_min, sphere_cover
from elastocal.manipulator import rigid
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.loads import STANDARD_GRAVITY

Array = NDArray[np.float64]

WIDTH = 1e-3  # m over which several distances blend into one


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
        T, carriers = rigid.constant(data_base(cell)), {WORLD: ca.SX.eye(4)}
        for i, joint in enumerate(chain.joints):
            motion = rigid.joint_motion(joint.kind, joint.axis, q[i])
            T = T @ rigid.constant(joint.placement) @ motion
            carriers[i] = T
        flange = T @ rigid.constant(chain.flange_placement)
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
    return smooth_min(ca.vertcat(*distances), WIDTH) - radius - (pair.margin + POSE_SLACK)


def _rope_angle(cell: Cell, arm: _Frames) -> Iterator[ca.SX]:
    load = cell.workspace.load
    if load is not None and load.max_angle is not None and load.rope_axis is not None:
        axis = load.rope_axis / np.linalg.norm(load.rope_axis)
        down = -(arm.flange[2, :3] @ rigid.constant(axis))
        yield down - np.cos(load.max_angle)


def _sight(cell: Cell, arm: _Frames) -> Iterator[ca.SX]:
    rules = cell.workspace.visibility
    if rules is None:
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
