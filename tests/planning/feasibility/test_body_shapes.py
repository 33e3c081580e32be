"""Solids: hull and support agree with points of the surface; meshes are their convex hull."""

import numpy as np
import pytest
from planning.feasibility.small_cells import at
from scipy.spatial.transform import Rotation

from elastocal.cell import Solid
from elastocal.messages import InputError
from elastocal.planning.collision import mesh_hull, support, touches

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


def placement(seed: int) -> np.ndarray:
    T = at(0.3, -0.2, 0.5)
    T[:3, :3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    return T


@pytest.mark.parametrize("tilt", [0.0, 0.4, 1.2, np.pi / 2, 2.5])
def test_tilted_solids_reach_as_far_as_rim_cap_and_corner(tilt):
    c, s = abs(np.cos(tilt)), abs(np.sin(tilt))
    tilted = np.eye(4)
    tilted[:3, :3] = Rotation.from_euler("x", tilt).as_matrix()
    for shape, size, reach in (
        ("sphere", [0.3], 0.3), ("capsule", [0.1, 0.8], 0.4 * c + 0.1),
        ("cylinder", [0.1, 0.8], 0.4 * c + 0.1 * s), ("box", [0.4, 0.2, 0.6], 0.3 * c + 0.1 * s),
    ):  # fmt: skip
        solid = Solid(shape, shape, np.array(size), tilted)
        assert support(solid, np.array([0.0, 0.0, 1.0])) == pytest.approx(reach)


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
