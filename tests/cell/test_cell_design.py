"""[design]: what is asked of a plan arrives in SI units, and what is wrong with it is told."""

from __future__ import annotations

import copy
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from elastocal.cell.plan_wishes import DesignSpec
from elastocal.errors import InputError

CELL = """
[robot]
urdf = "arm.urdf"
[tool.markers_m]
M1 = [0, 0, 0.1]
M2 = [0.1, 0, 0.1]
"""
PAGE = (Path(__file__).parents[2] / "docs" / "file-formats.md").read_text(encoding="utf-8")
SHOWN = CELL + "".join(re.findall(r"```toml (?:workspace|design)\n(.*?)```", PAGE, re.S))
REST = """
[tracker]
position_m = [3, 0, 1]
sigma_um = [10, 20, 30]
[model]
observe = "pose"
effects = ["base_frame", "joint_compliance:joint2"]
compliance_levels = { joint2_deg = [-90, 0] }
[model.nominal]
base_rpy_deg = [0, 0, 90]
gravity_compensator = { joint = "joint2", stiffness_N_per_m = 1e5, anchor_m = [0.7, 0.1] }
settings.joint2 = { jump_time_s = 720 }
[limits]
joint1_deg = [-180, 90]
[noise]
joints_urad = 5
"""
BOX = "[design.test_box]\nlower_m = [0, 0, 0]\nupper_m = [1, 1, 1]\n"


