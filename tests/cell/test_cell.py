"""A cell, of a file or built in Python: SI units inside, and what is wrong with it is told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError, is_dataclass, replace
from pathlib import Path
from random import Random

import numpy as np
import pytest
from fuzz.mutations import ON_TEXT
from hypothesis import given
from hypothesis import strategies as st

from elastocal.cell.arm_description import (
    CartesianNoise,
    EffectChoice,
    ModelSpec,
    Nominal,
    PolarNoise,
    Robot,
    Tool,
    Tracker,
    Unsteadiness,
)
from elastocal.cell.plan_wishes import (
    DesignSpec,
    Freedom,
    Motion,
    TargetBox,
    TargetPath,
    TargetPose,
)
from elastocal.cell.work_cell import (
    Acceptance,
    CarriedBody,
    Cell,
    CertificateEntries,
    HalfSpace,
    HangingLoad,
    Solid,
    Visibility,
    Workspace,
    read_cell,
)
from elastocal.config import Spot, direction
from elastocal.errors import InputError

ROBOT = '[robot]\nurdf = "arm.urdf"\n'
MARKERS = '[tool.markers_m]\nM1 = [0, 0, 0.1]\n"ball, left" = [0.1, 0, 0.1]\n'
BOX = "[[workspace.obstacle]]\nname = 'table'\nshape = 'box'\nsize_m = [1, 2, 3]\n"
LOAD = "[workspace.load]\nshape = 'sphere'\nradius_m = 0.2\n"
HALF = "[[workspace.keep_out]]\nname = 'walkway'\npoint_m = [0, 0, 0]\n"
SIGHT = "[workspace.visibility]\nmax_incidence_deg = 30\n[workspace.visibility.normals]\n"
TEST_BOX = "[design.test_box]\nlower_m = [0, 0, 0]\nupper_m = [1, 1, 1]\n"
LEVELS = "[design.levels]\njoint2_deg = [1, 2]\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("arm.urdf", "dh.csv", "links.csv", "path.csv", "part.stl", "fixture.stl"):
        (tmp_path / name).write_text("content is read by others")
    (tmp_path / "mine.py").write_text("")
    return tmp_path


@pytest.fixture
def read(folder: Path) -> Callable[..., Cell]:
    def read(text: str | bytes, **options) -> Cell:
        data = text if isinstance(text, bytes) else text.encode()
        (folder / "cell.toml").write_bytes(data)
        return read_cell(folder / "cell.toml", **options)

    return read


@pytest.fixture
def refusal(read: Callable[..., Cell]) -> Callable[..., str]:
    """The message with which a text is refused; it must name the file, on one line."""

    def refusal(text: str | bytes, **options) -> str:
        with pytest.raises(InputError) as caught:
            read(text, **options)
        message = str(caught.value)
        assert "cell.toml" in message
        assert "\n" not in message
        return message

    return refusal


# --- what it says arrives in SI units -------------------------------------------------------------

WHOLE = Path(__file__).with_name("whole.toml").read_text(encoding="utf-8")


def whole(folder: Path) -> Cell:
    """The same in Python, whose units are SI."""
    quarter, yaw = np.pi / 2, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    um, table = 1e-6, np.eye(4)
    table[:3, :3], table[:3, 3] = yaw, [1, 0, 2]
    return Cell(
        name="cell 7",
        path=folder / "cell.toml",
        robot=Robot(urdf=folder / "arm.urdf"),
        tool=Tool([0.1, 0, 0.3], {"M1": [1, 2, 3], "ball, left": [0.1, 0.2, 0.3]}),
        tracker=Tracker([3, 0, 1], CartesianNoise([10 * um, 20 * um, 30 * um]),
                        rotation_sigma=50 * um),
        model=ModelSpec(
            observe="pose",
            effects=["base_frame", EffectChoice("joint_compliance", "joint2"),
                     EffectChoice("marker_position", "marker:M1")],
            gear_ripple_orders=[121, 88.5],
            compliance_levels={"joint2": [-quarter, 0.0], "joint3": [0.5]},
            nominal=Nominal(
                joint_compliance=[1e-6, 0], base_position=[1, 2, 3],
                # yaw after pitch after roll
                base_rotation=np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
                gravity_compensator={"joint": "joint2", "stiffness_N_per_m": 1e5,
                                     "anchor_m": [0.7, 0.1]},
                settings={"joint2": {"jump_time_s": 720.0, "ripple_order": 88.5},
                          "marker:M1": {"slip_time_s": -60.0}},
                sizes={"joint2": {"move_lag": 0.002}},
            ),
        ),
        limits={"joint1": [-np.pi, quarter], "joint3": [0, 0.5]},
        noise=Unsteadiness(joints=5 * um),
        require=Acceptance(heldout=50 * um),
        certificate=CertificateEntries(limit=100 * um),
        plugins=[str(folder / "mine.py"), "json"],
        workspace=Workspace(
            clearance=0.05, self_clearance=0.01, link_radius=[0.2, 0.15, 0.0],
            ignored_pairs=[("link2", "link4")],
            obstacles=[Solid("table", "box", [1, 2, 3], table),
                       Solid("part", "mesh", [1e-3] * 3, mesh=folder / "part.stl")],
            bodies=[CarriedBody(Solid("spindle", "cylinder", [0.1, 0.4]), "link3")],
            keep_out=[HalfSpace("walkway", [-1, 0, 0], [0, 0.6, 0.8])],
            load=HangingLoad(Solid("load", "sphere", [0.2]), rope_radius=0.008,
                             rope_axis=[0, 0, 1], max_angle=np.pi / 3),
            visibility=Visibility({"M1": [0, 0, 1], "ball, left": [1, 0, 0]}, np.pi / 6,
                                  (0.5, 20.0)),
        ),
        design=DesignSpec(
            poses=7, criterion="c", loads=[[0, 0, 0], [0, 0, -2600]], repeatability=60 * um,
            marker_sigma={"M1": 10 * um, "ball, left": 20 * um},
            combination={"joint2.compliance": 1.0, "joint3.compliance": -2.0},
            candidates=5000, taught=folder / "path.csv", target=30 * um,
            levels={"joint2": [-quarter, 0.0]}, per_level=[3, 4],
            test_poses=[TargetPose([quarter, np.pi], [1, 2, 3], 1, [0.1, 0, 0], True),
                        TargetPose([0.5, 1])],
            test_path=TargetPath(folder / "path.csv"),
            test_box=TargetBox([0, 0, 0], [1, 2, 3], 7, yaw, [0, 0, -1], [0, 1, 0]),
            motion=Motion(speed=[quarter, np.pi], home=[0, quarter], overshoot=np.radians(3),
                          degrees=True),
            choose=Freedom(tracker=[[2, -1, 0], [4, 1, 2]]),
        ),
    )  # fmt: skip


def check_same(found, expected, path="cell"):
    """Equal part by part, numbers to rounding."""
    if is_dataclass(expected):
        assert type(found) is type(expected), path
        found, expected = vars(found), vars(expected)
    if isinstance(expected, dict):
        assert list(found) == list(expected), path
        for name, value in expected.items():
            check_same(found[name], value, f"{path}.{name}")
    elif isinstance(expected, np.ndarray | float):
        assert np.shape(found) == np.shape(expected), path
        np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-15, err_msg=path)
    elif isinstance(expected, tuple):
        check_same(dict(enumerate(found)), dict(enumerate(expected)), path)
    else:
        assert found == expected, path


def test_every_key_arrives_in_si_units(read, folder):
    check_same(read(WHOLE), whole(folder))


def test_each_key_is_read_for_itself(read):
    """Without any one of them the cell is another one, or misses it."""
    lines = WHOLE.splitlines()
    for k, line in enumerate(lines):
        if "=" in line:
            try:
                assert read("\n".join(lines[:k] + lines[k + 1 :])) != read(WHOLE), line
            except InputError:
                continue


def test_what_is_not_stated_has_its_default(read, folder):
    plain = Cell(name="cell", path=folder / "cell.toml", robot=Robot(urdf=folder / "arm.urdf"))
    for more in ("", "[workspace]\n", "[workspace]\ngeometry = 'none'\n", "[design]\n",
                 "[design.motion]\n", "[noise]\n", "[tracker]\n"):  # fmt: skip
        for text in (ROBOT + more, "\ufeff" + ROBOT + more, (ROBOT + more).replace("\n", "\r\n")):
            assert read(text) == plain
    sight = read(ROBOT + "[workspace.visibility]\n").workspace.visibility
    assert (sight.line_of_sight, sight.range, sight.max_incidence) == (True, (0.0, np.inf), None)


def test_one_number_stands_for_all(read):
    cell = read(ROBOT + "[tracker]\nsigma_um = 10\n[workspace]\nlink_radius_m = 0.2\n"
                "[design.motion]\nspeed_deg_per_s = 180\n[design.levels]\n"
                "joint3_m = [0.1, 0.2, 0.3]\nposes_per_level = 4\n")  # fmt: skip
    assert cell.tracker.noise.sigma.tolist() == [1e-5] * 3
    assert (cell.workspace.link_radius, cell.design.motion.speed) == ((0.2,), [np.pi])
    assert (cell.design.poses, cell.design.per_level) == (12, (4, 4, 4))
    spec = read(ROBOT + "[design]\nposes = 7\n[design.levels]\njoint2_deg = [0, 10, 20]").design
    assert (spec.poses, spec.per_level) == (7, ())


def test_other_robots_and_other_noise(read, folder):
    cell = read('[robot]\ndh = "dh.csv"\ndh_convention = "modified"\nmasses = "links.csv"\n'
                "[tracker]\nrange_um = 5\nrange_ppm = 0.5\ntransverse_um = 15\n"
                "transverse_ppm = 6\n")  # fmt: skip
    assert cell.robot == Robot.from_dh(folder / "dh.csv", "modified", folder / "links.csv")
    assert cell.tracker.noise == PolarNoise(5e-6, 5e-7, 1.5e-5, 6e-6)
    assert read(ROBOT + "[workspace]\ngeometry = 'urdf'").workspace.urdf_geometry


def test_nothing_of_a_cell_can_be_set_but_all_can_be_replaced(folder):
    cell = whole(folder)
    with pytest.raises(FrozenInstanceError):
        cell.name = "other"
    other = replace(cell, design=replace(cell.design, poses=3))
    assert (other.design.poses, other.robot) == (3, cell.robot)


@given(st.lists(st.floats(-1e308, 1e308), min_size=3, max_size=3).filter(any))
def test_a_direction_has_length_one_whatever_its_size(vector):
    unit = direction(vector, Spot(Path("cell.toml")), "normal")
    scaled = np.array(vector) / np.abs(vector).max()
    assert np.linalg.norm(unit) == pytest.approx(1.0, abs=1e-12)
    assert np.linalg.norm(np.cross(unit, scaled)) < 1e-12 and unit @ scaled > 0
    assert (HalfSpace("wall", np.zeros(3), unit).normal == unit).all()  # digit for digit


# --- what is wrong with it is told ----------------------------------------------------------------

# Tables and keys, and what the message has: "|" stands between its parts.
WRONG = {
    # unknown keys, missing units, missing keys
    "[tracker]\nsigma = 10": "unknown key tracker.sigma; |missing unit: did you mean sigma_um",
    "[tracker]\nrange = 1": "range_um or range_ppm",
    "[model]\nposition_m = [0, 0, 0]": "model.position_m|[tracker]",
    "[limits]\njoint1 = [0, 1]": "limits.joint1;|missing unit: joint1_deg",
    "[design]\nq_deg = [1]": "did you mean it in [[design.test_pose]]",
    "[design]\ntarget_mm = 1": "other unit: did you mean target_um",
    "[design.test_box]\nlower_m = [0, 0, 0]": "design.test_box.upper_m is missing",
    "[design.levels]\nposes_per_levl = 3": "design.levels.poses_per_levl|'poses_per_level'",
    "[workspace]\nclearance = 1": "unknown key workspace.clearance;|clearance_mm or",
    # arm, tool, tracker, model
    "[tracker]\nsigma_um = 'ten'": "tracker.sigma_um|positive number in µm|'ten'",
    "[tracker]\nsigma_um = [1, 2, -3]": "tracker.sigma_um|positive",
    "[tracker]\nposition_m = [0, nan, 0]": "tracker.position_m|nan",
    "[tracker]\nsigma_um = 1\ntransverse_um = 2": "sigma_um and tracker.transverse_um",
    "[tracker]\nrange_um = 2": "tracker.transverse_um is missing",
    "[model]\nlink_gravity = 1": "model.link_gravity|true or false",
    "[model]\neffects = 'base_frame'": "model.effects|list",
    "[model]\neffects = [':joint2']": "model.effects[0]",
    "[model]\neffects = ['joint_offset', 'joint_offset']": "model.effects[1]|repeats",
    "[model.nominal]\nsettings.joint2 = 3": "model.nominal.settings|table",
    "[model.nominal]\nsettings.joint2 = { jump_time_s = 'noon' }":
        "model.nominal.settings.joint2|{ jump_time_s = 720.0 }|'noon'",
    "[model.nominal]\ngravity_compensator = { arm_m = 1 }": "gravity_compensator.joint|missing",
    "[limits]\njoint1_deg = [0, 1]\njoint1_rad = [0, 1]": "joint1|two units",
    "[limits]\njoint1_deg = [10, -10]": "joint1|lower < upper",
    "[model.compliance_levels]\njoint2_deg = [1, 1]": "joint2|once",
    '[tool.markers_m]\n"a\\nb" = [0, 0, 0]': "marker name|one line",
    "[noise]\ntails = 2": "noise.tails is 2|take a number > 2",
    "[certificate]\ncountry = 'Germany'": "certificate.country is 'Germany'|two letters",
    "[certificate]\nmeasured_on = '2026-02-30'": "certificate.measured_on is '2026-02-30'",
    "[plugins]\nmodules = ['json', 'other.py']": "key plugins.modules[1] names|does not exist",
    # the space around it
    "[workspace]\nclearance_mm = -1": "workspace.clearance_mm|>= 0|-1",
    "[workspace]\ngeometry = 'capsule'": "did you mean 'capsules'",
    "[workspace]\ngeometry = 'capsules'": "link_radius_mm is missing",
    "[workspace]\ngeometry = 'urdf'\nlink_radius_m = 1": "link_radius_m|no meaning",
    "[workspace]\nignored_pairs = [['a']]": "ignored_pairs|pairs of names",
    "[workspace.obstacle]\nname = 'a'": "key workspace.obstacle takes tables|[[work",
    "[workspace]\nobstacle = [1]": "[[workspace.obstacle]] no. 1 takes a table|1",
    BOX + "radius_m = 1": "radius_m of|no meaning for a box, which takes size_m",
    BOX + BOX.replace("[1, 2, 3]", "'x'"): "key size_m of [[workspace.obstacle]] no. 2 takes",
    BOX + BOX: "name of [[workspace.obstacle]] no. 2 repeats 'table'|no. 1",
    BOX.replace("'table'", "' a'"): "one line without blanks",
    BOX.replace("table", "link2"): "'link2', which names a part of the arm",
    HALF + "normal = [0, 0, 0]": "normal of [[workspace.keep_out]] no. 1 is zero",
    "[[workspace.body]]\nname='a'\non='link0'\nshape='sphere'\nradius_m=1":
        "on of [[workspace.body]] no. 1|\"flange\"|'link0'",
    "[[workspace.obstacle]]\nname='a'\nshape='mesh'\nfile='no.stl'":
        "key file of [[workspace.obstacle]] no. 1 names|no.stl|does not exist",
    LOAD + "rope_axis = [0, 0, 1]": "rope_axis has no meaning without|max_angle_deg",
    LOAD + "rope_axis = [0, 0, 1]\nmax_angle_deg = 200": "max_angle_deg|up to 180",
    SIGHT + "M2 = [0, 0, 1]": "[workspace.visibility.normals] names 'M2'|'M1'|ball, left",
    SIGHT.replace("max_incidence_deg = 30", "") + "M1 = [0, 0, 1]": "without max_incidence_deg",
    SIGHT: "without the reflectors' axes",
    "[workspace.visibility]\nrange_m = [2, 1]": "range_m|nearest < farthest|2.0",
    "[workspace.visibility]\nmin_markers = 3": "min_markers is 3|ball, left; ask for fewer",
    # what is asked of a plan
    "[design]\ncombination = { a = 0 }": "no factor other than zero",
    "[design]\ncombination = { joint2.compliance = 1 }": "combination.joint2|in quotes",
    "[design]\nloads_N = [0, 0, -2600]": "design.loads_N|list of forces|[[0, 0, 0]",
    "[design]\nloads_N = [[0, 0, 1], [0, 0, 1]]": "design.loads_N repeats a load",
    "[design]\nmarker_sigma_um = { M3 = 1 }": "[design.marker_sigma_um] names 'M3'|M1",
    "[design]\nminutes = 1\ntarget_um = 1": "minutes and design.target_um|drop one",
    "[design]\nelsewhere = 0.1\nelsewhere_cap = 0.1": "elsewhere and design.elsewhere_cap",
    "[design]\ncandidates = [3, 4]": "design.candidates takes a whole number >= 1, a file",
    LEVELS + "joint2_rad = [1]": "joint2 in two units",
    LEVELS.replace("2]", "1]"): "repeats a level of joint2",
    "[design.levels]\nposes_per_level = 3": "no meaning without levels",
    LEVELS + "poses_per_level = [1]": "1 numbers for 2 levels",
    "[design]\nposes = 5\n" + LEVELS + "poses_per_level = 3": "design.poses is 5|sum to 6",
    "[design]\nposes = 1\n" + LEVELS: "design.poses is 1|joint2 has 2 levels",
    "[[design.test_pose]]\nq_deg = [0]\nq_si = [0]": "q_deg of|two units; keep one",
    "[[design.test_pose]]\nq_deg = [0]\npoint_m = [0]": "point_m of|flange frame",
    TEST_BOX.replace("1, 1, 1", "1, -1, 1"): "lower_m < upper_m|found 0 and -1 in y",
    TEST_BOX + "count = 10001": "design.test_box.count|1 to 10000",
    "[design.motion]\nhome_si = [0]\nspeed_deg_per_s = 1": "home_si mix units",
    "[design.choose]\ntracker_m = [[1, 0, 0], [0, 1, 1]]": "tracker_m takes the lower corner",
}  # fmt: skip


@pytest.mark.parametrize("text", WRONG)
def test_what_is_wrong_is_told_with_key_and_remedy(refusal, text):
    message = refusal(ROBOT + MARKERS + text if "markers_m" not in text else ROBOT + text)
    assert not [part for part in WRONG[text].split("|") if part not in message], message


@pytest.mark.parametrize(
    ("robot", "told"),
    [
        ("", "robot"),
        ("[robot]\n", "exactly one of urdf, mjcf, dh; none is given"),
        (ROBOT + 'dh = "dh.csv"', "urdf, dh are given"),
        (ROBOT + 'masses = "links.csv"', "no meaning beside"),
        ('[robot]\ndh = "dh.csv"\nflange = "tool0"', "no meaning beside"),
        ("[robot]\ndh = 'dh.csv'\n[workspace]\ngeometry = 'urdf'", "needs [robot] urdf"),
        (ROBOT + SIGHT + "A = [0, 0, 1]", "[tool.markers_m] has none"),
        *((f'[robot]\nurdf = "{path}"', "robot.urdf") for path in (".", "a\\u0000b", "x" * 5000)),
    ],
)
def test_a_cell_has_exactly_one_robot(refusal, robot, told):
    assert told in refusal(robot)


def test_effects_are_checked_only_against_names_that_are_given(read, refusal):
    text = ROBOT + "[model]\neffects = ['base_frame', 'joint_complience:joint2']"
    assert read(text).model.effects[1].name == "joint_complience"
    message = refusal(text, known_effects=("base_frame", "joint_compliance"))
    assert "model.effects[1]" in message and "did you mean 'joint_compliance'" in message


@pytest.mark.parametrize("text", ["a = [", ROBOT + "x = 1 2", "a=1\na=2", "\r"])
def test_malformed_toml_is_told_with_line_and_column(refusal, text):
    message = refusal(text)
    assert "line " in message and "column " in message


@pytest.mark.parametrize(
    "text",
    [b"\xff\xfe[\0r\0", b'name = "\xb5m"\n', "a = " + "[" * 20_000, "a=" + 9000 * "9",
     "#" * 1_000_001],
)  # fmt: skip
def test_other_encodings_and_absurd_texts_are_refused(refusal, text):
    refusal(text)


IN_PYTHON = {
    "unknown": (lambda: Tool(load_pont=[0, 0, 0]), "Tool has no load_pont.*'load_point'"),
    "too many": (lambda: EffectChoice("a", "b", "c"), "EffectChoice takes at most 2 values"),
    "missing": (lambda: Solid("a", "box"), "Solid: size is missing"),
    "shape": (lambda: Tool([0, 0]), r"Tool: load_point takes three numbers in m.*\[0, 0\]"),
    "unit": (lambda: CartesianNoise(-1), "sigma takes one positive number in m, or three"),
    "ppm": (lambda: PolarNoise(1e-5, -1.0, 1e-5, 0.0), "range_per_m takes a number >= 0 in m per"),
    "choice": (lambda: ModelSpec(observe="positon"), r"observe takes .* \(did you mean 'position'"),
    "matrix": (lambda: Nominal(base_rotation=[0, 0, 90]), r"base_rotation takes an array \(3, 3\)"),
    "spring": (
        lambda: Nominal(gravity_compensator={"joint": "joint2", "arm": 1.0}),
        "gravity_compensator: unknown key arm; missing unit: did you mean arm_m",
    ),
    "not a part": (lambda: Cell("a", robot="arm.urdf"), "Cell: robot takes an instance of Robot"),
    "size": (lambda: Solid("a", "sphere", [1, 2]), "size of a sphere takes 1 number"),
    "zero": (lambda: HalfSpace("a", [0, 0, 0], [0, 0, 0]), "HalfSpace: normal takes three numbers"),
    "no marker": (
        lambda: Cell("a", design=DesignSpec(marker_sigma={"M1": 1e-5})).check(),
        "a: .*no marker of the cell",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", IN_PYTHON)
def test_a_wrong_value_is_told_with_class_field_and_what_it_takes(name):
    make, told = IN_PYTHON[name]
    with pytest.raises(InputError, match=told):
        make()


@pytest.mark.parametrize("hundred", range(3))
def test_no_mutation_gives_anything_but_a_cell_or_an_input_error(read, hundred):
    for seed in range(100 * hundred, 100 * (hundred + 1)):
        change = Random(seed).choice(ON_TEXT)
        text = change(WHOLE, Random(seed)).encode("utf-8", errors="surrogateescape")
        try:
            read(text)
        except InputError as error:
            assert "cell.toml" in str(error), f"{change.__name__}, {seed}"
