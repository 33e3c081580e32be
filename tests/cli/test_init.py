"""What init and design print to go on with is run as it stands."""

import csv
import json
import re
import shutil
from pathlib import Path

import pytest
from support.design_commands import design, elastocal, write_cell
from support.mjcf_text import write_arm

import elastocal as ec
from elastocal.model.manipulator import Model

TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorial"


@pytest.fixture
def arms(tmp_path, monkeypatch):
    (tmp_path / "arms").mkdir()
    shutil.copyfile(TUTORIAL / "arm.csv", tmp_path / "arms" / "arm.csv")
    write_arm(tmp_path / "arms")
    monkeypatch.chdir(tmp_path)


def run(*words):
    done = elastocal(*words)
    assert done.exit_code == 0, done.stderr
    return done.stdout


def test_the_cell_it_writes_plans_and_simulates_as_it_is(arms):
    out = run("init", "arms/arm.xml")
    assert "elastocal design cell.toml -o plan.csv --effort quick" in out
    run("design", "cell.toml", "-o", "plan.csv", "--effort", "quick", "--poses", "8",
        "--candidates", "20", "-q")  # fmt: skip
    run(*out.splitlines()[-1].split()[1:], "--truth", "t.json")  # as init says it
    truth = json.loads(Path("t.json").read_text())
    drawn = [v for name, v in truth.items() if name.endswith("compliance")]
    assert max(drawn) > 1e-8 and min(drawn) >= 0  # --draw 1 draws compliances too
    assert len(Model(ec.read_cell("cell.toml")).read("data.csv")) >= 8


def test_an_arm_is_drawn_by_its_cell_and_seed_alone(arms):
    """Whatever the plan and its load: a table kept back as a test is of the arm calibrated."""
    Path("cell.toml").write_text("mine")
    run("init", "arms/arm.csv", "--force")
    text = Path("cell.toml").read_text()
    text = "\n".join(ln for ln in text.splitlines() if not ln.startswith("loads_N"))
    Path("loadless.toml").write_text(text.replace('"joint_compliance:joint2",',
                                                  '"joint_compliance",'))  # fmt: skip
    heads = ",".join(f"q{i}_deg" for i in range(1, 7))
    Path("one.csv").write_text(f"{heads}\n10,-60,50,5,20,5\n")
    Path("two.csv").write_text(f"{heads}\n0,-70,40,0,0,0\n-50,-30,20,60,-70,30\n")
    for cell in ("cell.toml", "loadless.toml"):
        truths = []
        for plan, load in (("one.csv", ()), ("two.csv", ("--load", 0, 0, -5)),
                           ("two.csv", ("--load", 90, 0, 0))):  # fmt: skip
            run("simulate", cell, plan, "-o", "data.csv", "--draw", 1, "--seed", 1, "--truth",
                "t.json", *load)  # fmt: skip
            truths.append(json.loads(Path("t.json").read_text()))
        assert truths[0] == truths[1] == truths[2]
        drawn = {n: v for n, v in truths[0].items() if n.endswith("compliance")}
        # None below zero; none at zero but what turns about an axis that no load is off.
        assert min(drawn.values()) > 1e-8, drawn


def test_a_plan_is_tried_as_told(tmp_path):
    cell, data = write_cell(tmp_path), tmp_path / "data.csv"
    told = design(cell, "--poses", "4")
    (line,) = re.findall(r"To try it without an arm: elastocal (.*)", told.stdout)
    words = line.replace("data.csv", str(data)).split()
    assert words[-4:] == ["--load", "0", "0", "-2600"]
    assert "every reading is unloaded" in elastocal(*words[:-4]).stderr
    done = elastocal(*words)  # as printed: what `identify` can use
    assert done.exit_code == 0 and "Warning" not in done.stderr, done.output
    with data.open(encoding="utf-8", newline="") as handle:
        assert {float(row["force_z_N"]) for row in csv.DictReader(handle)} == {0.0, -2600.0}
