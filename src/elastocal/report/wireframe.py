"""Solids as lines, for pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Solid
from elastocal.design.feasibility.shapes import CORNERS, mesh_hull

Array = NDArray[np.float64]

ROUND = 49  # points of a full circle; a multiple of 4, and the first again
LENGTHWISE = 4  # lines along a cylinder or capsule


def wireframe(solid: Solid) -> list[Array]:
    """Polylines (k, 3) in m in the carrier's frame that show the solid's edges or outline."""
    if solid.shape == "mesh":
        points, triangles = mesh_hull(solid)
        lines = [points[[*triangle, triangle[0]]] for triangle in triangles]
    else:
        lines = {"box": _box, "sphere": _sphere, "cylinder": _cylinder, "capsule": _capsule}[
            solid.shape
        ](solid.size)
    R, p = solid.placement[:3, :3], solid.placement[:3, 3]
    return [line @ R.T + p for line in lines]


def _box(size: Array) -> list[Array]:
    corners = CORNERS * size
    apart = (CORNERS[:, None] != CORNERS[None]).sum(axis=2)
    return [corners[[i, j]] for i, j in np.argwhere(np.triu(apart == 1))]


def _circle(radius: float, first: int, second: int, part: float = 1.0) -> Array:
    """The circle, or that part of it, from axis `first` towards axis `second`."""
    angle = np.linspace(0.0, 2 * np.pi * part, int((ROUND - 1) * part) + 1)
    points = np.zeros((len(angle), 3))
    points[:, first], points[:, second] = radius * np.cos(angle), radius * np.sin(angle)
    return points


def _sphere(size: Array) -> list[Array]:
    return [_circle(float(size[0]), *axes) for axes in ((0, 1), (1, 2), (2, 0))]


def _cylinder(size: Array) -> list[Array]:
    radius, half = float(size[0]), np.array([0.0, 0.0, size[1] / 2])
    ring = _circle(radius, 0, 1)
    feet = ring[: ROUND - 1 : (ROUND - 1) // LENGTHWISE]
    return [ring - half, ring + half, *(np.stack([p - half, p + half]) for p in feet)]


def _capsule(size: Array) -> list[Array]:
    radius, half = float(size[0]), np.array([0.0, 0.0, size[1] / 2])
    caps = [_circle(radius, axis, 2, 0.5) for axis in (0, 1)]
    up = [arc + half for arc in caps]
    down = [arc * [1.0, 1.0, -1.0] - half for arc in caps]
    return [*_cylinder(size), *up, *down]
