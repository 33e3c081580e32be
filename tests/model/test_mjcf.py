"""A MuJoCo model as the nominal arm moves as MuJoCo moves it, and says what it cannot be."""

import mujoco
import numpy as np
import pytest
from support.mjcf_text import ARM, LOADABLE, write_arm

from elastocal.cell import Cell, read_cell
from elastocal.cell_tables import Robot
from elastocal.messages import InputError
from elastocal.model.manipulator import load_chain
from elastocal.model.mjcf import MjcfArm, read_mjcf
from elastocal.model.rigid import nominal_flanges


def in_mujoco(model, q, joints, base, flange):
    """T_base_flange (n, 4, 4) by MuJoCo alone; other joints at their reference."""
    data = mujoco.MjData(model)

    def placed(kind, name):
        thing = getattr(data, kind)(name)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = thing.xmat.reshape(3, 3), thing.xpos
        return T

    found = []
    for row in q:
        data.qpos[:] = model.qpos0
        data.qpos[[model.jnt_qposadr[j] for j in joints]] = row
        mujoco.mj_kinematics(model, data)
        T_base = np.eye(4) if base is None else placed("body", base)
        found.append(np.linalg.solve(T_base, placed(*flange)))
    return np.array(found)


@pytest.mark.parametrize(
    ("base", "flange", "kind"),
    [(None, "hand", "body"), ("foot", "attachment_site", "site"), ("foot", "l5", "body")],
)
def test_the_flange_is_where_mujoco_has_it(base, flange, kind, tmp_path):
    arm = MjcfArm.read(write_arm(tmp_path), base, flange)
    q = np.random.default_rng(1).uniform(-1, 1, (20, 5))
    model = mujoco.MjModel.from_xml_string(LOADABLE)
    found = in_mujoco(model, q, arm.joints, base, (kind, flange))
    assert np.abs(nominal_flanges(arm.chain, q) - found).max() < 1e-12


def test_fingers_leave_the_hand_as_the_flange(tmp_path):
    floating = ARM.replace('euler="30 0 0">', 'euler="30 0 0"><freejoint/>')
    for text, base in ((floating, "foot"), (ARM, "world")):
        arm = MjcfArm.read(write_arm(tmp_path, text))
        assert (arm.base, arm.flange) == (base, "hand")
    chain, sites = arm.chain, set(arm.tree.places(arm.base, arm.flange))
    assert [j.name for j in chain.joints] == ["a1", "a2", "a3", "a4", "joint5"]
    assert chain.kinds == ("revolute", "revolute", "prismatic", "revolute", "revolute")
    upper = [chain.joints[0].upper, chain.joints[3].upper]
    np.testing.assert_allclose(np.degrees(upper), [160, 120])
    assert chain.joints[2].upper == 0.3 and sites == {"reflector", "attachment_site"}


def test_masses_are_those_that_a_joint_carries(tmp_path):
    masses = read_mjcf(write_arm(tmp_path)).masses
    np.testing.assert_allclose([m.mass for m in masses], [8, 6, 4, 2, 1.7])  # foot and box: none
    # In the joint's frame, which stands at (0.02, 0.01, 0) of the body.
    np.testing.assert_allclose(masses[0].com, [-0.01, -0.01, 0.1], atol=1e-12)


def test_a_cell_names_it(tmp_path):
    write_arm(tmp_path)
    (tmp_path / "cell.toml").write_text('[robot]\nmjcf = "arm.xml"\nflange = "attachment_site"\n')
    assert load_chain(read_cell(tmp_path / "cell.toml")).n_joints == 5
    robot = Robot.from_mjcf(tmp_path / "arm.xml", base="l1")
    assert load_chain(Cell(name="arm", robot=robot)).n_joints == 4
    (tmp_path / "both.toml").write_text('[robot]\nmjcf = "arm.xml"\ndh_convention = "modified"\n')
    with pytest.raises(InputError, match="dh_convention has no meaning beside mjcf"):
        read_cell(tmp_path / "both.toml")


REFUSED = {
    "a URDF": ("<robot/>", r"this is a URDF, give it as urdf"),
    "MuJoCo's own": (ARM.replace('pos="0 0 0.35"', 'pos="0 0"'), "MuJoCo cannot read it"),
    "no mass": (
        ARM.replace('<body name="foot"', '<body name="b5"><joint/></body><body name="foot"'),
        "mass and inertia of moving bodies.*'b5'",
    ),
    "no arm": ("<mujoco><worldbody/></mujoco>", "0 moving joints between"),
    "a ball": (
        ARM.replace('<joint name="a4"', '<joint name="a4" type="ball" range="0 9"'),
        "'a4' is a ball joint and lies between base and flange",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_arm_is_said_by_name(name, tmp_path):
    text, told = REFUSED[name]
    with pytest.raises(InputError, match=told):
        read_mjcf(write_arm(tmp_path, text))


def test_without_mujoco_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    with pytest.raises(InputError, match=r"pip install elastocal\[mujoco\]"):
        read_mjcf(write_arm(tmp_path))
