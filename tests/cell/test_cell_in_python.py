"""A cell built in Python: the same classes and checks as from a file, in SI units."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from elastocal.cell.arm_description import (
    CartesianNoise,
    EffectChoice,
    ModelSpec,
    Nominal,
    PolarNoise,
    Robot,
    Tool,
    Tracker,
)
from elastocal.cell.plan_wishes import DesignSpec, Motion, TargetBox, TargetPose
from elastocal.cell.work_cell import Cell, HalfSpace, Solid, Visibility, Workspace
from elastocal.errors import InputError

FILE = """
name = "kr270"
[robot]
urdf = "arm.urdf"
flange = "tool0"
[tool]
load_point_m = [0, 0, 0.2]
markers_m = { M1 = [0, 0, 0.1] }
[tracker]
position_m = [3, 0, 1]
sigma_um = 10
rotation_urad = 50
[model]
effects = ["base_frame", "joint_compliance:joint2"]
compliance_levels = { joint2_rad = [-0.5, 0.5] }
[model.nominal]
joint_compliance = [1e-6, 2e-6]
[limits]
joint1_rad = [-1, 2]
[workspace]
clearance_m = 0.05
[[workspace.obstacle]]
name = "table"
shape = "box"
size_m = [1, 2, 3]
[[workspace.keep_out]]
name = "wall"
point_m = [0, 0, 0]
normal = [0, 3, 4]
[design]
poses = 15
loads_N = [[0, 0, 0], [0, 0, -2600]]
[[design.test_pose]]
q_si = [0.1, 0.2]
"""


def built(folder):
    return Cell(
        name="kr270",
        path=folder / "cell.toml",
        robot=Robot.from_urdf(folder / "arm.urdf", flange="tool0"),
        tool=Tool([0, 0, 0.2], {"M1": [0, 0, 0.1]}),
        tracker=Tracker(
            position=[3, 0, 1], noise=CartesianNoise(sigma=10e-6), rotation_sigma=50e-6
        ),
        model=ModelSpec(
            effects=["base_frame", EffectChoice("joint_compliance", "joint2")],
            compliance_levels={"joint2": [-0.5, 0.5]},
            nominal=Nominal(joint_compliance=[1e-6, 2e-6]),
        ),
        limits={"joint1": [-1, 2]},
        workspace=Workspace(
            clearance=0.05,
            obstacles=[Solid("table", "box", [1, 2, 3])],
            keep_out=[HalfSpace("wall", [0, 0, 0], [0, 3, 4])],
        ),
        design=DesignSpec(
            poses=15, loads=[[0, 0, 0], [0, 0, -2600]], test_poses=[TargetPose([0.1, 0.2])]
        ),
    )


def test_a_cell_in_python_is_the_cell_of_the_file(tmp_path):
    (tmp_path / "arm.urdf").write_text("content is read by others")
    (tmp_path / "cell.toml").write_text(FILE)
    assert repr(built(tmp_path)) == repr(Cell.read(tmp_path / "cell.toml"))


def test_nothing_of_a_cell_can_be_set_but_all_can_be_replaced(tmp_path):
    cell = built(tmp_path)
    with pytest.raises(FrozenInstanceError):
        cell.name = "other"
    other = replace(cell, design=replace(cell.design, poses=3))
    assert (other.design.poses, other.robot) == (3, cell.robot)


def test_a_dh_robot_has_a_convention():
    robot = Robot.from_dh("dh.csv", convention="modified", masses="links.csv")
    assert (str(robot.dh), robot.dh_convention, str(robot.masses)) == (
        "dh.csv", "modified", "links.csv",
    )  # fmt: skip


def test_a_direction_has_unit_length_and_one_that_has_it_stays_as_it_is():
    given = np.array([0.36, 0.48, 0.8])
    assert (HalfSpace("wall", np.zeros(3), given).normal == given).all()
    assert np.linalg.norm(HalfSpace("wall", np.zeros(3), 7 * given).normal) == pytest.approx(1)


MISTAKES = {
    "unknown": (lambda: Tool(load_pont=[0, 0, 0]), "Tool has no load_pont.*'load_point'"),
    "a file's key": (lambda: Tool(load_point_m=[0, 0, 0]), "Tool has no load_point_m"),
    "too many": (lambda: EffectChoice("a", "b", "c"), "EffectChoice takes at most 2 values"),
    "missing": (lambda: Solid("a", "box"), "Solid: size is missing"),
    "shape": (lambda: Tool([0, 0]), r"Tool: load_point takes three numbers in m.*\[0, 0\]"),
    "text": (lambda: Tool(markers={"M1": "x"}), "Tool: markers takes three numbers in m per"),
    "unit": (lambda: CartesianNoise(-1), "sigma takes one positive number in m, or three"),
    "ppm": (lambda: PolarNoise(1e-5, -1.0, 1e-5, 0.0), "range_per_m takes a number >= 0 in m per"),
    "choice": (lambda: ModelSpec(observe="positon"), r"observe takes .* \(did you mean 'position'"),
    "effect": (lambda: ModelSpec(effects=[":joint2"]), r"effects\[0\] takes \"effect\" or"),
    "twice": (lambda: ModelSpec(effects=["a", "a"]), "repeats 'a'"),
    "matrix": (lambda: Nominal(base_rotation=[0, 0, 90]), r"base_rotation takes an array \(3, 3\)"),
    "spring": (
        lambda: Nominal(gravity_compensator={"joint": "joint2", "arm": 1.0}),
        "gravity_compensator: unknown key arm; missing unit: did you mean arm_m",
    ),
    "not a part": (lambda: Cell("a", robot="arm.urdf"), "Cell: robot takes an instance of Robot"),
    "two robots": (lambda: Robot(urdf="a", dh="b"), "exactly one of urdf, mjcf, dh"),
    "marker": (lambda: Tool(markers={" ": [0, 0, 0]}), "marker name ' '"),
    "limits": (lambda: Cell("a", limits={"joint1": (1, 0)}), "limits of joint1.*lower < upper"),
    "size": (lambda: Solid("a", "sphere", [1, 2]), "size of a sphere takes 1 number"),
    "zero": (lambda: HalfSpace("a", [0, 0, 0], [0, 0, 0]), "HalfSpace: normal takes three numbers"),
    "box": (lambda: TargetBox([0, 0, 0], [1, 0, 1]), "lower_m < upper_m .* in y"),
    "speed": (lambda: Motion(speed=[0.0]), "speed takes a list of positive numbers"),
    "overshoot": (lambda: Motion(overshoot=0.0), "overshoot takes a positive number in rad"),
    "loads": (lambda: DesignSpec(loads=[[0, 0, 1], [0, 0, 1]]), "repeats a load"),
    "levels": (lambda: DesignSpec(levels={"joint1": (0,), "joint2": (0,)}), "only one joint"),
    "reflector": (lambda: Visibility({"M1": [0, 0, 1]}), "without max_incidence_deg"),
    "no marker": (
        lambda: Cell("a", design=DesignSpec(marker_sigma={"M1": 1e-5})).check(),
        "a: .*no marker of the cell",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKES)
def test_a_wrong_value_is_told_with_class_field_and_what_it_takes(name):
    make, told = MISTAKES[name]
    with pytest.raises(InputError, match=told):
        make()
