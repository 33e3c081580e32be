"""MuJoCo models as they are found: loops, gravity, units, endings, meshes that are not there."""

import numpy as np
import pytest
from support.robot_files import mjcf, told_by_init

import elastocal as ec

ROD = (
    '<body name="rod" pos="0.1 0 0.1"><inertial pos="0 0 0.3" mass="2" diaginertia="1 1 1"/>'
    '<joint name="jr" axis="0 1 0"/><site name="rodtip" pos="0 0 0.6"/></body>'
)
SITE = '<site name="s3" pos="0.1 0 0"/>'
TENDONS = (
    '<tendon><fixed name="t2"><joint joint="j2" coef="1"/><joint joint="j3" coef="1"/></fixed>'
    '<fixed name="tr"><joint joint="jr" coef="1"/></fixed>'
    '<fixed name="t3"><joint joint="j3" coef="1"/></fixed>'
    '<spatial name="rope"><site site="rodtip"/><site site="s3"/></spatial></tendon>'
)
MOCAP = '<body name="target" mocap="true"/>'
FREE = '<body name="cup" pos="2 0 0"><freejoint/><geom size="0.05"/><site name="rim"/></body>'
LOOPS = {
    "connect sites": '<connect site1="rodtip" site2="s3"/>',
    "weld of a middle link to the world": '<weld body1="l3"/>',
    "connect of the flange to the world": '<connect body1="l6" anchor="0 0 0"/>',
    "joint follows": '<joint joint1="j3" joint2="j2"/>',
    "by a joint beside": '<joint joint1="jr" joint2="j2"/><joint joint1="jr" joint2="j3"/>',
    "two tendons": '<tendon tendon1="tr" tendon2="t3"/><joint joint1="jr" joint2="j2"/>',
    "by a free body": '<weld body1="cup" body2="l3"/><weld body1="cup" body2="l6"/>',
}
OPEN = {
    "weld to mocap": '<weld body1="l6" body2="target"/>',
    "a held cup": '<weld body1="l6" body2="cup"/>',
    "a rope to a passive rod": '<tendon tendon1="rope"/>',
    "a passive rod follows": '<joint joint1="jr" joint2="j2"/>',
    "inactive": '<connect site1="rodtip" site2="s3" active="false"/>',
}


def arm(tmp_path, equality="", name="arm.xml", **parts):
    text = mjcf(in_l1=ROD, in_l3=SITE, beside=MOCAP + FREE,
                tail=f"{TENDONS}<equality>{equality}</equality>", **parts)  # fmt: skip
    (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path / name


@pytest.mark.parametrize("kind", LOOPS)
def test_no_closed_loop_is_read_as_an_open_arm(kind, tmp_path):
    code, _, err = told_by_init(arm(tmp_path, LOOPS[kind]))
    assert code == 2, kind
    tag = LOOPS[kind][1:].partition(" ")[0]
    assert f"<equality><{tag}>" in err and "not supported between base and flange" in err
    assert not (tmp_path / "cell.toml").exists()


@pytest.mark.parametrize("kind", OPEN)
def test_what_leaves_the_arm_open_is_accepted(kind, tmp_path):
    code, _, err = told_by_init(arm(tmp_path, OPEN[kind]))
    assert code == 0, err


@pytest.mark.parametrize(
    ("gravity", "up"),
    [("0 0 -9.81", [0, 0, 1]), ("0 -9.81 0", [0, 1, 0]), ("0 0 9.81", [0, 0, -1]),
     ("6.9367 0 -6.9367", [-0.7071, 0, 0.7071])],
)  # fmt: skip
def test_weights_act_along_the_gravity_of_the_file(gravity, up, tmp_path):
    path = arm(tmp_path, head=f'<option gravity="{gravity}"/>')
    code, _, err = told_by_init(path)
    assert code == 0, err
    R = ec.read_cell(tmp_path / "cell.toml").model.nominal.base_rotation
    np.testing.assert_allclose(R @ up, [0, 0, 1], atol=1e-4)
    plane = ec.read_cell(tmp_path / "cell.toml").workspace.keep_out[0]
    np.testing.assert_allclose(plane.normal, R[:, 2], atol=1e-4)


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        ({"head": '<option gravity="0 0 -1.62"/>'}, "gravity is 1.62 m/s²"),
        ({"head": '<option gravity="0 0 0"/>'}, "switches gravity off"),
        ({"head": '<option><flag gravity="disable"/></option>'}, "switches gravity off"),
        ({"of_bodies": 'gravcomp="1"'}, "gravcomp of the file carries the weight of l1"),
    ],
)
def test_weights_that_the_file_lets_not_act_are_told(parts, told, tmp_path):
    code, out, err = told_by_init(arm(tmp_path, **parts))
    assert code == 0 and told in out, err
    text = (tmp_path / "cell.toml").read_text()
    assert told in text and "a choice: see the notes above" in text


def test_a_missing_mesh_is_named_and_only_its_bodies_lose_their_mass(tmp_path):
    fingers = "".join(
        f'<body name="f{i}"><joint name="finger{i}" type="slide" axis="0 1 0" range="0 0.04"/>'
        '<geom type="mesh" mesh="x"/></body>'
        for i in (1, 2)
    )
    head = '<asset><mesh name="x" file="x.stl"/></asset>'
    code, out, err = told_by_init(arm(tmp_path, head=head, at_end=fingers))
    assert code == 0 and "x.stl is missing, which would state the mass of f1, f2" in out, err
    chain = ec.Model(str(tmp_path / "cell.toml")).chain
    assert [body.mass for body in chain.masses][-1] == 4.0


JAW = """<body name="f"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
<joint name="grip" type="slide" axis="0 1 0" range="0 0.04"/></body>"""


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        ({"at_end": JAW}, "'grip' looks like a jaw"),
        ({"limits": "-170 170"}, "more than 27 turns"),
        ({"limits": "-2.9 2.9", "compiler": ""}, "widest range"),
        ({"at_end": '<site name="s" euler="0 90 0"/>'}, "90 rad is more than two turns"),
    ],
)
def test_units_and_joints_that_cannot_be_meant_are_told(parts, told, tmp_path):
    code, out, err = told_by_init(arm(tmp_path, **parts))
    assert told in out + err and (code == 2) == (told not in out)


def test_mujoco_warns_in_the_words_of_the_tool(tmp_path, recwarn):
    path = arm(tmp_path, compiler='angle="radian" settotalmass="30"')
    code, out, err = told_by_init(path)
    assert code == 0 and "Note: MuJoCo warns: " in out and "UserWarning" not in out + err
    assert not [one for one in recwarn if "settotalmass" in str(one.message)]
