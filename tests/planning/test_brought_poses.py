"""Poses that one brings, that stay or are struck out, and the load states of each."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from support.cells import DOWN
from support.design_cells import plan_cell
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
from elastocal.cell import HalfSpace, Workspace
from elastocal.messages import InputError
from elastocal.planning.feasibility import NEARBY
from elastocal.planning.plan import Plan

JOINTS = [f"q{k}_deg" for k in range(1, 7)]
LEVELS = "\n[design.levels]\njoint2_deg = [-30, -90]\n"


def taught(folder, n=9, levels=(), more=(), name="taught.csv"):
    """A table of n poses T1, T2, …, their joint 2 at the levels in turn."""
    q = np.random.default_rng(4).uniform(-60, 60, (n, 6))
    q[:, 1] = np.resize(levels, n) if len(levels) else q[:, 1] - 60
    rows = [f"T{k + 1},{','.join(map(repr, pose.tolist()))}" for k, pose in enumerate(q)]
    text = "\n".join([f"configuration,{','.join(JOINTS)}", *rows, *more]) + "\n"
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def rows_of(path):
    with open(path, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def names_of(folder, plan="plan.csv"):
    return [row["configuration"] for row in rows_of(folder / plan)]


def test_the_plan_is_the_best_of_the_poses_that_one_brings(tmp_path):
    head, *rows = taught(tmp_path).read_text(encoding="utf-8").splitlines()
    read = "\n".join([f"marker,{head}", *(f"of another tool,{row}" for row in rows)])
    (tmp_path / "taught.csv").write_text(read, encoding="utf-8")
    cell = write_cell(tmp_path, altered(DEFLECTION, candidates='"taught.csv"', poses="4"))
    plan = planned(cell)
    chosen = names_of(tmp_path)
    assert len(chosen) == 4 and set(chosen) <= {f"T{k}" for k in range(1, 10)}
    assert plan["candidates"]["tried"] == plan["candidates"]["feasible"] == 9
    assert 0 < plan["certificate"]["efficiency_pool"] <= 1
    # No other pose of the table is better in the place of one of these.
    for k in range(2):
        keep = f"{tmp_path / 'taught.csv'}:{','.join(chosen[:k] + chosen[k + 1 :])}"
        again = planned(cell, "--keep", keep, output="again.csv")
        assert again["value"] == pytest.approx(plan["value"], rel=1e-6)
        assert set(names_of(tmp_path, "again.csv")) == set(chosen)


def test_poses_stay_where_they_were_taught_and_drawn_ones_join_them(tmp_path):
    path = taught(tmp_path)
    brought = {row["configuration"]: [float(row[j]) for j in JOINTS] for row in rows_of(path)}
    cell = write_cell(tmp_path)
    planned(cell, "--candidates", path)
    for row in rows_of(tmp_path / "plan.csv"):
        assert [float(row[j]) for j in JOINTS] == pytest.approx(brought[row["configuration"]])
    alone = ec.design(cell, candidates=path, effort="quick")
    both = ec.design(cell, candidates=[path, 40], effort="quick")
    assert both.candidates.feasible >= 49
    assert both.value < alone.value and alone.polished == 0
    # They may name a marker where the cell names none.
    path.write_text(path.read_text().replace("\n", ",P\n").replace("deg,P", "deg,marker"))
    bare = DEFLECTION.partition("[tool.markers_m]")[0] + DEFLECTION[DEFLECTION.index("[tracker]") :]
    planned(write_cell(tmp_path, bare), "--candidates", path)


def test_refused_poses_are_listed_by_the_rule_and_levels_are_kept(tmp_path):
    more = ["far,0,-30,0,0,0,999", "between,0,-31,0,0,0,0", "again,10,-30,20,30,40,50"]
    taught(tmp_path, levels=(-30.0, -90.0), more=[*more, "twice,10,-30,20,30,40,50"])
    text = altered(DEFLECTION, candidates='"taught.csv"', poses="4")
    plan = planned(write_cell(tmp_path, text + LEVELS))
    told = [w for w in plan["warnings"] if "refused" in w]
    assert len(told) == 1 and "2 of 12 poses are refused" in told[0]
    assert "level (between)" in told[0] and "joint limits (far)" in told[0]
    assert plan["candidates"]["removed_by"]["level"] == 1
    at = sorted(float(r["q2_deg"]) for r in rows_of(tmp_path / "plan.csv"))
    assert at == [-90, -90, -30, -30]


@pytest.mark.parametrize(
    ("candidates", "told"),
    [
        ('"nowhere.csv"', "nowhere.csv"),
        ('["taught.csv", "taught.csv"]', "candidates takes a whole number >= 1, a file of poses"),
        ('"broken.csv"', "q6_deg"),
        ('"few.csv"', "few.csv: 1 of 3 poses are refused"),
        ('"off.csv"', "are refused, by the rule that each breaks first: joint limits (A);"),
    ],
)
def test_every_mistake_is_told_before_anything_is_written(tmp_path, candidates, told):
    taught(tmp_path)
    taught(tmp_path, 2, more=["far,0,-30,0,0,0,999"], name="few.csv")
    (tmp_path / "broken.csv").write_text("configuration,q1_deg\n1,0\n", encoding="utf-8")
    (tmp_path / "off.csv").write_text(f"configuration,{','.join(JOINTS)}\nA,0,0,0,0,0,999\n")
    result = design(write_cell(tmp_path, altered(DEFLECTION, candidates=candidates)))
    assert result.exit_code in (1, 2) and told in result.stderr.replace("\n", " ")
    assert not (tmp_path / "plan.csv").exists()


CELL = plan_cell(loads=DOWN[None], poses=6, candidates=60)


@lru_cache
def first() -> Plan:
    return ec.design(CELL, effort="quick")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    first().save(tmp_path / "plan.csv")
    return tmp_path / "plan.csv"


def test_one_pose_struck_is_replaced_and_no_other_is_better(file) -> None:
    plan = ec.design(CELL, effort="quick", strike=f"{file}:3")
    assert plan.names == ("1", "2", "4", "5", "6", "7")
    kept = [k for k, name in enumerate(first().names) if name != "3"]
    assert np.allclose(plan.q[:5], first().q[kept], atol=1e-9)
    assert np.abs(plan.q[5] - first().q[2]).max() >= NEARBY
    assert first().value <= plan.value * (1 + 5e-3)
    assert 0.9 < plan.certificate.efficiency_pool <= 1
    assert plan.candidates.removed_by["struck"] >= 0
    loads = {stop.load for stop in plan.execution.stops if stop.pose == 5}
    assert loads == {0, 1}  # without and with load


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"strike": ":9"}, "no pose '9'"),
        ({"strike": ""}, "takes poses"),
        ({"keep": "", "poses": 5}, "no more than 5"),
        ({"keep": ":1", "strike": ":2"}, "kept twice"),
    ],
)
def test_what_cannot_be_is_said(file, asked, told) -> None:
    files = {k: f"{file}{v}" if k != "poses" else v for k, v in asked.items()}
    with pytest.raises(InputError, match=told):
        ec.design(CELL, effort="quick", **files)


def test_a_pose_that_breaks_a_rule_cannot_stay(file) -> None:
    low = HalfSpace("low roof", np.array([0.0, 0, 0.8]), np.array([0.0, 0, -1]))
    cell = replace(CELL, workspace=Workspace(keep_out=(low,), link_radius=(0.1,) * 6))
    with pytest.raises(InputError, match=r"pose '\d', .* breaks keep_out"):
        ec.design(cell, effort="quick", keep=file, poses=8)


THREE = "[[0, 0, 0], [0, 0, -1300], [0, 0, -2600]]"
MOTION = "\n[design.motion]\ndwell_s = 30\nreading_s = 2\nextra_time = 0.0\n"
CHOSEN = altered(POSITION, load_states='"chosen"', loads_N=THREE, poses="6", repeats="2") + MOTION


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
    taught(tmp_path)
    text = altered(CHOSEN, candidates='"taught.csv"', loads_N="[[0, 0, 0], [0, 0, -2600]]")
    plan = planned(write_cell(tmp_path, text))
    rows = rows_of(tmp_path / "plan.csv")
    names = [row["configuration"] for row in rows]
    assert set(names) <= {f"T{k}" for k in range(1, 10)} and len(names) == 12 > len(set(names))
    assert len({(row["configuration"], row["force_z_N"]) for row in rows}) == 12
    assert plan["candidates"]["feasible"] == 9


def test_what_readings_share_in_all_load_states_forbids_a_choice(tmp_path):
    text = CHOSEN + "\n[noise]\nconfiguration_um = 20\n"
    result = design(write_cell(tmp_path, text))
    assert result.exit_code == 2 and "configuration_um" in result.stderr
    assert not (tmp_path / "plan.csv").exists()