def test_every_key_arrives_in_si_units(read, folder):
    spec = read(
        CELL
        + """
[design]
criterion = "c"
repeats = 6
loads_N = [[0, 0, 0], [0, 0, -2600]]
repeatability_um = 60
marker_sigma_um = { M1 = 10, M2 = 20.0 }
interest = ["joint_compliance", "joint2", "joint3.offset"]
combination = { "joint2.compliance" = 1.0, "joint3.compliance" = -2 }
prior = "typical"
candidates = 5000
target_um = 30
[design.levels]
joint2_deg = [-90, 0]
poses_per_level = [3, 4]
[[design.test_pose]]
q_deg = [90, 180]
load_N = [1, 2, 3]
weight = 2
point_m = [0.1, 0, 0]
[[design.test_pose]]
q_si = [0.5, 1]
[design.test_path]
file = "path.csv"
load_N = [0, 0, -100]
point_m = [0, 0, 1]
[design.test_box]
lower_m = [0, 0, 0]
upper_m = [1, 2, 3]
count = 7
rpy_deg = [0, 0, 90]
load_N = [0, 0, -1]
point_m = [0, 1, 0]
[design.motion]
home_deg = [0, 90]
speed_deg_per_s = [90, 180]
dwell_s = 20
load_change_s = 300
both_directions = true
overshoot_deg = 3
"""
    ).design
    assert (spec.poses, spec.criterion, spec.repeats) == (7, "c", 6)
    assert spec.loads.tolist() == [[0, 0, 0], [0, 0, -2600]]
    assert (spec.levels, spec.per_level) == ({"joint2": (-np.pi / 2, 0.0)}, (3, 4))
    assert (spec.repeatability, spec.target) == (6e-5, 3e-5)
    assert spec.marker_sigma == {"M1": 1e-5, "M2": 2e-5}
    assert spec.interest == ("joint_compliance", "joint2", "joint3.offset")
    assert spec.combination == {"joint2.compliance": 1.0, "joint3.compliance": -2.0}
    assert spec.prior == "typical"
    assert spec.candidates == 5000
    first, second = spec.test_poses
    np.testing.assert_allclose(first.q, [np.pi / 2, np.pi])
    assert (first.force.tolist(), first.weight, first.point.tolist()) == ([1, 2, 3], 2, [0.1, 0, 0])
    assert (first.degrees, second.degrees) == (True, False)
    assert (second.q.tolist(), second.force, second.weight, second.point) == (
        [0.5, 1],
        None,
        1,
        None,
    )
    path, box, motion = spec.test_path, spec.test_box, spec.motion
    assert path.file == folder / "path.csv"
    assert (path.force.tolist(), path.point.tolist()) == ([0, 0, -100], [0, 0, 1])
    assert (box.lower.tolist(), box.upper.tolist(), box.count) == ([0, 0, 0], [1, 2, 3], 7)
    np.testing.assert_allclose(box.rotation @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    assert (box.force.tolist(), box.point.tolist()) == ([0, 0, -1], [0, 1, 0])
    np.testing.assert_allclose(motion.home, [0, np.pi / 2])
    np.testing.assert_allclose(motion.speed, [np.pi / 2, np.pi])
    assert (motion.dwell, motion.load_change, motion.both_directions) == (20, 300, True)
    assert motion.overshoot == pytest.approx(np.radians(3))
    assert motion.degrees


def test_an_empty_table_asks_for_the_defaults(read):
    assert read(CELL + "[design]\n").design == DesignSpec()
    assert read(CELL + "[design.motion]\n").design == DesignSpec()


def test_one_speed_stands_for_all_joints(read):
    speed = read(CELL + "[design.motion]\nspeed_deg_per_s = 180").design.motion.speed
    np.testing.assert_allclose(speed, [np.pi])


def test_one_number_of_poses_stands_for_every_level(read):
    spec = read(CELL + "[design.levels]\njoint3_m = [0.1, 0.2, 0.3]\nposes_per_level = 4").design
    assert (spec.poses, spec.per_level) == (12, (4, 4, 4))
    assert spec.levels == {"joint3": (0.1, 0.2, 0.3)}


def test_levels_without_numbers_of_poses_leave_them_open(read):
    spec = read(CELL + "[design]\nposes = 7\n[design.levels]\njoint2_deg = [0, 10, 20]").design
    assert (spec.poses, spec.per_level) == (7, ())


def test_the_criterion_for_a_combination_may_be_asked_for_later(read):
    assert (
        read(CELL + '[design]\ncombination = { "joint2.offset" = 1 }').design.criterion
        == "test_pose"
    )


@pytest.mark.parametrize(
    ("text", "told"),
    [
        # unknown keys, missing units, missing keys
        ("[design]\nq_deg = [1]", ["did you mean it in [[design.test_pose]]"]),
        ("[design]\nloads = [[0, 0, 0]]", ["design.loads;", "missing unit: did you mean loads_N"]),
        ("[design]\ntarget_mm = 1", ["other unit: did you mean target_um"]),
        ("[design.test_box]\nlower_m = [0, 0, 0]", ["design.test_box.upper_m is missing"]),
        ("[design.levels]\njoint2 = [0]", ["design.levels.joint2;", "missing unit: joint2_deg"]),
        (
            "[design.levels]\nposes_per_levl = 3",
            ["design.levels.poses_per_levl", "poses_per_level"],
        ),
        ("[design.levels]\nposes_per_levl = [3]", ["did you mean 'poses_per_level'"]),
        # wrong values
        ("[design]\nposes = 0", ["design.poses", "whole number >= 1", "0"]),
        ("[design]\ncombination = { a = 0 }", ["no factor other than zero"]),
        ("[design]\ncombination = { joint2.compliance = 1 }", ["combination.joint2", "in quotes"]),
        ("[design]\nloads_N = [0, 0, -2600]", ["design.loads_N", "list of forces", "[[0, 0, 0]"]),
        ("[design]\nloads_N = [[0, 0, 1], [0, 0, 1]]", ["design.loads_N repeats a load"]),
        ("[design]\nmarker_sigma_um = { M3 = 1 }", ["[design.marker_sigma_um] names 'M3'", "M1"]),
        ("[design]\nrobust = 'worst'", ["key design.robust is gone", "augment"]),
        ("[design.levels]\njoint2_deg = 3", ["design.levels.joint2_deg", "joint2_deg = [-25.2"]),
        ("[design.levels]\njoint2_deg = [1, 1]", ["repeats a level of joint2"]),
        ("[design.levels]\njoint2_deg = [1]\njoint2_rad = [1]", ["joint2 in two units"]),
        ("[design.levels]\njoint2_deg = [1]\njoint3_deg = [1]", ["joint2 and joint3", "only one"]),
        ("[design.levels]\nposes_per_level = 3", ["no meaning without levels"]),
        ("[design.levels]\njoint2_deg = [1]\nposes_per_level = [1, 2]", ["2 numbers for 1 levels"]),
        (
            "[design]\nposes = 5\n[design.levels]\njoint2_deg = [1, 2]\nposes_per_level = 3",
            ["design.poses is 5", "sum to 6"],
        ),
        (
            "[design]\nposes = 1\n[design.levels]\njoint2_deg = [1, 2]",
            ["design.poses is 1", "joint2 has 2 levels"],
        ),
        ("[[design.test_pose]]\nq_deg = [0]\nq_si = [0]", ["q_deg of", "two units; keep one"]),
        ("[[design.test_pose]]\nq_deg = [0]\npoint_m = [0]", ["point_m of", "flange frame"]),
        ("[design.test_path]\nfile = 'no.csv'", ["design.test_path.file", "no.csv", "not exist"]),
        (BOX.replace("1, 1, 1", "1, -1, 1"), ["lower_m < upper_m", "found 0 and -1 in y"]),
        (BOX + "count = 0", ["design.test_box.count", "1 to 10000"]),
        (BOX + "count = 10001", ["design.test_box.count", "1 to 10000"]),
        ("[design.motion]\nhome_deg = [0]\nhome_si = [0]", ["home_deg and", "two units"]),
        ("[design.motion]\nhome_si = [0]\nspeed_deg_per_s = 1", ["home_si mix units"]),
    ],
)
def test_what_is_wrong_is_told_with_key_and_remedy(refusal, text, told):
    message = refusal(CELL + text)
    assert not [part for part in told if part not in message], message


def test_the_cell_shown_in_the_documentation_is_a_cell(read):
    spec = read(SHOWN).design
    assert (spec.poses, len(spec.test_poses), spec.test_box.count) == (15, 1, 20)


VALUES = st.recursive(
    st.booleans()
    | st.integers(-3, 3)
    | st.sampled_from([0.0, -1.5, 1e308, 1e-320, 10**15, 10**400])
    | st.sampled_from(["M1", "link2", "box", "flange", "", "joint2", "path.csv", "pose"]),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["M1", "name", "shape", "joint2_deg", "file"]), inner)
    ),
    max_leaves=6,
)


