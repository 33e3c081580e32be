"""Load states chosen with the poses: fewer load changes, less error, and files that say which."""

import csv
import json

import numpy as np
import pytest
from support.design_commands import (
    DEFLECTION,
    POSITION,
    altered,
    design,
    elastocal,
    planned,
    write_cell,
)

import elastocal as ec

THREE = "[[0, 0, 0], [0, 0, -1300], [0, 0, -2600]]"
MOTION = "\n[design.motion]\ndwell_s = 30\nreading_s = 2\nextra_time = 0.0\n"
CHOSEN = altered(POSITION, load_states='"chosen"', loads_N=THREE, poses="6", repeats="2") + MOTION


def rows_of(path):
    with open(path, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_a_chosen_plan_errs_less_in_less_time_and_its_files_say_what_is_read(tmp_path):
    cell = write_cell(tmp_path, CHOSEN)
    ec.design(cell, effort="batch").save(tmp_path / "plan.csv")
    plan = json.loads((tmp_path / "plan.json").read_text(encoding="utf-8"))
    crossed = ec.design(cell, effort="batch", load_states="all").to_json()
    assert plan["value"] < 0.95 * crossed["value"] and plan["minutes"] < crossed["minutes"]
    assert plan["certificate"]["bound_pool"] <= plan["value"]
    assert crossed["load_states"] is None and plan["load_states"]["used"] == "chosen"
    # As many stops as six poses have in three load states, each told with its load and readings.
    rows = rows_of(tmp_path / "plan.csv")
    assert len(rows) == 18 == sum(stop["poses"] for stop in plan["load_states"]["stops"])
    told = {(pose["name"], *load) for pose in plan["poses"] for load in pose["loads_N"]}
    read = {(r["configuration"], *(float(r[f"force_{axis}_N"]) for axis in "xyz")) for r in rows}
    assert told == read and {row["note_readings"] for row in rows} == {"2"}
    assert {pose["readings"] for pose in plan["poses"]} == {2}
    # What it promises is what identification then finds in readings of it.
    data = tmp_path / "data.csv"
    told = elastocal("simulate", cell, tmp_path / "plan.csv", "-o", data, "--repeats", 2)
    assert told.exit_code == 0, told.stderr
    found = ec.identify(cell, data, method="wls", outliers="keep").to_json()["parameters"]
    std = {p["name"]: p["std"] for p in found}
    compliances = [p for p in plan["predicted"] if p["name"].endswith("compliance")]
    assert len(compliances) > 3
    for p in compliances:
        assert std[p["name"]] == pytest.approx(p["std"], rel=0.02)


def test_where_crossing_is_best_the_plan_is_crossed_and_says_so(tmp_path):
    cell = write_cell(tmp_path, altered(DEFLECTION, load_states='"chosen"'))
    plan = ec.design(cell, effort="batch")
    assert plan.states.used == "all" and "takes its reading" in plan.states.why
    assert plan.crossed
    assert ec.design(cell, effort="batch", load_states="all").value == plan.value


def test_brought_poses_keep_their_name_in_each_load_state(tmp_path):
    q = np.random.default_rng(4).uniform(-60, 60, (9, 6)) - [0, 60, 0, 0, 0, 0]
    lines = [f"T{k},{','.join(map(repr, pose))}" for k, pose in enumerate(q.tolist())]
    head = ",".join(["configuration", *(f"q{k}_deg" for k in range(1, 7))])
    (tmp_path / "taught.csv").write_text("\n".join([head, *lines]) + "\n")
    text = altered(CHOSEN, candidates='"taught.csv"', loads_N="[[0, 0, 0], [0, 0, -2600]]")
    plan = planned(write_cell(tmp_path, text))
    rows = rows_of(tmp_path / "plan.csv")
    names = [row["configuration"] for row in rows]
    assert set(names) <= {f"T{k}" for k in range(9)} and len(names) == 12 > len(set(names))
    assert len({(row["configuration"], row["force_z_N"]) for row in rows}) == 12
    assert plan["candidates"]["feasible"] == 9


def test_what_readings_share_in_all_load_states_forbids_a_choice(tmp_path):
    text = CHOSEN + "\n[noise]\nconfiguration_um = 20\n"
    result = design(write_cell(tmp_path, text))
    assert result.exit_code == 2 and "configuration_um" in result.stderr
    assert not (tmp_path / "plan.csv").exists()
