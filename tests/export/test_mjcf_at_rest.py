"""MuJoCo comes to rest under load where the model's static equilibrium is."""

from __future__ import annotations

import re
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from support.exports import LOAD, SPRINGS, exported, flanges_in_base, poses_of, write_result
from support.robots import KR270, packaged_urdf, random_chain_urdf

import elastocal as ec
from elastocal.export.robot_files import MujocoRest
from elastocal.model.effects.base import Parameter

mujoco = pytest.importorskip("mujoco")

ROBOT = f'urdf = "{KR270}"'
MICROMETRE = 1e-6
BEARINGS = (*SPRINGS, "off_axis_compliance", "link_bending:link2", "base_compliance")
WEIGHTS = (*SPRINGS, "gravity_compensator", "link_mass_error", "payload_error")
COMPENSATOR = "[model.nominal]\ngravity_compensator = {joint = 'joint2', stiffness_N_per_m = 1.4e5}"


def check_rest(cell: Path, result: Path, force=LOAD, poses: int = 5) -> str:
    calibrated, done = exported(cell, result, "mjcf", force)
    q = poses_of(calibrated, poses, seed=5)
    expected = flanges_in_base(calibrated, q, force)
    arm = MujocoRest(done.text)
    for row, T in zip(q, expected, strict=True):
        found = arm.sites(row, force, ["flange", "marker_M2"])
        own = [calibrated.values[f"marker:M2.{k}"] for k in "xyz"]
        wanted = [T[:3, 3], T[:3, :3] @ own + T[:3, 3]]
        assert np.abs(found - wanted).max() < MICROMETRE
    assert done.checked is not None and done.checked < MICROMETRE
    assert done.cost.total.flange_max == 0.0
    return done.text


def test_the_example_of_the_documentation_moves_the_arm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calibrated, done = exported(*write_result(tmp_path, ROBOT), "mjcf")
    (tmp_path / "calibrated.xml").write_text(done.text)
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parents[2] / "docs" / "exporting.md").read_text(encoding="utf-8")
    exec(re.findall(r"```python\n(.*?)```", page, re.S)[0], {})
    shown = np.array([float(v) for v in re.findall(r"-?\d+\.\d+", capsys.readouterr().out)])
    q, force = np.array([[0.4, -1.0, 0, 0, 0, 0]]), np.array([0, 0, -2600.0])
    T = flanges_in_base(calibrated, q, force)[0]
    own = [calibrated.values[f"marker:M1.{k}"] for k in "xyz"]
    assert np.abs(shown - (T[:3, :3] @ own + T[:3, 3])).max() < MICROMETRE


def test_seven_joints(tmp_path: Path) -> None:
    path, _ = packaged_urdf("iiwa14")
    check_rest(*write_result(tmp_path, f'urdf = "{path}"\nflange = "tool0"'))


def test_every_spring_that_a_file_can_hold(tmp_path: Path) -> None:
    """Tilting bearings, a bending link and a tilting pedestal, each in its place in the chain."""
    soft = ("link_bending", "base_compliance")
    written = write_result(
        tmp_path, ROBOT, BEARINGS, value=lambda p: 3e-7 if p.effect in soft else None
    )
    text = check_rest(*written)
    springs = [j for j in ET.fromstring(text).iter("joint") if j.get("stiffness")]
    assert len(springs) == 6 + 12 + 3 + 2
    (tmp_path / "again.xml").write_text(text)
    again = tomllib.loads(ec.init(tmp_path / "again.xml"))  # the same arm, without its springs
    limits = {f"joint{i}_deg": [-e, e] for i, e in enumerate((185, 0, 0, 350, 125, 350), 1)}
    limits |= {"joint2_deg": [-146, 0], "joint3_deg": [-119, 155]}
    assert again["limits"] == limits and list(again["tool"]["markers_m"]) == ["M1", "M2"]


