"""How far a body can move during a part of a joint interpolation, at most."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from elastocal.design.feasibility.bodies import Body
from elastocal.design.feasibility.carriers import HANGING, WORLD
from elastocal.design.feasibility.frames import Kinematics, Poses
from elastocal.design.feasibility.pairs import Pair
from elastocal.design.feasibility.shapes import few_points

Array = NDArray[np.float64]


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

    def __init__(
        self, kinematics: Kinematics, bodies: Sequence[Body], pairs: Sequence[Pair]
    ) -> None:
        chain = kinematics.chain
        n = chain.n_joints
        self._axes = np.array([joint.axis for joint in chain.joints])
        self._revolute = [joint.kind == "revolute" for joint in chain.joints]
        hook = (chain.flange_placement @ [*kinematics.load_point, 1.0])[None, :3]
        # The points and radii whose motion bounds that of all bodies on a joint; the load point.
        self._carried = [(i, *_reach([b for b in bodies if b.carrier == i])) for i in range(n)]
        self._carried.append((n - 1, hook, np.zeros(1)))
        # Each pair's bound is one entry of S, or the sum of two.
        at = np.zeros((2, 2, len(pairs)), dtype=int)
        at[1, 1] = n  # S after the last joint is zero
        for k, pair in enumerate(pairs):
            other = pair.other.carrier if isinstance(pair.other, Body) else WORLD
            inner, outer = sorted((pair.body.carrier, other))
            if HANGING in (inner, outer):
                at[0, :, k] = n, 0
                if outer != WORLD:
                    at[1, :, k] = outer, 0
            else:
                at[0, :, k] = outer, inner + 1
        self._at = at

    def __call__(self, poses: Poses, half: Array) -> Array:
        """Changes (N, pairs) in m for middles `poses` and half-widths h (N, n) in rad or m."""
        n = half.shape[1]
        S = np.zeros((len(poses), len(self._carried), n + 1))
        for c, (carrier, points, radii) in enumerate(self._carried):
            T = poses.frames[:, carrier]
            world = T[:, :3, :3] @ points.T + T[:, :3, 3:]
            for j in range(carrier, -1, -1):
                S[:, c, j] = S[:, c, j + 1] + half[:, j]
                if self._revolute[j]:
                    axis = poses.frames[:, j, :3, :3] @ self._axes[j]
                    arm = world - poses.frames[:, j, :3, 3:]
                    along = (axis[:, None] @ arm)[:, 0]
                    square = np.einsum("nik,nik->nk", arm, arm) - along**2
                    lever = (np.sqrt(np.maximum(square, 0.0)) + radii).max(axis=1, initial=0.0)
                    S[:, c, j] = S[:, c, j + 1] + half[:, j] * (lever + S[:, c, j + 1])
        (one, upto), (two, upto_two) = self._at
        return np.asarray(S[:, one, upto] + S[:, two, upto_two])


def _reach(bodies: Sequence[Body]) -> tuple[Array, Array]:
    """Points (k, 3) on a joint and what any point of its bodies may be further out (k,)."""
    points, radii = [np.zeros((0, 3))], [np.zeros(0)]
    for body in bodies:
        own, radius = few_points(body.solid)
        points.append(own)
        radii.append(np.full(len(own), radius if body.solid.shape == "cylinder" else 0.0))
    return np.concatenate(points), np.concatenate(radii)
