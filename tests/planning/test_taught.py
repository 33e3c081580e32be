"""Poses that one brings: the plan is the best of those that the rules allow, and says which not."""

import csv

import numpy as np
import pytest
from support.design_commands import DEFLECTION, altered, design, planned, write_cell

import elastocal as ec
from elastocal.errors import InputError

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
    taught(tmp_path)
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
    mixed = planned(cell, "--candidates", f"{path},40", output="mixed.csv")
    assert mixed["candidates"]["feasible"] >= 49
    alone = ec.design(cell, candidates=path, effort="quick")
    both = ec.design(cell, candidates=[path, 40], effort="quick")
    assert both.value < alone.value and alone.polished == 0


def test_refused_poses_are_listed_by_the_rule_and_levels_are_kept(tmp_path):
    more = ["far,0,-30,0,0,0,999", "between,0,-31,0,0,0,0", "again,10,-30,20,30,40,50"]
    taught(tmp_path, levels=(-30.0, -90.0), more=[*more, "twice,10,-30,20,30,40,50"])
    text = altered(DEFLECTION, candidates='"taught.csv"', poses="4")
    plan = planned(write_cell(tmp_path, text + LEVELS))
    told = [w for w in plan["warnings"] if "refused" in w]
    assert len(told) == 1 and "2 of 12 poses are refused" in told[0]
    assert "level (between)" in told[0] and "joint limits (far)" in told[0]
    assert plan["candidates"]["removed_by"]["level"] == 1
    assert sorted(float(r["q2_deg"]) for r in rows_of(tmp_path / "plan.csv")) == [
        -90,
        -90,
        -30,
        -30,
    ]


@pytest.mark.parametrize(
    ("candidates", "told"),
    [
        ('"nowhere.csv"', "nowhere.csv"),
        ('["taught.csv", "taught.csv"]', "candidates takes a whole number >= 1, a file of poses"),
        ("[3, 4]", "candidates takes a whole number >= 1, a file of poses"),
        ("0", "candidates"),
        ('"broken.csv"', "q6_deg"),
        ('"few.csv"', "the cell allows 2 there; bring more"),
        ('"off.csv"', "the cell allows none of its 1 poses"),
    ],
)
def test_every_mistake_is_told_before_anything_is_written(tmp_path, candidates, told):
    taught(tmp_path)
    taught(tmp_path, 2, name="few.csv")
    (tmp_path / "broken.csv").write_text("configuration,q1_deg\n1,0\n", encoding="utf-8")
    (tmp_path / "off.csv").write_text(f"configuration,{','.join(JOINTS)}\n1,0,0,0,0,0,999\n")
    result = design(write_cell(tmp_path, altered(DEFLECTION, candidates=candidates)))
    assert result.exit_code in (1, 2) and told in result.stderr.replace("\n", " ")
    assert not (tmp_path / "plan.csv").exists()


def test_python_says_what_candidates_take(tmp_path):
    with pytest.raises(InputError, match="takes a whole number >= 1, a file of"):
        ec.design(write_cell(tmp_path), candidates=[2.5])
