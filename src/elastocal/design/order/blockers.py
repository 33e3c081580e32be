"""What stands in the way of a straight joint move, for messages."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.design.feasibility.collision import Collisions
from elastocal.design.feasibility.feasibility import LOADED, Feasibility

Array = NDArray[np.float64]

SAMPLES = 200


class Blockers:
    """The pairs of bodies that come too close on the way from one joint vector to another."""

    def __init__(self, feasibility: Feasibility) -> None:
        self.feasibility = feasibility

    def __call__(self, q_from: Array, q_to: Array, loaded: bool) -> tuple[str, ...]:
        """ "link3 and pillar", …, in the order in which they are met, from samples of the way."""
        step = np.linspace(0.0, 1.0, SAMPLES)[:, None]
        force = LOADED if loaded else np.zeros(3)
        kinematics = self.feasibility.kinematics
        poses = kinematics.poses(q_from + step * (q_to - q_from), force)
        met = []
        for pair in self.feasibility.pairs:
            hits = Collisions(kinematics, [pair]).hits(poses)
            if hits.any():
                met.append((int(np.argmax(hits)), " and ".join(pair.names)))
        return tuple(name for _, name in sorted(met))
