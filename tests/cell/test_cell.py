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

from elastocal import cell_tables as t
from elastocal.cell import (
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
from elastocal.messages import InputError

ROBOT = '[robot]\nurdf = "arm.urdf"\n'
MARKERS = '[tool.markers_m]\nM1 = [0, 0, 0.1]\n"ball, left" = [0.1, 0, 0.1]\n'
SIGHT = "[workspace.visibility]\nmax_incidence_deg = 30\n[workspace.visibility.normals]\n"


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
    quarter, yaw = np.pi / 2, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    um, table = 1e-6, np.eye(4)
    table[:3, :3], table[:3, 3] = yaw, [1, 0, 2]
    return Cell(
        name="cell 7",
        path=folder / "cell.toml",
        robot=t.Robot(urdf=folder / "arm.urdf"),
        tool=t.Tool([0.1, 0, 0.3], {"M1": [1, 2, 3], "ball, left": [0.1, 0.2, 0.3]}),
        tracker=t.Tracker([3, 0, 1], t.CartesianNoise([10 * um, 20 * um, 30 * um]),
                        rotation_sigma=50 * um),
        model=t.ModelSpec(
            observe="pose",
            effects=["base_frame", t.EffectChoice("joint_compliance", "joint2"),
                     t.EffectChoice("marker_position", "marker:M1")],
            gear_ripple_orders=[121, 88.5],
            compliance_levels={"joint2": [-quarter, 0.0], "joint3": [0.5]},
            nominal=t.Nominal(
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
        noise=t.Unsteadiness(joints=5 * um),
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
        design=t.DesignSpec(
            poses=7, criterion="c", loads=[[0, 0, 0], [0, 0, -2600]], repeatability=60 * um,
            marker_sigma={"M1": 10 * um, "ball, left": 20 * um},
            combination={"joint2.compliance": 1.0, "joint3.compliance": -2.0},
            candidates=5000, taught=folder / "path.csv", target=30 * um,
            levels={"joint2": [-quarter, 0.0]}, per_level=[3, 4],
            test_poses=[t.TargetPose([quarter, np.pi], [1, 2, 3], 1, [0.1, 0, 0], True),
                        t.TargetPose([0.5, 1])],
            test_path=t.TargetPath(folder / "path.csv"),
            test_box=t.TargetBox([0, 0, 0], [1, 2, 3], 7, yaw, [0, 0, -1], [0, 1, 0]),
            motion=t.Motion(speed=[quarter, np.pi], home=[0, quarter], overshoot=np.radians(3),
                          degrees=True),
            choose=t.Freedom(tracker=[[2, -1, 0], [4, 1, 2]]),
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
    plain = Cell(name="cell", path=folder / "cell.toml", robot=t.Robot(urdf=folder / "arm.urdf"))
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
    assert cell.robot == t.Robot.from_dh(folder / "dh.csv", "modified", folder / "links.csv")
    assert cell.tracker.noise == t.PolarNoise(5e-6, 5e-7, 1.5e-5, 6e-6)
    assert read(ROBOT + "[workspace]\ngeometry = 'urdf'").workspace.urdf_geometry


def test_nothing_of_a_cell_can_be_set_but_all_can_be_replaced(folder):
    cell = whole(folder)
    with pytest.raises(FrozenInstanceError):
        cell.name = "other"
    other = replace(cell, design=replace(cell.design, poses=3))
    assert (other.design.poses, other.robot) == (3, cell.robot)


@given(st.lists(st.floats(-1e308, 1e308), min_size=3, max_size=3).filter(any))
def test_a_direction_has_length_one_whatever_its_size(vector):
    unit = HalfSpace("wall", np.zeros(3), vector).normal
    scaled = np.array(vector) / np.abs(vector).max()
    assert np.linalg.norm(unit) == pytest.approx(1.0, abs=1e-12)
    assert np.linalg.norm(np.cross(unit, scaled)) < 1e-12 and unit @ scaled > 0
    assert (HalfSpace("wall", np.zeros(3), unit).normal == unit).all()  # digit for digit


# --- what is wrong with it is told ----------------------------------------------------------------

CASES = Path(__file__).with_name("wrong.txt").read_text(encoding="utf-8").split("\n\n")[1:]
WRONG = dict(case.strip("\n").split("\n=> ") for case in CASES)


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
    "unknown": (lambda: t.Tool(load_pont=[0, 0, 0]), "Tool has no load_pont.*'load_point'"),
    "missing": (lambda: Solid("a", "box"), "Solid: size is missing"),
    "shape": (lambda: t.Tool([0, 0]), r"Tool: load_point takes three numbers in m.*\[0, 0\]"),
    "unit": (lambda: t.CartesianNoise(-1), "sigma takes a positive number in m, or three"),
    "choice": (lambda: t.ModelSpec(observe="positon"), r"observe takes .*you mean 'position'"),
    "spring": (
        lambda: t.Nominal(gravity_compensator={"joint": "joint2", "arm": 1.0}),
        "gravity_compensator: unknown key arm; missing unit: did you mean arm_m",
    ),
    "not a part": (lambda: Cell("a", robot="arm.urdf"), "Cell: robot takes an instance of Robot"),
    "no marker": (
        lambda: Cell("a", design=t.DesignSpec(marker_sigma={"M1": 1e-5})).check(),
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
