"""`elastocal design` as a user meets it: what it writes, and that simulate and identify take it."""

import csv
import json
import re

import numpy as np
import pytest
from support.cells import COMPLIANCE, kr270_chain
from support.design_commands import (
    DEFLECTION,
    POSITION,
    altered,
    design,
    deviations,
    elastocal,
    everything_in,
    planned,
    write_cell,
)

from elastocal.measurements import read_plan

TWO_LEVELS = "\n[design.levels]\njoint2_deg = [-25.24, -56.9]\n"
LEVELS = altered(DEFLECTION, poses="6") + TWO_LEVELS
SEEN = [f"joint{i}.compliance" for i in range(2, 7)]
UNSEEN = "joint1.compliance"
# Without load first and last, with it in between: a drift of 50 µm makes that pay.
ORDERS = ["order", "note_order_2", "note_order_3"]


@pytest.fixture(scope="module")
def levels(tmp_path_factory):
    """A folder with the plan of two levels, its picture and programs, and what was printed."""
    folder = tmp_path_factory.mktemp("levels")
    cell = write_cell(folder, LEVELS)
    files = [folder / name for name in ("picture.png", "moves.src", "moves.script")]
    options = ("--picture", files[0], "--program", files[1], "--program", files[2])
    result = design(cell, *options, "--seed", "7")
    assert result.exit_code == 0, result.stderr
    return folder, result.stdout


def rows_of(path):
    with open(path, encoding="utf-8", newline="") as handle:
        return list(csv.DictReader(handle))


def test_the_plan_has_the_columns_of_its_format_and_the_poses_asked_for(levels):
    folder, _ = levels
    rows = rows_of(folder / "plan.csv")
    joints = [f"q{i}_deg" for i in range(1, 7)]
    carried = ["note_load", "note_load_2", "note_load_3"]
    assert list(rows[0]) == ["configuration", *joints, "level", *ORDERS, *carried]
    loads = {tuple(row[key] for key in carried) for row in rows}
    assert loads == {("unloaded", "0 0 -2600 N", "unloaded")}
    assert [row["configuration"] for row in rows] == ["1", "2", "3", "4", "5", "6"]
    assert [row["level"] for row in rows] == ["1"] * 3 + ["2"] * 3
    assert [float(row["q2_deg"]) for row in rows] == [-25.24] * 3 + [-56.9] * 3
    orders = [int(row[key]) for row in rows for key in ORDERS]
    assert sorted(orders) == list(range(1, 19))
    poses = read_plan(folder / "plan.csv", joint_kinds=kr270_chain().kinds)
    stated = [[float(row[j]) for j in joints] for row in rows]
    np.testing.assert_allclose(poses.q, np.radians(stated), atol=1e-11)


def test_the_summary_has_every_key_of_its_schema(levels):
    folder, _ = levels
    plan = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
    assert plan["schema"] == "elastocal/plan/1"
    assert (plan["criterion"], plan["unit"], plan["n_poses"]) == ("test_pose", "µm", 6)
    assert plan["seed"] == 7
    tried = plan["candidates"]
    assert tried["feasible"] + sum(tried["removed_by"].values()) == tried["tried"]
    told = plan["certificate"]
    assert 0 < told["efficiency_continuum"] <= told["efficiency_pool"] <= 1
    # Φ is a mean square, and the plan and its bound are told as its root.
    expected = (told["bound_pool"] / plan["value"]) ** 2
    assert told["efficiency_pool"] == pytest.approx(expected, rel=1e-9)
    assert [(p["name"], p["unit"]) for p in plan["predicted"]] == [(n, "rad/(N*m)") for n in SEEN]
    assert all(0 < p["std"] < p["ci95_half_width"] < 1e-6 for p in plan["predicted"])
    assert [p["configuration"] for p in plan["poses"]] == [1, 2, 3, 4, 5, 6]
    assert any(UNSEEN in text for text in plan["warnings"])


def test_the_certificate_says_that_no_pose_is_in_the_plan_twice(levels):
    told = " ".join(levels[1].split())
    assert re.search(
        r"efficiency [\d.]+ against the best plan .* candidates, each in it once", told
    )


