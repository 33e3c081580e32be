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


def test_a_file_that_is_there_is_kept_unless_forced(arms):
    Path("cell.toml").write_text("mine")
    code, _, err = run("init", "arms/arm.csv")
    assert code == 2 and "give --force" in err and Path("cell.toml").read_text() == "mine"
    assert run("init", "arms/arm.csv", "--force")[0] == 0
