"""What a solid is to geometry: its hull, its support function and its coal shape."""

from __future__ import annotations

from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Solid
from elastocal.errors import InputError

Array = NDArray[np.float64]

CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))


def hull(solid: Solid) -> tuple[Array, float]:
    """Points (k, 3) in the carrier's frame and a radius: the solid lies in their convex hull
    grown by the radius.  Exact for sphere, capsule, box and mesh; a cylinder becomes the capsule
    around it."""
    if solid.shape == "mesh":
        points, radius = mesh_hull(solid)[0], 0.0
    elif solid.shape == "box":
        points, radius = CORNERS * solid.size, 0.0
    elif solid.shape == "sphere":
        points, radius = np.zeros((1, 3)), float(solid.size[0])
    else:
        half = np.array([0.0, 0.0, solid.size[1] / 2])
        points, radius = np.stack([-half, half]), float(solid.size[0])
    return points @ solid.placement[:3, :3].T + solid.placement[:3, 3], radius


def few_points(solid: Solid) -> tuple[Array, float]:
    """As `hull`, but a mesh is the box around it, so that k ≤ 8."""
    points, radius = hull(solid)
    if len(points) > len(CORNERS):
        low, high = points.min(axis=0), points.max(axis=0)
        points = (low + high) / 2 + CORNERS * (high - low)
    return points, radius


def support(solid: Solid, direction: Array) -> float:
    """max d·x over the solid, for a unit direction d (3,) in the carrier's frame, in m; exact."""
    points, radius = hull(solid)
    if solid.shape == "cylinder":
        along = float(solid.placement[:3, 2] @ direction)
        radius *= float(np.sqrt(max(1.0 - along**2, 0.0)))
    return float((points @ direction).max()) + radius


def touches(solid: Solid, point: Array, within: float) -> bool:
    """True where the solid is at most `within` m from a point (3,) in the carrier's frame."""
    import coal

    there = coal.Transform3s(np.eye(3), np.array(point, dtype=float))
    here = coal.Transform3s(solid.placement[:3, :3].copy(), solid.placement[:3, 3].copy())
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    return bool(coal.collide(coal_shape(solid), here, coal.Sphere(within), there, request, result))


def capsule_between(name: str, a: Array, b: Array, radius: float) -> Solid:
    """The capsule with cap centres a and b (3,); a sphere where they coincide."""
    length = float(np.linalg.norm(b - a))
    placement = np.eye(4)
    placement[:3, 3] = (a + b) / 2
    if length < 1e-9:
        return Solid(name, "sphere", np.array([radius]), placement)
    placement[:3, :3] = rotation_to((b - a) / length)
    return Solid(name, "capsule", np.array([radius, length]), placement)


def rotation_to(z: Array) -> Array:
    """Rotations (..., 3, 3) whose third column is the unit vector z (..., 3)."""
    z = np.asarray(z, dtype=float)
    across = np.where(np.abs(z[..., :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    x = np.cross(across, z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def coal_shape(solid: Solid) -> Any:
    """The coal shape centred at the solid's placement; meshes are their convex hull.

    The hull makes a mesh a solid body: a triangle surface would not see what lies inside it.
    """
    import coal

    size = [float(s) for s in solid.size]
    if solid.shape == "box":
        return coal.Box(*size)
    if solid.shape == "sphere":
        return coal.Sphere(size[0])
    if solid.shape == "cylinder":
        return coal.Cylinder(size[0], size[1])
    if solid.shape == "capsule":
        return coal.Capsule(size[0], size[1])
    points, triangles = mesh_hull(solid)
    corners, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for point in points:
        corners.append(point)
    for a, b, c in triangles:
        faces.append(coal.Triangle(int(a), int(b), int(c)))
    return coal.Convex(corners, faces)


def mesh_hull(solid: Solid) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (k, 3) of the mesh's convex hull in the solid's own frame, and its triangles.

    Raises InputError where the file is missing, cannot be read or encloses no volume.
    """
    if solid.mesh is None:
        raise InputError(f"body '{solid.name}' is a mesh, but no file is given for it")
    x, y, z = (float(s) for s in solid.size)
    return _mesh_hull(solid.mesh, (x, y, z), solid.name)


@lru_cache(maxsize=256)
def _mesh_hull(
    path: Path, scale: tuple[float, float, float], name: str
) -> tuple[Array, NDArray[np.int64]]:
    import coal
    from scipy.spatial import ConvexHull, QhullError

    if not path.is_file():
        raise InputError(f"mesh '{path}' of body '{name}' does not exist")
    try:
        vertices = np.array(coal.MeshLoader().load(str(path), np.array(scale)).vertices())
        found = ConvexHull(vertices)
    except QhullError:
        raise InputError(f"mesh '{path}' of body '{name}' is flat: it encloses no volume") from None
    except Exception as error:  # assimp's failures surface as several kinds
        raise InputError(
            f"mesh '{path}' of body '{name}' cannot be read: {error}; STL, OBJ and DAE can"
        ) from None
    used, index = np.unique(found.simplices, return_inverse=True)
    points, triangles = vertices[used], index.reshape(found.simplices.shape)
    # coal wants every normal to point outwards; Qhull's simplices are in no order.
    a, b, c = (points[triangles[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), found.equations[:, :3]) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return points, triangles.astype(np.int64)
