"""Solids: hull and support agree with points of the surface; meshes are their convex hull."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planning.feasibility.small_cells import at
from scipy.spatial.transform import Rotation

from elastocal.cell.workspace_rules import Solid
from elastocal.errors import InputError
from elastocal.planning import (
    mesh_hull,
    support,
    touches,
)

CUBE = """v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
v 0.5 0.5 0.5
f 1 3 2
f 1 4 3
f 5 6 7
f 5 7 8
f 1 2 6
f 1 6 5
f 3 4 8
f 3 8 7
f 2 3 7
f 2 7 6
f 4 1 5
f 4 5 8
f 9 1 2
"""
SIZES = {"box": [0.4, 0.2, 0.6], "sphere": [0.3], "cylinder": [0.2, 0.7], "capsule": [0.1, 0.5]}
directions = (
    st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 1e-3)
)


def placement(seed: int) -> np.ndarray:
    T = at(0.3, -0.2, 0.5)
    T[:3, :3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    return T


def surface(solid: Solid, n: int = 40_000) -> np.ndarray:
    """Random points of the solid's surface, written down for each shape by itself."""
    rng, s = np.random.default_rng(0), solid.size
    unit = rng.normal(size=(n, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    if solid.shape == "box":
        p = s / 2 * unit / np.abs(unit).max(axis=1, keepdims=True)
    elif solid.shape == "sphere":
        p = s[0] * unit
    elif solid.shape == "capsule":
        p = s[0] * unit + np.outer(np.sign(unit[:, 2]), [0, 0, s[1] / 2])
    else:
        turn, z = rng.uniform(0, 2 * np.pi, n), s[1] * (rng.integers(0, 2, n) - 0.5)
        p = np.stack([s[0] * np.cos(turn), s[0] * np.sin(turn), z], axis=1)
    return p @ solid.placement[:3, :3].T + solid.placement[:3, 3]


@pytest.mark.parametrize("shape", SIZES)
@given(direction=directions)
def test_support_is_the_farthest_point_of_the_surface(shape, direction):
    solid = Solid(shape, shape, np.array(SIZES[shape]), placement(1))
    direction = direction / np.linalg.norm(direction)
    farthest = (surface(solid, 4000) @ direction).max()
    # Random points fall a little short of the extreme one, and never beyond it.
    assert farthest - 1e-12 <= support(solid, direction) <= farthest + 0.03


def test_a_mesh_is_its_convex_hull(tmp_path):
    (tmp_path / "cube.obj").write_text(CUBE)
    mesh = Solid("cube", "mesh", np.array([1.0, 2.0, 0.5]), placement(4), tmp_path / "cube.obj")
    centred = mesh.placement @ at(0.5, 1.0, 0.25)
    same = Solid("box", "box", np.array([1.0, 2.0, 0.5]), centred)
    for direction in np.random.default_rng(5).normal(size=(20, 3)):
        direction /= np.linalg.norm(direction)
        assert support(mesh, direction) == pytest.approx(support(same, direction))
    points, triangles = mesh_hull(mesh)
    assert len(points) == 8
    a, b, c = (points[triangles[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(1.0)  # all triangles outwards, none missing
    # What lies wholly inside the mesh touches it.
    assert touches(mesh, centred[:3, 3], 1e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no such file"),
        ("nonsense", "cannot be read"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "flat"),
    ],
)
def test_a_bad_mesh_is_named(tmp_path, text, message):
    path = tmp_path / "part.obj"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=f"(?=.*part.obj).*fixture.*{message}"):
        mesh_hull(Solid("fixture", "mesh", np.ones(3), mesh=path))
