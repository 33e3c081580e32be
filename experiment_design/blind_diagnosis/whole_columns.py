"""What moves the markers of a whole arm, to first order about the arm as it stands.

All that is wrong with an arm is an angle of a joint, a shift, or a turn of base or link: the arm at
rest is placed rigidly, and again with each of these a little changed.  The load of joint j by
weight and first moment of link i is −g ∂z/∂θ_j of the link's origin and axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from draw import World
from mechanics import GRAVITY
from scipy.spatial.transform import Rotation
from skeleton import Array
from whole_draw import CREEP, LAST_MOVE, LINES, WEIGHTS, creep, gear_error, last_move, weights
from world import Effect, TrueArm, Visits

STEP = 1e-5  # m, rad; central differences, each off by 1e-10 of itself


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


def scene_of(world: World, visits: Visits) -> Scene:
    """The columns about the true arm with everything that is wrong with it."""
    arm = world.specimen.true
    rest, motion = world.physics.rest(visits)
    bare, _ = replace(world, effects=()).physics.rest(visits)
    q = visits.q + arm.offset + motion.drive + arm.compliance * rest.load
    J, M = q.shape[1], len(arm.markers)

    def heights(angles: Array) -> Array:
        """(n, J, 4): z of each link's origin, and of its axes."""
        R, o = _placed(arm, q + angles, motion.base)
        return np.concatenate([o[:, :-1, 2:], R[:, :-1, 2]], axis=2)

    def seen(angles: Array = 0, base: Array = 0, link: Array | None = None) -> Array:
        bent = arm
        if link is not None:
            shift, turn = np.split(link.reshape(J, 6), 2, axis=1)
            bent = replace(arm, skeleton=arm.skeleton.bent(shift, turn))
        R, o = _placed(bent, q + angles, motion.base + base)
        points = o[:, -1, None] + np.einsum("nab,mb->nma", R[:, -1], arm.markers)
        return points.reshape(len(q), -1)

    along = np.eye(J)
    flange = _placed(arm, q, motion.base)[0][:, -1]
    return Scene(
        joint=_slopes([lambda h, a=a: seen(angles=h * a) for a in along]),
        base=_slopes([lambda h, a=a: seen(base=h * a) for a in np.eye(6)]),
        links=_slopes([lambda h, a=a: seen(link=h * a) for a in np.eye(6 * J)]),
        markers=np.einsum("nab,lm->nlamb", flange, np.eye(M)).reshape(len(q), 3 * M, 3 * M),
        load=rest.load, carried=bare.load,
        weighing=-GRAVITY * _slopes(
            [lambda h, a=a: heights(h * a).reshape(len(q), -1) for a in along]
        ).transpose(0, 2, 1),
    )  # fmt: skip


def _slopes(changed: list) -> Array:
    """(n, K, columns) of functions h → (n, K), by central differences."""
    return np.stack([(f(STEP) - f(-STEP)) / (2 * STEP) for f in changed], axis=2)


def _placed(arm: TrueArm, q: Array, base: Array) -> tuple[Array, Array]:
    """Rotations and origins of all frames, links and flange, with the base moved by (n, 6)."""
    turn = Rotation.from_rotvec(base[:, 3:]).as_matrix() @ arm.base_rotation
    R, o = arm.skeleton.forward(q)
    foot = arm.base_position + base[:, :3]
    return turn[:, None] @ R, foot[:, None] + np.einsum("nab,njb->nja", turn, o)


def components(world: World, visits: Visits, scene: Scene) -> dict[tuple[str, str], Array]:
    """What is wrong with a whole arm: what each family at each place moves the coordinates by,
    (n, K) m."""
    out = {}
    for e in world.effects:
        if e.name in (LINES, LAST_MOVE):
            family, error = ("angle", gear_error) if e.name == LINES else ("move", last_move)
            out[family, e.where] = scene.joint[:, :, e.index] * error(e, visits)[:, None]
        elif e.name == WEIGHTS:
            sag = world.specimen.true.compliance * (scene.weighing @ moments(e))
            for j, angle in enumerate(sag.T):
                out["gravity", f"joint{j + 1}"] = scene.joint[:, :, j] * angle[:, None]
        elif e.name == CREEP:
            out["time", e.where] = np.einsum("nkb,nb->nk", scene.base, creep(e, visits.time))
    return out


def moments(e: Effect) -> Array:
    """Mass and first moment of each link, (4 J,) kg and kg·m."""
    masses, centres = weights(e)
    return np.concatenate([masses[:, None], masses[:, None] * centres], axis=1).ravel()
