"""`elastocal design` as a user meets it: what it writes, and that simulate and identify take it."""

import csv
import json
import re

import pytest
from support.cells import COMPLIANCE
from support.design_commands import (
    DEFLECTION,
    POSITION,
    altered,
    design,
    deviations,
    elastocal,
    planned,
    write_cell,
)

TWO_LEVELS = "\n[design.levels]\njoint2_deg = [-25.24, -56.9]\n"
LEVELS = altered(DEFLECTION, poses="6") + TWO_LEVELS
SEEN = [f"joint{i}.compliance" for i in range(2, 7)]
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
    hard = planned(cell, "--target", 5)
    assert hard["value"] <= 5
    fewer = planned(cell, "--poses", hard["n_poses"] - 1)
    assert fewer["certificate"]["bound_pool"] > 5


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
