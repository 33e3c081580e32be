"""elastocal init writes a cell that plans and simulates at once; effects lists the catalogue."""

import json
import shutil
from pathlib import Path

import pytest
from support.mjcf_text import write_arm
from support.robots import KR270
from typer.testing import CliRunner

import elastocal as ec
from elastocal.cli.main import app
from elastocal.model.manipulator import Model

TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorial"


@pytest.fixture
def arms(tmp_path, monkeypatch):
    (tmp_path / "arms").mkdir()
    shutil.copyfile(KR270, tmp_path / "arms" / "arm.urdf")
    shutil.copyfile(TUTORIAL / "arm.csv", tmp_path / "arms" / "arm.csv")
    write_arm(tmp_path / "arms")
    monkeypatch.chdir(tmp_path)


def run(*words):
    done = CliRunner().invoke(app, list(map(str, words)))
    return done.exit_code, done.stdout, done.stderr


@pytest.mark.parametrize("name", ["arm.urdf", "arm.csv", "arm.xml"])
def test_the_cell_it_writes_is_one_of_that_arm(name, arms):
    code, out, err = run("init", f"arms/{name}")
    assert code == 0, err
    assert "elastocal design cell.toml -o plan.csv --effort quick" in out
    cell = ec.read_cell("cell.toml")
    model = Model(cell)
    assert f"{model.chain.n_joints} joints (" in out
    assert set(cell.limits) == {f"joint{i + 1}" for i in range(model.chain.n_joints)}
    assert cell.workspace.keep_out[0].name == "mounting plane" and cell.tool.markers
    assert cell.model.link_gravity == bool(model.chain.masses)


def test_the_cell_it_writes_plans_and_simulates_as_it_is(arms):
    _, out, _ = run("init", "arms/arm.xml")
    model = Model(ec.read_cell("cell.toml"))
    code, _, err = run("design", "cell.toml", "-o", "plan.csv", "--effort", "quick", "--poses",
                         "12", "--candidates", "30", "-q")  # fmt: skip
    assert code == 0, err
    code, out, err = run(*out.splitlines()[-1].split()[1:], "--truth", "t.json")  # as init says it
    assert code == 0, err
    truth = json.loads(Path("t.json").read_text())
    drawn = [v for name, v in truth.items() if name.endswith("compliance")]
    assert max(drawn) > 1e-8 and min(drawn) >= 0  # --draw 1 draws compliances too
    assert len(model.read("data.csv")) >= 12


def test_an_arm_is_drawn_by_its_cell_and_seed_alone(arms):
    """Whatever the plan and its load: a table kept back as a test is of the arm calibrated."""
    run("init", "arms/arm.csv")
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
            code, _, err = run("simulate", cell, plan, "-o", "data.csv", "--draw", 1, "--seed", 1,
                               "--truth", "t.json", *load)  # fmt: skip
            assert code == 0, err
            truths.append(json.loads(Path("t.json").read_text()))
        assert truths[0] == truths[1] == truths[2]
        drawn = {n: v for n, v in truths[0].items() if n.endswith("compliance")}
        # None below zero; none at zero but what turns about an axis that no load is off.
        assert min(drawn.values()) > 1e-8, drawn


def test_a_file_that_is_there_is_kept_unless_forced(arms):
    Path("cell.toml").write_text("mine")
    code, _, err = run("init", "arms/arm.csv")
    assert code == 2 and "give --force" in err and Path("cell.toml").read_text() == "mine"
    assert run("init", "arms/arm.csv", "--force")[0] == 0
