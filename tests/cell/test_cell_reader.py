"""The cell file: what it says arrives in SI units, and what is wrong with it is told."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from elastocal.cell.arm_description import CartesianNoise, EffectChoice, PolarNoise
from elastocal.cell.plan_wishes import DesignSpec
from elastocal.cell.work_cell import Workspace, read_cell
from elastocal.errors import InputError

ROBOT = '[robot]\nurdf = "arm.urdf"\n'


def test_the_smallest_cell_has_a_robot_and_defaults(read, folder):
    cell = read(ROBOT)
    assert cell.name == "cell"
    assert cell.path == folder / "cell.toml"
    assert cell.robot.urdf == folder / "arm.urdf"
    assert cell.model.observe == "position"
    assert cell.model.effects == ()
    assert cell.tracker.noise is None
    assert cell.tool.markers == {}
    assert (cell.workspace, cell.design) == (Workspace(), DesignSpec())
    assert (cell.tool.load_point == 0).all()


def test_every_key_arrives_in_si_units(read):
    cell = read("""
name = "cell 7"
[robot]
urdf = "arm.urdf"
base = "base_link"
flange = "tool0"
[tool]
load_point_m = [0.1, 0, 0.3]
[tool.markers_m]
M1 = [1, 2, 3]
"ball, left" = [0.1, 0.2, 0.3]
[tracker]
position_m = [3, 0, 1]
anchor_m = [0, 1, 0]
sigma_um = [10, 20, 30]
rotation_urad = 50
distance_um = 15
[model]
observe = "pose"
effects = ["base_frame", "joint_compliance:joint2", "marker_position:marker:M1"]
torque = "measured"
link_gravity = true
deflection_model = "linear"
gear_ripple_orders = [121, 88.5]
thermal_driver = "temperature"
[model.compliance_levels]
joint2_deg = [-90, 0.0]
joint3_rad = [0.5]
[model.nominal]
joint_compliance = [1e-6, 0]
base_position_m = [1, 2, 3]
base_rpy_deg = [0, 0, 90]
gravity_compensator = { joint = "joint2", stiffness_N_per_m = 1e5, anchor_m = [0.7, 0.1] }
settings.joint2 = { jump_time_s = 720, ripple_order = 88.5 }
settings."marker:M1" = { slip_time_s = -60.0 }
[limits]
joint1_deg = [-180, 90]
joint2_rad = [-1, 1]
joint3_mm = [0, 500]
joint4_m = [0, 0.5]
[workspace]
clearance_mm = 20
[design]
poses = 20
""")
    assert cell.name == "cell 7"
    assert (cell.robot.base, cell.robot.flange) == ("base_link", "tool0")
    assert list(cell.tool.markers) == ["M1", "ball, left"]
    assert cell.tool.load_point.tolist() == [0.1, 0.0, 0.3]
    assert isinstance(cell.tracker.noise, CartesianNoise)
    assert cell.tracker.noise.sigma.tolist() == [1e-5, 2e-5, 3e-5]
    assert cell.tracker.rotation_sigma == 5e-5
    assert cell.tracker.distance_sigma == 1.5e-5
    assert cell.tracker.position.tolist() == [3.0, 0.0, 1.0]
    assert cell.tracker.anchor.tolist() == [0.0, 1.0, 0.0]
    assert cell.model.observe == "pose"
    assert cell.model.effects == (
        EffectChoice("base_frame"),
        EffectChoice("joint_compliance", "joint2"),
        EffectChoice("marker_position", "marker:M1"),
    )
    assert (cell.model.torque, cell.model.link_gravity) == ("measured", True)
    assert cell.model.deflection_model == "linear"
    assert cell.model.gear_ripple_orders == (121.0, 88.5)
    assert cell.model.thermal_driver == "temperature"
    assert cell.model.compliance_levels == {"joint2": (-np.pi / 2, 0.0), "joint3": (0.5,)}
    assert cell.model.nominal.joint_compliance == (1e-6, 0.0)
    assert cell.model.nominal.base_position.tolist() == [1.0, 2.0, 3.0]
    assert cell.model.nominal.gravity_compensator == {
        "joint": "joint2",
        "stiffness_N_per_m": 1e5,
        "anchor_m": [0.7, 0.1],
    }
    assert cell.model.nominal.settings == {
        "joint2": {"jump_time_s": 720.0, "ripple_order": 88.5},
        "marker:M1": {"slip_time_s": -60.0},
    }
    assert cell.limits["joint1"] == (-np.pi, np.pi / 2)
    assert cell.limits["joint2"] == (-1.0, 1.0)
    assert cell.limits["joint3"] == (0.0, 0.5)
    assert cell.limits["joint4"] == (0.0, 0.5)
    assert cell.workspace.clearance == 0.02
    assert cell.design.poses == 20


def test_base_rotation_is_yaw_after_pitch_after_roll(read):
    rotation = read(ROBOT + "[model.nominal]\nbase_rpy_deg = [90, 0, 90]").model.nominal
    x, y, z = rotation.base_rotation.T
    assert np.allclose([x, y, z], [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-15)


def test_scalar_sigma_holds_for_all_axes(read):
    noise = read(ROBOT + "[tracker]\nsigma_um = 10").tracker.noise
    assert noise.sigma.tolist() == [1e-5] * 3


def test_polar_noise_has_a_constant_part_and_a_part_per_metre(read):
    noise = read(
        ROBOT + "[tracker]\nrange_um = 5\nrange_ppm = 0.5\ntransverse_um = 15\ntransverse_ppm = 6"
    ).tracker.noise
    assert noise == PolarNoise(5e-6, 5e-7, 1.5e-5, 6e-6)


def test_dh_robot_with_convention_and_masses(read, folder):
    robot = read('[robot]\ndh = "dh.csv"\ndh_convention = "modified"\nmasses = "links.csv"').robot
    assert (robot.dh, robot.masses) == (folder / "dh.csv", folder / "links.csv")
    assert robot.dh_convention == "modified"


@pytest.mark.parametrize("text", ["\ufeff" + ROBOT, ROBOT.replace("\n", "\r\n")])
def test_byte_order_mark_and_windows_line_ends_are_understood(read, text):
    assert read(text).robot.urdf is not None


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[tracker]\nsigma = 10", ["tracker.sigma;", "missing unit: did you mean sigma_um"]),
        ("[tracker]\nrange = 1", ["range_um or range_ppm"]),
        ("[model]\nefects = []", ["model.efects", "did you mean effects"]),
        ("[model]\nposition_m = [0, 0, 0]", ["model.position_m", "[tracker]"]),
        ("[model]\nobstacle = 1", ["model.obstacle", "did you mean it in [workspace]"]),
        ("[limits]\njoint1 = [0, 1]", ["limits.joint1;", "missing unit: joint1_deg"]),
        ("[model.compliance_levels]\njoint2 = [0]", ["model.compliance_levels.joint2;", "unit"]),
    ],
)
def test_unknown_key_is_named_with_its_path_and_the_nearest_valid_one(refusal, text, told):
    message = refusal(ROBOT + text)
    assert all(part in message for part in ["unknown key", *told])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[tracker]\nsigma_um = 'ten'", ["tracker.sigma_um", "positive number in µm", "'ten'"]),
        ("[tracker]\nsigma_um = 0", ["tracker.sigma_um", "positive"]),
        ("[tracker]\nsigma_um = [1, 2, -3]", ["tracker.sigma_um", "positive"]),
        ("[tracker]\nrange_um = 1\ntransverse_um = 1\nrange_ppm = -1", ["tracker.range_ppm"]),
        ("[tracker]\nposition_m = [0, nan, 0]", ["tracker.position_m", "nan"]),
        ("[model]\nlink_gravity = 1", ["model.link_gravity", "true or false"]),
        ("[model]\nobserve = 'positon'", ["model.observe", "did you mean 'position'"]),
        ("[model]\neffects = 'base_frame'", ["model.effects", "list"]),
        ("[model]\neffects = [':joint2']", ["model.effects[0]"]),
        ("[model]\neffects = ['joint_offset', 'joint_offset']", ["model.effects[1]", "repeats"]),
        ("[model.nominal]\nsettings.joint2 = 3", ["model.nominal.settings", "table"]),
        (
            "[model.nominal]\nsettings.joint2 = { jump_time_s = 'noon' }",
            ["model.nominal.settings.joint2", "{ jump_time_s = 720.0 }", "'noon'"],
        ),
        ("[model.nominal]\njoint_compliance = [-1e-6]", ["model.nominal.joint_compliance"]),
        (
            "[model.nominal]\ngravity_compensator = { arm_m = 1 }",
            ["model.nominal.gravity_compensator.joint", "missing"],
        ),
        ("[limits]\njoint1_deg = [10, -10]", ["joint1", "lower < upper"]),
        ("[limits]\njoint1_deg = [0, 1]\njoint1_rad = [0, 1]", ["joint1", "two units"]),
        ("[model.compliance_levels]\njoint2_deg = [1, 1]", ["joint2", "once"]),
        ("[tool.markers_m]\n'' = [0, 0, 0]", ["marker name ''"]),
        ('[tool.markers_m]\n"a\\nb" = [0, 0, 0]', ["marker name", "one line"]),
    ],
)
def test_wrong_value_is_told_with_key_what_it_takes_and_what_was_found(refusal, text, told):
    message = refusal(ROBOT + text)
    assert all(part in message for part in told)


def test_two_styles_of_noise_are_refused_naming_both(refusal):
    message = refusal(ROBOT + "[tracker]\nsigma_um = 1\ntransverse_um = 2")
    assert "sigma_um" in message
    assert "transverse_um" in message


def test_incomplete_polar_noise_names_the_missing_key(refusal):
    assert "tracker.transverse_um is missing" in refusal(ROBOT + "[tracker]\nrange_um = 2")


@pytest.mark.parametrize(
    "robot", ["", "[robot]\n", '[robot]\nurdf = "arm.urdf"\ndh = "dh.csv"\n', "[robot]\nurdf = ''"]
)
def test_a_cell_has_exactly_one_robot(refusal, robot):
    assert "robot" in refusal(robot)


@pytest.mark.parametrize(
    "robot", ['urdf = "arm.urdf"\nmasses = "links.csv"', 'dh = "dh.csv"\nflange = "tool0"']
)
def test_robot_keys_without_meaning_are_refused(refusal, robot):
    assert "no meaning beside" in refusal("[robot]\n" + robot)


@pytest.mark.parametrize("path", ["other.urdf", ".", "a\\u0000b", "x" * 5000])
def test_missing_robot_file_names_cell_key_and_path(refusal, path):
    message = refusal(f'[robot]\nurdf = "{path}"')
    assert "robot.urdf" in message


def test_plugins_are_files_beside_the_cell_or_modules(read, folder, refusal):
    (folder / "mine.py").write_text("")
    cell = read(ROBOT + '[plugins]\nmodules = ["mine.py", "json"]')
    assert cell.plugins == (str(folder / "mine.py"), "json")
    message = refusal(ROBOT + '[plugins]\nmodules = ["json", "other.py"]')
    assert "key plugins.modules[1] names" in message
    assert "does not exist" in message


def test_effects_are_checked_only_against_names_that_are_given(read, refusal):
    text = ROBOT + "[model]\neffects = ['base_frame', 'joint_complience:joint2']"
    assert read(text).model.effects[1].name == "joint_complience"
    message = refusal(text, known_effects=("base_frame", "joint_compliance"))
    assert "model.effects[1]" in message
    assert "did you mean 'joint_compliance'" in message


@pytest.mark.parametrize("text", ["a = [", "[robot\n", ROBOT + "x = 1 2", "a=1\na=2", "=", "\r"])
def test_malformed_toml_is_told_with_line_and_column(refusal, text):
    message = refusal(text)
    assert "line " in message
    assert "column " in message


@pytest.mark.parametrize(
    "text", [b"\xff\xfe[\0r\0", b'name = "\xb5m"\n', "a = " + "[" * 20_000, "a=" + 9000 * "9"]
)
def test_other_encodings_and_absurd_texts_are_refused(refusal, text):
    refusal(text)


def test_a_file_beyond_1_mb_is_refused(refusal):
    assert "1 MB" in refusal("#" * 1_000_001)


@pytest.mark.parametrize("name", ["absent.toml", "", "a\0b", "x" * 5000])
def test_absent_files_and_directories_are_refused(tmp_path, name):
    with pytest.raises(InputError):
        read_cell(tmp_path / name)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.binary(max_size=200)
    | st.text(max_size=200).map(lambda text: (ROBOT + text).encode("utf-8", "replace"))
)
def test_no_text_gives_anything_but_a_cell_or_an_input_error(read, data):
    try:
        read(data)
    except InputError as error:
        assert "cell.toml" in str(error)