def test_every_file_asked_for_is_written_and_told(levels):
    folder, told = levels
    written = ["plan.csv", "plan.json", "picture.png", "moves.src", "moves.script"]
    assert everything_in(folder) == sorted(["cell.toml", *written])
    assert re.findall(r"wrote .*/(\S+)", told) == [
        "plan.csv",
        "plan.json",
        *written[3:],
        written[2],
    ]
    assert (folder / "picture.png").read_bytes().startswith(b"\x89PNG")


def test_to_try_the_plan_its_load_is_part_of_the_command(levels):
    """As printed it simulates what `identify` can use; without the load nothing is to be seen."""
    folder, told = levels
    (line,) = re.findall(r"To try it without an arm: elastocal (.*)", told)
    words = line.replace("data.csv", str(folder / "tried.csv")).split()
    assert words[-4:] == ["--load", "0", "0", "-2600"]
    done = elastocal(*words)
    assert done.exit_code == 0 and "Warning" not in done.stderr, done.output
    assert {float(row["force_z_N"]) for row in rows_of(folder / "tried.csv")} == {0.0, -2600.0}
    done = elastocal(*words[:-4])
    assert "every reading is unloaded" in done.stderr
    (folder / "tried.csv").unlink()


def test_the_programs_move_to_the_plan_in_its_order(levels):
    folder, _ = levels
    rows = rows_of(folder / "plan.csv")
    visits = [(int(r[key]), r) for r in rows for key in ORDERS]
    wanted = [[float(r[f"q{i}_deg"]) for i in range(1, 7)] for _, r in sorted(visits, key=first)]
    krl = re.findall(r"PTP \{(.*)\}", (folder / "moves.src").read_text())
    moves = [[float(part.split()[1]) for part in line.split(", ")] for line in krl]
    np.testing.assert_allclose(moves, wanted, atol=1e-5)
    script = re.findall(r"movej\(\[(.*)\]", (folder / "moves.script").read_text())
    turned = [[float(v) for v in line.split(", ")] for line in script]
    np.testing.assert_allclose(np.degrees(turned), wanted, atol=1e-5)


def first(pair):
    return pair[0]


def identified(cell, *simulated):
    """Result and truth of measuring plan.csv and identifying."""
    folder = cell.parent
    files = folder / "plan.csv", "-o", folder / "data.csv", "--truth", folder / "truth.json"
    result = elastocal("simulate", cell, *files, "--seed", "3", *simulated)
    assert result.exit_code == 0, result.stderr
    options = ("--method", "wls", "-q", "-o", folder / "result.json")
    result = elastocal("identify", cell, folder / "data.csv", *options)
    assert result.exit_code == 0, result.stderr
    found = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    return (
        {p["name"]: p for p in found["parameters"] if p["std"] is not None},
        json.loads((folder / "truth.json").read_text(encoding="utf-8")),
    )


def keeps_its_promise(plan, found, truth, names):
    """The predicted deviations are those identified, and the truth lies within them."""
    promised = deviations(plan)
    for name in names:
        std = promised[name]
        assert found[name]["std"] == pytest.approx(std, rel=0.15), name
        assert abs(found[name]["value"] - truth[name]) < 4.5 * std, name


def test_deflections_of_the_plan_identify_the_arm_as_well_as_predicted(tmp_path):
    cell = write_cell(tmp_path, altered(LEVELS, repeats="6"))
    plan = planned(cell)
    load = ("--load", "0", "0", "-2600", "--repeats", "6")
    truth = [f"--set={name}={1.3 * c}" for name, c in zip(SEEN, COMPLIANCE[1:], strict=True)]
    assert list(deviations(plan)) == SEEN
    keeps_its_promise(plan, *identified(cell, *load, *truth), SEEN)


