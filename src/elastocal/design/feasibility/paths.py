"""Are joint interpolations free of collision?  Certified, not sampled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import HangingLoad
from elastocal.design.feasibility.bodies import Body
from elastocal.design.feasibility.collision import Collisions
from elastocal.design.feasibility.frames import Kinematics, Poses
from elastocal.design.feasibility.load import rope_angle
from elastocal.design.feasibility.motion_bound import MotionBound
from elastocal.design.feasibility.pairs import Pair

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

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
    (adaptive bisection: Schwarzer, Saha & Latombe 2005).  A move is free only if all its intervals
    are, so "free" holds for every t and not for samples of it; it is refused where a middle breaks
    a margin or an interval with s ≤ 25 µm cannot be certified.  The load is taken to hang still.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        bodies: Sequence[Body],
        pairs: Sequence[Pair],
        load: HangingLoad | None,
    ) -> None:
        self._kinematics, self._load = kinematics, load
        self._collisions = Collisions(kinematics, pairs)
        self._bound = MotionBound(kinematics, bodies, pairs)
        revolute = [joint.kind == "revolute" for joint in kinematics.chain.joints]
        self._revolute = np.array(revolute, dtype=float)

    def free(self, q_from: Array, q_to: Array, loaded: BoolArray) -> BoolArray:
        """(M,) for moves q_from → q_to (M, n), with the load where `loaded` (M,)."""
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
        if self._load is None or self._load.rope_axis is None or self._load.max_angle is None:
            return certain, refused
        angle = np.where(poses.loaded, rope_angle(poses, self._load.rope_axis), 0.0)
        turned = half @ self._revolute
        certain &= angle + turned <= self._load.max_angle + ROPE_TOLERANCE
        return certain, refused | (angle > self._load.max_angle + ROPE_TOLERANCE)
