"""The arm as bodies to draw: the URDF's collision shapes where they are at hand, else capsules."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell, Solid
from elastocal.design.feasibility.bodies import Body, cell_bodies, skeleton
from elastocal.design.feasibility.carriers import WORLD
from elastocal.design.feasibility.shapes import hull, mesh_hull
from elastocal.design.feasibility.urdf_bodies import urdf_bodies
from elastocal.errors import ElastocalError
from elastocal.manipulator.chain import Chain

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

MOST_TRIANGLES = 8000  # of all bodies together; more make the page slow and large
MERIDIANS, PARALLELS = 14, 3  # of a cap
# Radii of the first and the last link over the arm's length, where none are stated.
STOUT, SLIM = 0.038, 0.014


@dataclass(frozen=True)
class Shell:
    """A convex body as triangles: `points` (k, 3) m in its carrier's frame, `faces` (f, 3).

    `carrier`: i ≥ 0 the frame of joint i after its motion, WORLD the base frame for the arm and
    the data's frame for what stands in the cell.
    """

    points: Array
    faces: IntArray
    carrier: int


@dataclass(frozen=True)
class Shells:
    """What is drawn of a cell: the arm with what it carries, what stands around it, and how."""

    arm: tuple[Shell, ...]
    around: tuple[Shell, ...]
    drawn_from: str


def shells_of(cell: Cell, chain: Chain) -> Shells:
    """The bodies of a cell; a geometry that cannot be had is replaced by capsules, and said so."""
    arm, drawn_from = _arm(cell, chain)
    try:
        bodies: Sequence[Body] = cell_bodies(cell, chain)
    except ElastocalError:
        bodies = ()  # a mesh that is not there stops no report
    carried = [b for b in bodies if b.kind == "carried" and b.carrier >= 0]
    around = [b for b in bodies if b.kind == "obstacle"]
    return Shells(
        (*arm, *_shells([(b.solid, b.carrier) for b in carried])),
        _shells([(b.solid, b.carrier) for b in around]),
        drawn_from,
    )


def _arm(cell: Cell, chain: Chain) -> tuple[tuple[Shell, ...], str]:
    radii = cell.workspace.link_radius
    if cell.robot.urdf is not None and not radii:
        try:
            shells = _shells(urdf_bodies(cell, chain))
        except ElastocalError:
            shells = ()  # no collision geometry, or its files are not there: meshes are optional
        if shells and sum(len(s.faces) for s in shells) <= MOST_TRIANGLES:
            return shells, "the convex hulls of the URDF's collision geometry"
    if not radii:
        length = chain_length(chain)
        radii = tuple(float(r) for r in length * np.linspace(STOUT, SLIM, chain.n_joints))
    capsules = skeleton(chain, radii, np.eye(4), f"{cell.path or cell.name}: [workspace]")
    text = "capsules between its joints"
    return _shells([(body.solid, body.carrier) for body in capsules]), text


def chain_length(chain: Chain) -> float:
    """Sum in m of the distances from joint to joint and to the flange; 1 m where all coincide."""
    steps = [*(joint.placement for joint in chain.joints), chain.flange_placement]
    return float(sum(np.linalg.norm(T[:3, 3]) for T in steps)) or 1.0


def _shells(solids: Sequence[tuple[Solid, int]]) -> tuple[Shell, ...]:
    found = []
    for solid, carrier in solids:
        try:
            found.append(Shell(*triangles_of(solid), carrier))
        except ElastocalError:
            continue  # an unreadable mesh: the others are still worth drawing
    return tuple(found)


def triangles_of(solid: Solid) -> tuple[Array, IntArray]:
    """Points (k, 3) in m in the carrier's frame and triangles (f, 3), turned outwards.

    Round shapes become inscribed polyhedra.  Raises InputError for a mesh that cannot be read.
    """
    if solid.shape == "mesh":
        points, faces = mesh_hull(solid)
        return points @ solid.placement[:3, :3].T + solid.placement[:3, 3], faces
    if solid.shape == "cylinder":
        ring = _ring() * float(solid.size[0])
        half = np.array([0.0, 0.0, float(solid.size[1]) / 2])
        cloud = np.vstack([ring - half, ring + half])
        cloud = cloud @ solid.placement[:3, :3].T + solid.placement[:3, 3]
    else:
        centres, radius = hull(solid)
        ball = _ball() @ solid.placement[:3, :3].T
        cloud = (centres[:, None] + radius * ball).reshape(-1, 3) if radius else centres
    return _outward(cloud)


def _outward(cloud: Array) -> tuple[Array, IntArray]:
    from scipy.spatial import ConvexHull

    found = ConvexHull(cloud)
    used, index = np.unique(found.simplices, return_inverse=True)
    points, faces = cloud[used], index.reshape(found.simplices.shape)
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), found.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return points, faces.astype(np.int64)


def _ring() -> Array:
    angle = np.linspace(0, 2 * np.pi, MERIDIANS, endpoint=False)
    return np.column_stack([np.cos(angle), np.sin(angle), np.zeros(MERIDIANS)])


def _ball() -> Array:
    """Points of the unit sphere: poles, and rings of which one is the equator."""
    height = np.sin(np.linspace(-np.pi / 2, np.pi / 2, 2 * PARALLELS + 1))[1:-1]
    rings = [_ring() * np.sqrt(1 - h * h) + [0.0, 0.0, h] for h in height]
    return np.vstack([*rings, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])


def base_or_joint(shell: Shell) -> int:
    """Index of the shell's carrier among the frames (base, joint 1, …, joint n)."""
    return 0 if shell.carrier == WORLD else shell.carrier + 1