def test_positions_of_the_plan_identify_the_arm_as_well_as_predicted(tmp_path):
    cell = write_cell(tmp_path, altered(POSITION, repeats="6", poses="8"))
    plan = planned(cell)
    told = {p["name"]: p["combined_with"] for p in plan["predicted"]}
    assert told["base.rz"] == ["joint1.offset"]  # turns about one axis
    truth = ("--set=joint3.offset=0.001", "--set=joint5.compliance=3.6e-6")
    load = ("--load", "0", "0", "-2600", "--repeats", "6")
    found, true = identified(cell, *load, *truth)
    # Only the load tells the turn of joint 6 from the places of the markers, and hardly; what
    # goes with it, identification may leave as sums.
    names = [*SEEN, *(f"joint{i}.offset" for i in range(2, 6)), *(f"marker:M{i}.z" for i in "123")]
    names = [name for name in names if name in found]
    assert len(names) >= 8 and "joint5.compliance" in names and "joint2.offset" in names
    keeps_its_promise(plan, found, true, names)


def test_a_plan_states_its_forces_where_each_pose_has_its_own_load(tmp_path):
    cell = write_cell(tmp_path, altered(POSITION, load_choice="true", poses="8"))
    planned(cell)
    forces = [float(row["force_z_N"]) for row in rows_of(tmp_path / "plan.csv")]
    assert set(forces) == {0.0, -2600.0} and len(forces) == 8
    found, _ = identified(cell)
    assert "joint3.compliance" in found and "joint3.offset" in found


NOT_CONVEX = ("O2", "O4")
CRITERIA = ("D", "A", "E", "G", "I", "c", "O1", "O2", "O3", "O4", "O5")


@pytest.mark.parametrize("name", CRITERIA)
def test_every_criterion_has_a_certificate_or_says_why_it_has_none(tmp_path, name):
    text = altered(DEFLECTION, combination='{ "joint2.compliance" = 1.0 }', candidates="30")
    result = design(write_cell(tmp_path, text), "--criterion", name, "--poses", "4")
    assert result.exit_code == 0, result.stderr
    plan = json.loads((tmp_path / "plan.json").read_text("utf-8"))
    told = plan["certificate"]
    assert plan["criterion"] == name
    if name in NOT_CONVEX:
        assert told["efficiency_pool"] is told["bound_pool"] is None
        assert f"none: {name} is not convex" in result.stdout
    else:
        assert 0.5 < told["efficiency_pool"] <= 1
        assert "certified on the pool" in result.stdout
    if name == "c":
        assert plan["value"] == pytest.approx(deviations(plan)["joint2.compliance"], rel=1e-9)


def test_a_curve_falls_and_stays_above_its_bound(tmp_path):
    plan = planned(write_cell(tmp_path), "--curve", "8,3,5,3")
    curve = plan["curve"]
    assert [point["n_poses"] for point in curve] == [3, 5, 8]
    values = [point["value"] for point in curve]
    assert values == sorted(values, reverse=True)
    assert all(point["bound"] <= point["value"] for point in curve)
    assert plan["n_poses"] == 5


def test_a_target_is_met_by_the_fewest_poses(tmp_path):
    cell = write_cell(tmp_path)
    easy, hard = (planned(cell, "--target", target) for target in (6, 5))
    assert easy["n_poses"] < hard["n_poses"]
    assert easy["value"] <= 6 and hard["value"] <= 5
    fewer = planned(cell, "--poses", hard["n_poses"] - 1)
    assert fewer["certificate"]["bound_pool"] > 5


def test_a_number_of_poses_on_the_command_line_overrides_the_cell_s_target(tmp_path):
    cell = write_cell(tmp_path, altered(DEFLECTION, target_um="5.0"))
    assert planned(cell, "--poses", "3")["n_poses"] == 3