def spots(table, above=()):
    """The path of every value in nested tables and lists."""
    items = table.items() if isinstance(table, dict) else enumerate(table)
    for key, value in items:
        yield (*above, key)
        if isinstance(value, dict | list):
            yield from spots(value, (*above, key))


PARSED = tomllib.loads(SHOWN + REST)
SPOTS = list(spots(PARSED))


def toml(value):
    if isinstance(value, dict):
        return "{" + ", ".join(f"'{key}' = {toml(v)}" for key, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"'{value}'" if isinstance(value, str) else repr(value)


@settings(
    max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.lists(
        st.tuples(st.sampled_from(SPOTS), st.sampled_from(["set", "drop", "rename"]), VALUES),
        min_size=1,
        max_size=3,
    )
)
def test_no_mutation_gives_anything_but_a_cell_or_an_input_error(read, changes):
    data = copy.deepcopy(PARSED)
    for spot, how, value in changes:
        owner = data
        try:
            for key in spot[:-1]:
                owner = owner[key]
            old = owner[spot[-1]]
        except (KeyError, IndexError, TypeError):
            continue  # gone with an earlier change
        if isinstance(owner, str):
            continue  # as what an earlier change put there
        if how == "set":
            owner[spot[-1]] = value
        elif isinstance(owner, dict):
            del owner[spot[-1]]
            if how == "rename":
                owner[f"{spot[-1]}_"] = old
    try:
        read("\n".join(f"{key} = {toml(value)}" for key, value in data.items()))
    except InputError as error:
        assert "cell.toml: " in str(error)
