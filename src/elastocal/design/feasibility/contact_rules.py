"""Rules about bodies: keep-out, obstacles, self-collision, height of the load, line of sight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from elastocal.design.feasibility.bodies import Body
from elastocal.design.feasibility.collision import Collisions
from elastocal.design.feasibility.frames import Kinematics, Poses
from elastocal.design.feasibility.pairs import Pair
from elastocal.design.feasibility.rules import Rule
from elastocal.design.feasibility.sight import Sight

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# A pose keeps every margin by this much more, so that a move that ends there can be certified.
POSE_SLACK = 1e-4  # m
SHOWN = 3  # causes that a remedy names

ADVICE = {
    "keep_out": "move the boundary in [[workspace.keep_out]]",
    "load_height": "lower [workspace.load] min_height_m or shorten its rope",
    "obstacle": "move or shrink the obstacle",
    "self_collision": "shrink the bodies if they are modelled too large",
    "line_of_sight": "move the tracker or the markers",
}


class KeepApart(Rule):
    """No pair of bodies nearer than its margin."""

    def __init__(self, name: str, kinematics: Kinematics, pairs: Sequence[Pair]) -> None:
        self.name, self._kinematics, self._pairs = name, kinematics, tuple(pairs)
        self._collisions = Collisions(kinematics, pairs)

    def broken(self, poses: Poses) -> BoolArray:
        return self._collisions.hits(poses, POSE_SLACK)

    def causes(self, poses: Poses) -> dict[str, BoolArray]:
        return {
            " and ".join(pair.names): Collisions(self._kinematics, [pair]).hits(poses, POSE_SLACK)
            for pair in self._pairs
        }

    def remedy(self, poses: Poses) -> str:
        text = f"{most_frequent(self.causes(poses))}; {ADVICE[self.name]}"
        margin = max(pair.margin for pair in self._pairs)
        freed = int((~self._collisions.hits(poses, POSE_SLACK - margin)).sum()) if margin else 0
        key = {"obstacle": "clearance_mm", "self_collision": "self_clearance_mm"}.get(self.name)
        if freed:
            text += f", or {key} of 0 instead of {margin * 1e3:.4g} would free {freed}"
        return text


class LineOfSight(Rule):
    """Every marker is seen from the tracker."""

    name = "line_of_sight"

    def __init__(
        self,
        kinematics: Kinematics,
        bodies: Sequence[Body],
        eye: Array,
        radius: float,
        markers: Mapping[str, Array],
    ) -> None:
        self._sight = Sight(kinematics, bodies, eye, radius)
        self._markers = dict(markers)
        self._one = lambda body: Sight(kinematics, [body], eye, radius)

    def broken(self, poses: Poses) -> BoolArray:
        hidden = np.zeros(len(poses), dtype=bool)
        for marker in self._markers.values():
            seen = np.flatnonzero(~hidden)
            hidden[seen] = self._sight.blocked(poses.take(seen), marker)
        return hidden

    def causes(self, poses: Poses) -> dict[str, BoolArray]:
        found = {}
        for body in self._sight.bodies:
            sight = self._one(body)
            for name, marker in self._markers.items():
                found[f"{name} behind {body.name}"] = sight.blocked(poses, marker)
        return found

    def remedy(self, poses: Poses) -> str:
        return f"{most_frequent(self.causes(poses))}; {ADVICE[self.name]}"


def most_frequent(causes: Mapping[str, BoolArray]) -> str:
    """'most often link3 and wall (412), …': the causes met most."""
    counts = sorted(((int(hit.sum()), name) for name, hit in causes.items()), key=lambda c: -c[0])
    return "most often " + ", ".join(f"{name} ({n})" for n, name in counts[:SHOWN] if n)
