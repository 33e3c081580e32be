"""Solids as seen by a smooth optimiser: covers by spheres and signed distances.

A clearance between two bodies holds if every sphere of a cover of one keeps it to the other:
conservative, and differentiable where the exact distance of two convex bodies is not.
"""

from __future__ import annotations

from itertools import product

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Solid
from elastocal.design.feasibility.shapes import mesh_hull
from elastocal.manipulator import rigid

Array = NDArray[np.float64]

MOST = 6  # spheres along an edge of a box
MOST_ALONG = 12  # and along the axis of a cylinder or capsule
ROUNDING = 1e-4  # m by which edges and corners are rounded off, on the safe side


def sphere_cover(solid: Solid) -> tuple[Array, float]:
    """Centres (k, 3) in the carrier's frame and the radius of equal spheres that cover a solid.

    A solid is cut into about cubic cells and a sphere put around each; a capsule's spheres
    stand on its axis, ends included.
    """
    solid = _boxed(solid)
    if solid.shape == "sphere":
        centres, radius = np.zeros((1, 3)), float(solid.size[0])
    elif solid.shape == "box":
        counts = [min(int(np.ceil(e / solid.size.min() - 1e-9)), MOST) for e in solid.size]
        centres = np.array(list(product(*(_midpoints(k) for k in counts)))) * solid.size
        radius = float(np.linalg.norm(solid.size / counts)) / 2
    else:
        r, length = (float(s) for s in solid.size)
        count = int(np.clip(np.ceil(length / r), 1, MOST_ALONG))
        along = (
            _midpoints(count) if solid.shape == "cylinder" else np.linspace(-0.5, 0.5, count + 1)
        )
        centres = np.outer(along * length, [0.0, 0.0, 1.0])
        radius = float(np.hypot(r, length / count / 2))
    T = solid.placement
    return centres @ T[:3, :3].T + T[:3, 3], radius


def excess(solid: Solid) -> float:
    """How much too thick the cover of a solid is, in m."""
    radius = sphere_cover(solid)[1]
    boxed = _boxed(solid)
    return radius - float(boxed.size.min() / 2 if boxed.shape == "box" else boxed.size[0])


def signed_distance(solid: Solid, point: ca.SX) -> ca.SX:
    """Distance in m of a point (3,) in the carrier's frame from a solid, negative inside.

    Never larger than the true one, smaller by 2 `ROUNDING` at most; a mesh is the box around it.
    Outside |max(p − h, 0)|, inside max(p − h), with h the half extents of a box, or the radius
    and half length of a cylinder; differentiable outside.
    """
    solid = _boxed(solid)
    T = np.linalg.inv(solid.placement)
    p = rigid.constant(T[:3, :3]) @ point + rigid.constant(T[:3, 3])
    if solid.shape == "sphere":
        return ca.sqrt(ca.sumsqr(p) + rigid.TINY) - float(solid.size[0])
    if solid.shape == "capsule":
        beyond = ca.fmax(ca.fabs(p[2]) - float(solid.size[1]) / 2, 0)
        return ca.sqrt(ca.sumsqr(p[:2]) + beyond**2 + rigid.TINY) - float(solid.size[0])
    if solid.shape == "box":
        past = ca.fabs(p) - rigid.constant(solid.size / 2)
    else:
        across = ca.sqrt(ca.sumsqr(p[:2]) + ROUNDING**2) - ROUNDING
        past = ca.vertcat(across - float(solid.size[0]), ca.fabs(p[2]) - float(solid.size[1]) / 2)
    outside = ca.sqrt(ca.sumsqr(ca.fmax(past, 0)) + ROUNDING**2) - ROUNDING
    return outside + ca.fmin(ca.mmax(past), 0)


def smooth_min(values: ca.SX, width: float) -> ca.SX:
    """−w log Σ exp(−v/w): at most min v, and below it by no more than w log(number)."""
    least = ca.mmin(values)
    return least - width * ca.log(ca.sum1(ca.exp((least - values) / width)))


def _midpoints(count: int) -> Array:
    return (np.arange(count) + 0.5) / count - 0.5


def _boxed(solid: Solid) -> Solid:
    """A mesh as the box around it in its own axes; any other solid unchanged."""
    if solid.shape != "mesh":
        return solid
    points = mesh_hull(solid)[0]
    low, high = points.min(axis=0), points.max(axis=0)
    middle = np.eye(4)
    middle[:3, 3] = (low + high) / 2
    return Solid(solid.name, "box", high - low, solid.placement @ middle)
