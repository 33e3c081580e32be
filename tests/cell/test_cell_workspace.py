"""[workspace]: the work cell arrives in SI units, and what is wrong with it is told."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from elastocal.cell.work_cell import Workspace
from elastocal.config import Spot, direction

CELL = """
[robot]
urdf = "arm.urdf"
[tool.markers_m]
M1 = [0, 0, 0.1]
"ball, left" = [0.1, 0, 0.1]
"""
BOX = "[[workspace.obstacle]]\nname = 'table'\nshape = 'box'\nsize_m = [1, 2, 3]\n"
LOAD = "[workspace.load]\nshape = 'sphere'\nradius_m = 0.2\n"
HALF = "[[workspace.keep_out]]\nname = 'walkway'\npoint_m = [0, 0, 0]\n"


def test_every_key_arrives_in_si_units(read, tmp_path):
    space = read(
        CELL
        + """
[workspace]
clearance_mm = 50
self_clearance_m = 0.01
link_radius_mm = [200, 150, 0]
self_collision = false
ignored_pairs = [["link2", "link4"]]
torque_limits_Nm = [9000, 800]
[[workspace.obstacle]]
name = "table"
shape = "box"
size_m = [1, 2, 3]
position_m = [1, 0, 2]
rpy_deg = [0, 0, 90]
[[workspace.obstacle]]
name = "part"
shape = "mesh"
file = "part.stl"
scale = 0.001
[[workspace.body]]
name = "spindle"
on = "link3"
shape = "cylinder"
radius_m = 0.1
length_m = 0.4
[[workspace.body]]
name = "nose"
shape = "capsule"
radius_m = 0.1
length_m = 0.3
[[workspace.keep_out]]
name = "walkway"
point_m = [-1, 0, 0]
normal = [0, 3, 4]
[workspace.load]
shape = "sphere"
radius_m = 0.2
rope_m = 0.6
rope_radius_mm = 8
rope_axis = [0, 0, 2]
max_angle_deg = 60
min_height_m = -0.1
[workspace.visibility]
max_incidence_deg = 30
range_m = [0.5, 20]
beam_radius_mm = 4
line_of_sight = false
[workspace.visibility.normals]
M1 = [0, 0, 3]
"ball, left" = [1, 0, 0]
"""
    ).workspace
    assert (space.clearance, space.self_clearance) == (0.05, 0.01)
    assert space.link_radius == (0.2, 0.15, 0.0)
    assert not space.urdf_geometry
    assert not space.self_collision
    assert space.ignored_pairs == (("link2", "link4"),)
    assert space.torque_limits == (9000.0, 800.0)
    table, part = space.obstacles
    assert (table.name, table.shape, table.size.tolist()) == ("table", "box", [1.0, 2.0, 3.0])
    assert table.placement[:3, 3].tolist() == [1.0, 0.0, 2.0]
    np.testing.assert_allclose(table.placement[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    assert (part.mesh, part.size.tolist()) == (tmp_path / "part.stl", [0.001] * 3)
    assert (part.placement == np.eye(4)).all()
    spindle, nose = space.bodies
    assert (spindle.on, spindle.solid.size.tolist()) == ("link3", [0.1, 0.4])
    assert (nose.on, nose.solid.shape) == ("flange", "capsule")
    (half,) = space.keep_out
    np.testing.assert_allclose(half.normal, [0, 0.6, 0.8], rtol=1e-15)
    load = space.load
    assert (load.solid.shape, load.solid.size.tolist(), load.rope) == ("sphere", [0.2], 0.6)
    assert (load.rope_radius, load.min_height) == (0.008, -0.1)
    assert load.rope_axis.tolist() == [0.0, 0.0, 1.0]
    assert load.max_angle == pytest.approx(np.pi / 3)
    sight = space.visibility
    assert (sight.range, sight.beam_radius, sight.line_of_sight) == ((0.5, 20.0), 0.004, False)
    assert sight.max_incidence == pytest.approx(np.pi / 6)
    assert {name: n.tolist() for name, n in sight.normals.items()} == {
        "M1": [0.0, 0.0, 1.0],
        "ball, left": [1.0, 0.0, 0.0],
    }


def test_an_empty_table_is_a_cell_without_rules(read):
    assert read(CELL + "[workspace]\n").workspace == Workspace()


def test_visibility_without_keys_asks_for_line_of_sight(read):
    sight = read(CELL + "[workspace.visibility]\n").workspace.visibility
    assert sight.line_of_sight
    assert (sight.range, sight.max_incidence) == ((0.0, np.inf), None)


def test_one_radius_stands_for_all_links(read):
    assert read(CELL + "[workspace]\nlink_radius_m = 0.2").workspace.link_radius == (0.2,)


def test_geometry_of_the_urdf_or_none(read):
    assert read(CELL + "[workspace]\ngeometry = 'urdf'").workspace.urdf_geometry
    assert read(CELL + "[workspace]\ngeometry = 'none'").workspace == Workspace()


@given(
    st.lists(st.floats(-1e308, 1e308), min_size=3, max_size=3).filter(lambda v: any(v)),
)
def test_a_direction_has_length_one_whatever_its_size(vector):
    from pathlib import Path

    unit = direction(vector, Spot(Path("cell.toml")), "normal")
    assert np.linalg.norm(unit) == pytest.approx(1.0, abs=1e-12)
    scaled = np.array(vector) / np.abs(vector).max()
    assert np.linalg.norm(np.cross(unit, scaled)) < 1e-12
    assert unit @ scaled > 0


@pytest.mark.parametrize(
    ("text", "told"),
    [
        # unknown keys, missing units, missing keys
        ("[workspace]\nclearance = 1", ["unknown key workspace.clearance;", "clearance_mm or"]),
        (BOX.replace("size_m = [1, 2, 3]", ""), ["size_m of", "is missing; for a box it takes"]),
        (HALF, ["key normal of [[workspace.keep_out]] no. 1 is missing", "side"]),
        # wrong values
        ("[workspace]\nclearance_mm = -1", ["workspace.clearance_mm", ">= 0", "-1"]),
        ("[workspace]\nclearance_mm = 1\nclearance_m = 1", ["clearance_m", "two units"]),
        ("[workspace]\ngeometry = 'capsule'", ["did you mean 'capsules'"]),
        ("[workspace]\ngeometry = 'capsules'", ["link_radius_mm is missing"]),
        ("[workspace]\ngeometry = 'none'\nlink_radius_m = 1", ["link_radius_m", "no meaning"]),
        ("[workspace]\ngeometry = 'urdf'\nlink_radius_m = 1", ["link_radius_m", "no meaning"]),
        ("[workspace]\nignored_pairs = [['a']]", ["ignored_pairs", "pairs of names"]),
        ("[workspace.obstacle]\nname = 'a'", ["key workspace.obstacle takes tables", "[[work"]),
        ("[workspace]\nobstacle = [1]", ["[[workspace.obstacle]] no. 1 takes a table", "1"]),
        (BOX + "radius_m = 1", ["radius_m of", "no meaning for a box, which takes size_m"]),
        (BOX + "scale = 2", ["scale of", "no meaning for a box"]),
        (BOX + BOX, ["name of [[workspace.obstacle]] no. 2 repeats 'table'", "no. 1"]),
        (BOX.replace("'table'", "' a'"), ["one line without blanks"]),
        (BOX.replace("table", "link2"), ["'link2', which names a part of the arm"]),
        (BOX.replace("table", "walkway") + HALF + "normal = [1, 0, 0]", ["repeats 'walkway'"]),
        (HALF + "normal = [0, 0, 0]", ["normal of [[workspace.keep_out]] no. 1 is zero"]),
        (
            "[[workspace.body]]\nname='a'\non='link0'\nshape='sphere'\nradius_m=1",
            ["on of [[workspace.body]] no. 1", '"flange"', "'link0'"],
        ),
        (
            "[[workspace.body]]\nname='a'\nshape='cylinder'\nradius_m=1",
            ["length_m of [[workspace.body]] no. 1 is missing; for a cylinder"],
        ),
        (
            "[[workspace.obstacle]]\nname='a'\nshape='mesh'\nfile='no.stl'",
            ["key file of [[workspace.obstacle]] no. 1 names", "no.stl", "does not exist"],
        ),
        (LOAD + "rope_axis = [0, 0, 1]", ["rope_axis has no meaning without", "max_angle_deg"]),
        (LOAD + "max_angle_deg = 9", ["max_angle_deg has no meaning without", "rope_axis"]),
        (LOAD + "rope_axis = [0, 0, 0]\nmax_angle_deg = 9", ["rope_axis is zero"]),
        (LOAD + "rope_axis = [0, 0, 1]\nmax_angle_deg = 200", ["max_angle_deg", "up to 180"]),
        (
            "[workspace.visibility]\nmax_incidence_deg = 30\n"
            "[workspace.visibility.normals]\nM2 = [0, 0, 1]",
            ["[workspace.visibility.normals] names 'M2'", "did you mean 'M1'", "ball, left"],
        ),
        (
            "[workspace.visibility.normals]\nM1 = [0, 0, 1]",
            ["no meaning without max_incidence_deg"],
        ),
        ("[workspace.visibility]\nmax_incidence_deg = 30", ["without the reflectors' axes"]),
        (
            "[workspace.visibility]\nmax_incidence_deg = 30\n"
            "[workspace.visibility.normals]\nM1 = [0, 0, 0]",
            ["workspace.visibility.normals.M1 is zero"],
        ),
        ("[workspace.visibility]\nrange_m = [2, 1]", ["range_m", "nearest < farthest", "2.0"]),
        ("[workspace.visibility]\nrange_m = [-1, 1]", ["range_m", "0 <= nearest"]),
    ],
)
def test_what_is_wrong_is_told_with_key_and_remedy(refusal, text, told):
    message = refusal(CELL + text)
    assert not [part for part in told if part not in message], message


def test_collision_shapes_of_a_urdf_need_a_urdf(refusal):
    message = refusal("[robot]\ndh = 'dh.csv'\n[workspace]\ngeometry = 'urdf'")
    assert "needs [robot] urdf" in message
    assert "link_radius_mm" in message


def test_names_of_markers_need_markers(refusal):
    text = (
        "[workspace.visibility]\nmax_incidence_deg = 9\n[workspace.visibility.normals]\nA=[0,0,1]"
    )
    assert "[tool.markers_m] has none" in refusal("[robot]\nurdf = 'arm.urdf'\n" + text)
