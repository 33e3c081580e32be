"""What moves the markers of a whole arm, to first order about the arm as it stands.

Markers at P (n, M, 3) m hang behind joint j, which turns about a_j through o_j: an angle there
moves them by a_j × (P − o_j).  All that is wrong with an arm is such an angle, a shift, or a turn:
errors of gears and of the last move in the joint, sag k_j τ_j, frames, base.  τ_j of weight
and centre of link i ≥ j is a_j · ((p_i − o_j) m_i + R_i m_i c_i) × g.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from draw import World
from mjcf import GRAVITY
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from whole_laws import CREEP, LAST_MOVE, LINES, WEIGHTS, creep, gear_error, last_move, weights
from world import Effect, Motion, Visits

Array = NDArray[np.float64]
DOWN = np.array([0.0, 0.0, -GRAVITY])


@dataclass(frozen=True)
class Scene:
    """The arm at rest at n visits.

    joint (n, K, J): motion of all K = 3 M coordinates per rad of each joint; base (n, K, 6), about
    the base's origin; links (n, K, 6 J), shifts and turns of each link's end along its own axes;
    markers (n, K, 3 M); load (n, J) N·m, the whole of it and what the payload alone makes;
    weighing (n, J, 4 J): load of each joint per mass and first moment of each link.
    """

    joint: Array
    base: Array
    links: Array
    markers: Array
    load: Array
    carried: Array
    weighing: Array

    def bent(self, angles: Array) -> Array:
        """Motion (n, K) by angles (n, J) rad of the joints."""
        return np.einsum("nkj,nj->nk", self.joint, angles)


def scene_of(world: World, visits: Visits) -> Scene:
    """The columns about the true arm with everything that is wrong with it."""
    compliance = world.specimen.true.compliance
    rest, motion = world.physics.rest(visits)
    bare, _ = replace(world, effects=()).physics.rest(visits)
    return _columns(world, visits, motion, compliance * rest.load, rest.load, bare.load)


def _columns(
    world: World, visits: Visits, motion: Motion, bent: Array, load: Array, carried: Array
) -> Scene:
    arm = world.specimen.true
    skeleton = arm.skeleton
    n, J = visits.q.shape
    M = len(arm.markers)
    turn = Rotation.from_rotvec(motion.base[:, 3:]).as_matrix() @ arm.base_rotation
    foot = arm.base_position + motion.base[:, :3]
    R, o = skeleton.forward(visits.q + arm.offset + motion.drive + bent)
    R = np.einsum("nab,njbc->njac", turn, R)
    o = foot[:, None] + np.einsum("nab,njb->nja", turn, o)
    flange = R[:, -1]
    P = o[:, -1, None] + np.einsum("nab,mb->nma", flange, arm.markers)

    def turned(axis: Array, origin: Array) -> Array:
        """axis × (P − origin) of every marker, (n, 3 M); both (n, 3)."""
        return np.cross(axis[:, None], P - origin[:, None]).reshape(n, -1)

    def shifted(axis: Array) -> Array:
        return np.tile(axis, (1, M))

    axes = np.einsum("njab,jb->nja", R[:, :-1], skeleton.axis)
    joint = np.stack([turned(axes[:, j], o[:, j]) for j in range(J)], axis=2)
    unit = np.tile(np.eye(3), (n, 1, 1))
    base = [shifted(unit[:, a]) for a in range(3)] + [turned(unit[:, a], foot) for a in range(3)]
    links = []
    for j in range(J):
        end = R[:, j] @ skeleton.rotation[j + 1]
        links += [shifted(end[:, :, a]) for a in range(3)]
        links += [turned(end[:, :, a], o[:, j + 1]) for a in range(3)]
    markers = np.zeros((n, M, 3, M, 3))
    for m in range(M):
        markers[:, m, :, m] = flange
    return Scene(
        joint, np.stack(base, axis=2), np.stack(links, axis=2), markers.reshape(n, 3 * M, 3 * M),
        load, carried, _weighing(axes, R, o),
    )  # fmt: skip


def _weighing(axes: Array, R: Array, o: Array) -> Array:
    n, J = axes.shape[:2]
    out = np.zeros((n, J, J, 4))
    for j in range(J):
        for i in range(j, J):
            arm = np.cross(o[:, i] - o[:, j], DOWN)
            out[:, j, i, 0] = np.einsum("na,na->n", axes[:, j], arm)
            for a in range(3):
                arm = np.cross(R[:, i, :, a], DOWN)
                out[:, j, i, 1 + a] = np.einsum("na,na->n", axes[:, j], arm)
    return out.reshape(n, J, 4 * J)


@dataclass(frozen=True)
class Component:
    """One part of the gap: its family, place, and what it moves the coordinates by (n, K) m."""

    family: str
    where: str
    moved: Array


def components(world: World, visits: Visits, scene: Scene) -> list[Component]:
    """What is wrong with a whole arm, part by part."""
    out = []
    J = visits.q.shape[1]
    for e in world.effects:
        if e.name == LINES:
            out.append(_at_joint("angle", e, gear_error(e, visits.q[:, e.index]), scene))
        elif e.name == LAST_MOVE:
            out.append(_at_joint("move", e, last_move(e, visits.approach[:, e.index]), scene))
        elif e.name == WEIGHTS:
            sag = world.specimen.true.compliance * (scene.weighing @ moments(e))
            for j in range(J):
                moved = scene.joint[:, :, j] * sag[:, j, None]
                out.append(Component("gravity", f"joint{j + 1}", moved))
        elif e.name == CREEP:
            moved = np.einsum("nkb,nb->nk", scene.base, creep(e, visits.time))
            out.append(Component("time", e.where, moved))
    return out


def moments(e: Effect) -> Array:
    """Mass and first moment of each link, (4 J,) kg and kg·m."""
    masses, centres = weights(e)
    return np.concatenate([masses[:, None], masses[:, None] * centres], axis=1).ravel()


def _at_joint(family: str, e: Effect, angle: Array, scene: Scene) -> Component:
    return Component(family, e.where, scene.joint[:, :, e.index] * angle[:, None])
