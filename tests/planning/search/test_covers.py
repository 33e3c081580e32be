"""Covers contain their solid, and smooth distances never exceed the true ones."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import coal
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from elastocal.cell.workspace_rules import Solid
from elastocal.planning import coal_shape, excess, signed_distance, smooth_min, sphere_cover
from elastocal.planning.polish import MOST_SPHERES, ROUNDING
from elastocal.units import Array

PLACED = np.eye(4)
PLACED[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.7, 1.1]).as_matrix()
PLACED[:3, 3] = [0.2, -0.1, 0.4]
SOLIDS = [
    Solid("sphere", "sphere", np.array([0.3]), PLACED),
    Solid("box", "box", np.array([0.2, 0.9, 0.5]), PLACED),
    Solid("plate", "box", np.array([1.5, 1.0, 0.05]), PLACED),
    Solid("cylinder", "cylinder", np.array([0.15, 0.8]), PLACED),
    Solid("capsule", "capsule", np.array([0.12, 0.7]), PLACED),
    Solid("rope", "capsule", np.array([0.01, 1.0]), PLACED),
]
TINY = 1e-6  # m: radius of the sphere that stands for a point in coal


def distances(solid: Solid, points: Array) -> Array:
    """By coal, negative inside."""
    shape, probe = coal_shape(solid), coal.Sphere(TINY)
    at = coal.Transform3s(solid.placement[:3, :3], solid.placement[:3, 3])
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    found = []
    for p in points:
        result.clear()
        there = coal.Transform3s(np.eye(3), p)
        found.append(coal.distance(shape, at, probe, there, request, result) + TINY)
    return np.array(found)


def around(solid: Solid, n: int, reach: float) -> Array:
    """Points in the box around the solid, larger by the factor `reach`."""
    across = 2 * solid.size[0]
    extent = solid.size
    if solid.shape != "box":
        length = 0.0 if solid.shape == "sphere" else solid.size[1]
        extent = np.array([across, across, length + across])
    points = np.random.default_rng(2).uniform(-0.5, 0.5, (n, 3)) * extent * reach
    return np.asarray(points @ solid.placement[:3, :3].T + solid.placement[:3, 3])


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda s: s.name)
def test_spheres_cover_the_solid(solid: Solid) -> None:
    points = around(solid, 4000, 1.0)
    inside = points[distances(solid, points) <= 0]
    assert len(inside) > 1000
    centres, radius = sphere_cover(solid)
    nearest = np.linalg.norm(inside[:, None] - centres, axis=2).min(axis=1)
    assert (nearest <= radius).all()
    assert len(centres) <= MOST_SPHERES**2
    # No point of the cover is further than its radius from the solid.
    assert (distances(solid, centres) <= TINY).all()
    assert excess(solid) >= 0 and excess(SOLIDS[0]) == 0


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda s: s.name)
def test_signed_distance_is_the_true_one_from_below(solid: Solid) -> None:
    p = ca.SX.sym("p", 3)
    f = ca.Function("d", [p], [signed_distance(solid, p)])
    points = around(solid, 1000, 3.0)
    found = f(points.T).full().ravel()
    true = distances(solid, points)
    assert (true > 0).sum() > 300
    outside = true > 1e-4
    assert (found[outside] <= true[outside] + 2e-6).all()
    assert (found[outside] >= true[outside] - 2 * ROUNDING - 2e-6).all()
    np.testing.assert_array_equal(found[~outside] < 1e-4, True)
    slope = ca.Function("s", [p], [ca.gradient(signed_distance(solid, p), p)])
    # At its centre too, where distances have kinks, nothing is NaN.
    everywhere = np.vstack([points, solid.placement[:3, 3]])
    assert np.isfinite(slope(everywhere.T).full()).all()


def test_a_mesh_is_the_box_around_it(tmp_path: Path) -> None:
    corners = np.array([[0, 0, 0], [0.4, 0, 0], [0, 0.3, 0], [0, 0, 0.2]], dtype=float)
    faces = [(1, 3, 2), (1, 2, 4), (2, 3, 4), (1, 4, 3)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {b} {c}" for a, b, c in faces]
    path = tmp_path / "wedge.obj"
    path.write_text("\n".join(lines) + "\n")
    mesh = Solid("wedge", "mesh", np.ones(3), PLACED, path)
    middle = np.eye(4)
    middle[:3, 3] = [0.2, 0.15, 0.1]
    box = Solid("box", "box", np.array([0.4, 0.3, 0.2]), PLACED @ middle)
    for mine, expected in zip(sphere_cover(mesh), sphere_cover(box), strict=True):
        np.testing.assert_allclose(mine, expected, atol=1e-7)


def test_smooth_minimum_lies_just_below_the_least() -> None:
    v = ca.SX.sym("v", 5)
    f = ca.Function("m", [v], [smooth_min(v, 1e-3)])
    for values in np.random.default_rng(3).uniform(-1, 1, (50, 5)):
        assert values.min() - 1e-3 * np.log(5) - 1e-12 <= float(f(values)) <= values.min() + 1e-15
    assert float(f(np.full(5, 400.0))) == pytest.approx(400.0 - 1e-3 * np.log(5))
    assert np.isfinite(float(f(np.array([1e4, 0.0, -1e4, 3.0, 2.0]))))
