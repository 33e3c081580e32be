"""What the tracker sees: range, incidence on the reflector, free line of sight."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from elastocal.cell import Solid
from elastocal.design.feasibility.bodies import Body
from elastocal.design.feasibility.carriers import WORLD
from elastocal.design.feasibility.collision import Collisions
from elastocal.design.feasibility.frames import Kinematics, Poses
from elastocal.design.feasibility.pairs import Pair
from elastocal.design.feasibility.shapes import rotation_to, touches

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# The beam ends this many of its radii before the marker: a reflector on a surface is then seen
# at incidences up to acos(1/4) = 75° from the surface's normal.
END = 4.0
SHORTEST = 1e-3  # m: nothing fits into a shorter beam


def marker_positions(poses: Poses, markers: Sequence[Array]) -> Array:
    """Markers (m, 3) of the flange frame in the data's frame (N, m, 3)."""
    T = poses.flange
    return np.asarray(np.einsum("nij,mj->nmi", T[:, :3, :3], np.array(markers))) + T[:, None, :3, 3]


def incidence(
    poses: Poses, markers: Sequence[Array], normals: Sequence[Array], eye: Array
) -> Array:
    """Angle (N, m) in rad between each reflector's axis (flange frame) and its line to the eye."""
    to_eye = eye - marker_positions(poses, markers)
    axes = np.einsum("nij,mj->nmi", poses.flange[:, :3, :3], np.array(normals))
    across = np.linalg.norm(np.cross(axes, to_eye), axis=2)
    return np.asarray(np.arctan2(across, np.einsum("nmi,nmi->nm", axes, to_eye)))


class Sight:
    """Beams from the tracker to the markers, tested as capsules against bodies.

    The beam to a marker at distance d is the capsule of `radius` from the tracker to the point
    4 radii (at least 1 mm) before the marker, so that the body under a reflector does not hide
    it.  coal's capsules have a fixed length, so two of length l = 2^k ≤ d' < 2 l stand for one of
    length d': one from the tracker, one up to its end; their union is exactly that beam.
    A body that contains the tracker's position is the instrument itself and hides nothing.
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

    def blocked(self, poses: Poses, marker: Array) -> BoolArray:
        """(N,): something lies between the tracker and a marker (3,) of the flange frame."""
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
