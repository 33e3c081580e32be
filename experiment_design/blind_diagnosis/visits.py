"""Which poses are measured, in which order, when, and from which side each joint came."""

from __future__ import annotations

from typing import Literal

import numpy as np
from arm_data import ArmSpec
from numpy.typing import NDArray
from world import Visits

Array = NDArray[np.float64]
Plan = Literal["interleaved", "blocks"]

MINUTES_PER_VISIT = 0.6
CLEARANCE = 0.08  # markers and joints stay this share of the reach above the base's foot
SEPARATION = 0.05  # rad, in the joint that differs most: no pose twice


def draw_poses(spec: ArmSpec, n: int, rng: np.random.Generator) -> Array:
    """(n, J) rad, uniform in the joint limits, above the floor, all distinct; 9 decimals."""
    s = spec.skeleton
    kept: list[Array] = []
    while len(kept) < n:
        q = rng.uniform(s.lower, s.upper, (4 * n, s.n_joints)).round(9)
        R, p = s.forward(q)
        points = np.concatenate([np.array(spec.markers), [spec.hook]])
        tool = p[:, -1, None] + np.einsum("nij,mj->nmi", R[:, -1], points)
        lowest = np.minimum(p[:, 2:, 2].min(axis=1), tool[..., 2].min(axis=1))
        for pose in q[lowest > CLEARANCE * spec.reach]:
            if len(kept) < n and all(np.abs(pose - k).max() > SEPARATION for k in kept):
                kept.append(pose)
    return np.array(kept)


def draw_visits(
    spec: ArmSpec, poses: Array, plan: Plan, approach_by_motion: bool, rng: np.random.Generator
) -> Visits:
    """Every pose (n, J) unloaded and loaded, in the order given.

    "interleaved": the load goes on right after, without a motion; "blocks": all poses unloaded,
    then all loaded.  `approach_by_motion`: directions are those of the motion from the pose
    before; else the controller approaches each joint from a side of its own choice.
    """
    n, J = poses.shape
    order = np.arange(n)
    if plan == "interleaved":
        pose, loaded = np.repeat(order, 2), np.tile([False, True], n)
    else:
        pose, loaded = np.tile(order, 2), np.repeat([False, True], n)
    q = poses[pose]
    step = np.diff(q, axis=0, prepend=rng.uniform(-1, 1, (1, J)))
    approach = np.sign(step) if approach_by_motion else rng.choice([-1.0, 1.0], q.shape)
    for i in np.flatnonzero(~step.any(axis=1)):
        approach[i] = approach[i - 1]
    force = np.outer(loaded, [0.0, 0.0, -spec.payload])
    minutes = MINUTES_PER_VISIT * rng.uniform(0.9, 1.1, len(pose))
    time = (np.cumsum(minutes) - minutes[0]).round(3) * 60
    return Visits(q, force, time, approach, pose)