def test_a_plan_adds_to_the_measurements_done(tmp_path):
    cell = write_cell(tmp_path)
    planned(cell, "--poses", "4")
    done = tmp_path / "data.csv"
    load = ("--load", "0", "0", "-2600")
    elastocal("simulate", cell, tmp_path / "plan.csv", "-o", done, "--draw", "0.5", *load)
    alone = planned(cell, "--poses", "3")
    added = planned(cell, "--poses", "3", "--augment", done)
    assert added["n_poses"] == alone["n_poses"] == len(rows_of(tmp_path / "plan.csv")) == 3
    # Numbered after those done, so that what is measured next can join the table.
    names = [row["configuration"] for row in rows_of(tmp_path / "plan.csv")]
    assert names == ["5", "6", "7"]
    assert added["value"] < alone["value"]
    smaller = deviations(alone)
    assert all(std < smaller[name] for name, std in deviations(added).items())
    assert any("as identified from the measurements done" in text for text in added["warnings"])
    # Four poses are done: one more is a plan, although alone it could not tell the five apart.
    assert planned(cell, "--poses", "1", "--augment", done)["n_poses"] == 1


def test_what_is_held_is_neither_predicted_nor_asked_for(tmp_path):
    """With --json the summary is on stdout, and nothing else."""
    result = design(write_cell(tmp_path), "--fix", "joint2", "--fix", UNSEEN, "--json")
    plan = json.loads(result.stdout)
    assert plan == json.loads((tmp_path / "plan.json").read_text("utf-8"))
    assert list(deviations(plan)) == SEEN[1:]
    assert not plan["warnings"]


def knowledge_file(folder):
    path = folder / "knowledge.toml"
    names = [f"marker:M{m}.{axis}" for m in (1, 2, 3) for axis in "xyz"]
    names += [f"base.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz")]
    names += [f"joint{i}.offset" for i in range(1, 7)]
    lines = [f'[prior."{name}"]\nmean = 0.0\nstd = 1e-4' for name in names]
    path.write_text("\n".join([*lines, ""]), encoding="utf-8")
    return path


def test_a_prior_makes_a_plan_of_fewer_poses_possible(tmp_path):
    cell = write_cell(tmp_path, altered(POSITION, loads_N="[[0, 0, -2600]]"))
    alone = design(cell, "--poses", "2")
    assert alone.exit_code == 1 and "fewer equations than parameters" in alone.stderr
    plan = planned(cell, "--poses", "2", "--knowledge", knowledge_file(tmp_path))
    assert deviations(plan)["marker:M1.x"] <= 1e-4
    assert not any("priors" in text for text in plan["warnings"])


def test_what_of_the_knowledge_does_not_count_is_told(tmp_path):
    path = tmp_path / "knowledge.toml"
    path.write_text('physical = true\n[prior."joint4.compliance"]\nmean = 2.8e-6\nstd = 1e-9\n')
    plan = planned(write_cell(tmp_path), "--knowledge", path)
    assert any("knowledge.toml: only its priors count" in text for text in plan["warnings"])
    assert deviations(plan)["joint4.compliance"] < 1e-9


@pytest.mark.parametrize("robust", ["average", "worst"])
def test_a_plan_for_an_arm_that_is_not_known_yet(tmp_path, robust):
    text = altered(DEFLECTION, robust=f'"{robust}"', robust_samples="2", candidates="30")
    plan = planned(write_cell(tmp_path, text))
    assert 0 < plan["certificate"]["efficiency_pool"] <= 1


def test_both_directions_are_two_configurations_per_pose(tmp_path):
    cell = write_cell(tmp_path, DEFLECTION + "\n[design.motion]\nboth_directions = true\n")
    assert planned(cell, "--poses", "2")["n_poses"] == 2
    rows = rows_of(tmp_path / "plan.csv")
    assert [row["configuration"] for row in rows] == ["1+", "1-", "2+", "2-"]
    for side, sign in ((rows[::2], "1"), (rows[1::2], "-1")):
        # Joint 6 may stand at its limit, which leaves it one side.
        assert {row[f"approach_{i}"] for row in side for i in range(1, 6)} == {sign}


def test_one_process_plans_as_two_do(tmp_path):
    cell = write_cell(tmp_path)
    plans = {}
    for name, options in (
        ("one", ("--jobs", "1")),
        ("two", ("--jobs", "2")),
    ):
        planned(cell, *options, output=f"{name}.csv")
        plans[name] = (tmp_path / f"{name}.csv").read_bytes()
    assert plans["one"] == plans["two"]