def test_weights_compensator_and_a_payload_not_as_declared(tmp_path: Path) -> None:
    given = {
        "joint2.compensator_stiffness": 1.4e5, "joint2.compensator_free_length": 0.458,
        "load.payload_scale": 0.05, "load.load_point_x": 0.03, "link3.mass_error": 20.0,
        "link3.moment_x": 4.0,
    }  # fmt: skip

    def value(p: Parameter) -> float | None:
        if p.effect in WEIGHTS[-3:]:
            return given.get(p.name, p.nominal)
        return None

    model = f"link_gravity = true\n{COMPENSATOR}"
    text = check_rest(*write_result(tmp_path, ROBOT, WEIGHTS, model, value=value))
    masses = {
        body.get("name"): float(body.find("inertial").get("mass"))
        for body in ET.fromstring(text).iter("body")
    }
    assert masses["link3"] == pytest.approx(240.0)  # 220 kg and what was found missing
    assert masses["link1"] == pytest.approx(330.0)
    assert mujoco.MjModel.from_xml_string(text).ntendon == 1


def test_slides_and_branches(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(random_chain_urdf(3))
    robot = 'urdf = "arm.urdf"\nbase = "base"\nflange = "flange"'
    check_rest(*write_result(tmp_path, robot, model="link_gravity = true", seed=3))


@pytest.mark.parametrize(
    ("model", "rigid"), [("", "joint1.compliance"), ("link_gravity = true", "joint2.compliance")]
)
def test_a_run_of_mujoco_settles_where_newton_does(tmp_path: Path, model: str, rigid: str) -> None:
    """The actuators hold the arm by themselves: no other program than mj_step is needed."""
    written = write_result(
        tmp_path, ROBOT, model=model, value=lambda p: 0.0 if p.name == rigid else None
    )
    calibrated, done = exported(*written, "mjcf", LOAD)
    q = poses_of(calibrated, 1, seed=1)[0]
    model = mujoco.MjModel.from_xml_string(done.text)
    data = mujoco.MjData(model)  # at zero, from where the command is a step
    data.ctrl[:6], data.ctrl[6:] = q, LOAD
    for _ in range(4000):
        mujoco.mj_step(model, data)
    T = flanges_in_base(calibrated, q[None], LOAD)[0]
    assert np.linalg.norm(data.site("flange").xpos - T[:3, 3]) < MICROMETRE


def test_the_nominal_arm_has_the_inertia_of_its_urdf(tmp_path: Path) -> None:
    """Mass matrix and weights as pinocchio finds them in the URDF."""
    import pinocchio as pin

    effects, model = ["joint_compliance"], "link_gravity = true"
    written = write_result(tmp_path, ROBOT, effects, model, value=lambda p: 1e-6)
    calibrated, done = exported(*written, "mjcf")
    model = mujoco.MjModel.from_xml_string(done.text)
    data = mujoco.MjData(model)
    own = pin.buildModelFromUrdf(str(KR270))
    for q in poses_of(calibrated, 5, seed=1):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        found = np.zeros((6, 6))
        mujoco.mj_fullM(model, data, found)
        expected = pin.crba(own, own.createData(), q) + np.diag(model.dof_armature)
        assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()


def test_what_no_spring_does_is_left_out_with_its_cost(tmp_path: Path) -> None:
    negative = "joint2.compliance"
    written = write_result(tmp_path, ROBOT, value=lambda p: -1e-6 if p.name == negative else None)
    _, done = exported(*written, "mjcf", LOAD)
    (entry,) = done.cost.effects
    assert entry.effect == "negative compliance" and negative in entry.note
    assert entry.difference is not None and entry.difference == done.cost.total
    # About the deflection that the negative compliance makes, 1e-6 rad/(N m) at 2 m and 130 N.
    assert 1e-6 < done.cost.total.flange_max < 1e-3
    assert done.checked is not None and done.checked < MICROMETRE
