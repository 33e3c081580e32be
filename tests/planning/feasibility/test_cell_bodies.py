"""The list of bodies: where each stands, what carries it, and wrong input by name."""

from dataclasses import replace

import numpy as np
import pytest
from planning.feasibility.small_cells import KR270_CHAIN, cell, sphere

from elastocal.cell import CarriedBody, Workspace
from elastocal.cell_tables import Robot
from elastocal.messages import InputError
from elastocal.model.urdf import read_urdf
from elastocal.planning.collision import WORLD, cell_bodies, hull


def named(workspace, chain=KR270_CHAIN, **changes):
    given = replace(cell(workspace), **changes)
    return {body.name: body for body in cell_bodies(given, chain)}


@pytest.mark.parametrize(
    ("workspace", "message"),
    [
        (Workspace(link_radius=(0.1, 0.2)), "link_radius_mm has 2 values.*6 links"),
        (
            Workspace(bodies=(CarriedBody(sphere("a", 1, (0, 0, 0)), "link33"),)),
            "'a' is on 'link33' .did you mean 'link3'",
        ),
        (
            Workspace(obstacles=(sphere("link2", 1, (0, 0, 0)),), link_radius=(0.1,)),
            "two bodies named 'link2'",
        ),
        (Workspace(urdf_geometry=True), "the robot has no URDF"),
        (Workspace(urdf_geometry=True, link_radius=(0.1,)), "only one"),
    ],
)
def test_wrong_workspaces_are_refused_by_name(workspace, message):
    with pytest.raises(InputError, match=message):
        named(workspace)


URDF = """<robot name="r">
<link name="world"/><link name="base"/>{links}<link name="finger"><collision>
<geometry><sphere radius="0.05"/></geometry></collision></link>
<joint name="lift" type="prismatic"><parent link="world"/><child link="base"/>
<origin xyz="0 0 1"/><axis xyz="0 0 1"/><limit lower="0" upper="1" effort="0" velocity="0"/></joint>
{joints}
<joint name="grip" type="prismatic"><parent link="l4"/><child link="finger"/>
<origin xyz="0 0.1 0"/><axis xyz="0 1 0"/>
<limit lower="0" upper="1" effort="0" velocity="0"/></joint>
</robot>"""
SHAPES = {
    1: '<box size="0.1 0.2 0.3"/>',
    2: '<cylinder radius="0.1" length="0.5"/>',
    3: '<sphere radius="0.2"/>',
    4: '<mesh filename="{mesh}" scale="0.001 0.001 0.001"/>',
}


# 9 units of half a metre, which the file states of itself.
DAE = """<COLLADA><asset><unit meter="0.5"/></asset><library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">0 0 0 18 0 0 0 18 0 0 0 18</float_array>
<technique_common><accessor source="#a" count="4" stride="3"><param name="X"/><param name="Y"/>
<param name="Z"/></accessor></technique_common></source><vertices id="v"><input semantic="POSITION"
source="#p"/></vertices><triangles count="2"><input semantic="VERTEX" source="#v"/><p>0 1 2 0 1 3
</p></triangles></mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s">
<node><instance_geometry url="#g"/></node></visual_scene></library_visual_scenes><scene>
<instance_visual_scene url="#s"/></scene></COLLADA>"""


def write_urdf(folder, mesh):
    box = '<geometry><box size="1 1 1"/></geometry>'
    links = f'<link name="pedestal"><collision>{box}</collision></link>'
    joints = '<joint name="fix" type="fixed"><parent link="base"/><child link="pedestal"/>'
    joints += '<origin xyz="0 0 -0.5"/></joint>'
    for i, shape in SHAPES.items():
        parent = "base" if i == 1 else f"l{i - 1}"
        links += f'<link name="l{i}"><collision><origin xyz="0 0 0.1"/><geometry>'
        links += shape.format(mesh=mesh) + "</geometry></collision></link>"
        joints += f'<joint name="j{i}" type="revolute"><parent link="{parent}"/>'
        joints += f'<child link="l{i}"/>'
        joints += '<origin xyz="0 0 0.4"/><axis xyz="0 1 0"/>'
        joints += '<limit lower="-1" upper="1" effort="0" velocity="0"/></joint>'
    path = folder / "arm.urdf"
    path.write_text(URDF.format(links=links, joints=joints))
    return path


def urdf_named(path):
    robot = Robot(urdf=path, base="base", flange="l4")
    chain = read_urdf(path, base="base", flange="l4")
    return named(Workspace(urdf_geometry=True), chain, robot=robot)


def test_urdf_geometry_is_carried_by_the_joints_of_the_chain(tmp_path):
    """In a URDF whose base is itself lifted and whose gripper moves: both stand still."""
    folder = tmp_path / "arm_description" / "urdf"
    folder.mkdir(parents=True)
    (folder.parent / "part.dae").write_text(DAE)
    found = urdf_named(write_urdf(folder, "package://arm_description/part.dae"))
    carriers = {name: body.carrier for name, body in found.items()}
    assert carriers == {
        "pedestal_0": WORLD, "l1_0": 0, "l2_0": 1, "l3_0": 2, "l4_0": 3, "finger_0": 3,
    }  # fmt: skip
    assert np.allclose(found["pedestal_0"].solid.placement[:3, 3], [0, 0, -0.5])
    assert np.allclose(found["l1_0"].solid.size, [0.1, 0.2, 0.3])
    assert np.allclose(found["l2_0"].solid.size, [0.1, 0.5])
    assert np.allclose(found["finger_0"].solid.placement[:3, 3], [0, 0.1, 0])
    assert np.allclose(hull(found["l4_0"].solid)[0].max(axis=0), [0.009, 0.009, 0.109])


def test_a_missing_mesh_of_the_urdf_is_an_input_error(tmp_path):
    path = write_urdf(tmp_path, "package://arm_description/nowhere.stl")
    with pytest.raises(InputError, match=r"nowhere\.stl.*put the mesh files"):
        urdf_named(path)
    # urdfdom leaves such a body out.
    path.write_text(path.read_text().replace('scale="0.001 0.001 0.001"', 'scale="0.001"'))
    with pytest.raises(InputError, match="a <collision> of link 'l4' cannot be read; it takes"):
        urdf_named(path)


def test_a_urdf_without_collision_elements_says_so():
    from support.robots import KR270

    with pytest.raises(InputError, match="no <collision> elements"):
        named(Workspace(urdf_geometry=True), robot=Robot(urdf=KR270))
