"""`elastocal design` as a user meets it: what it writes, and that simulate and identify take it."""

import csv
import re

import pytest
from support.design_commands import (
    DEFLECTION,
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
    # That is how it should be, and no warning.
    assert added["made_for"] == "the arm as identified from the measurements done"
    assert not any("measurements done" in text for text in added["warnings"])
    # Four poses are done: one more is a plan, although alone it could not tell the five apart.
    assert planned(cell, "--poses", "1", "--augment", done)["n_poses"] == 1
