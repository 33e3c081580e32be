"""`elastocal design` as a user meets it: what it writes, and that simulate and identify take it."""

import csv
import re

from support.design_commands import design, deviations, elastocal, planned, write_cell


def rows_of(path):
    with open(path, encoding="utf-8", newline="") as handle:
        return list(csv.DictReader(handle))


def test_a_target_is_met_by_the_fewest_poses(tmp_path):
    cell = write_cell(tmp_path)
    hard = planned(cell, "--target", 5)
    assert hard["value"] <= 5
    fewer = planned(cell, "--poses", hard["n_poses"] - 1)
    assert fewer["certificate"]["bound_pool"] > 5


def test_a_plan_is_tried_as_told_and_adds_to_the_measurements_done(tmp_path):
    cell, plan, data = write_cell(tmp_path), tmp_path / "plan.csv", tmp_path / "data.csv"
    told = design(cell, "--poses", "4")
    (line,) = re.findall(r"To try it without an arm: elastocal (.*)", told.stdout)
    words = line.replace("data.csv", str(data)).split()
    assert words[-4:] == ["--load", "0", "0", "-2600"]
    assert "every reading is unloaded" in elastocal(*words[:-4]).stderr
    done = elastocal(*words)  # as printed: what `identify` can use
    assert done.exit_code == 0 and "Warning" not in done.stderr, done.output
    assert {float(row["force_z_N"]) for row in rows_of(data)} == {0.0, -2600.0}
    alone = planned(cell, "--poses", "3")
    added = planned(cell, "--poses", "3", "--augment", data)
    # Numbered after those done, so that what is measured next can join the table.
    assert [row["configuration"] for row in rows_of(plan)] == ["5", "6", "7"]
    assert added["n_poses"] == 3 and added["value"] < alone["value"]
    smaller = deviations(alone)
    assert all(std < smaller[name] for name, std in deviations(added).items())
    # That is how it should be, and no warning.
    assert added["made_for"] == "the arm as identified from the measurements done"
    assert not any("measurements done" in text for text in added["warnings"])
    # Four poses are done: one more is a plan, although alone it could not tell the five apart.
    assert planned(cell, "--poses", "1", "--augment", data)["n_poses"] == 1
