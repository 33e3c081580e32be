"""What every verb owes: options that are checked, messages that blame right."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest
from fuzz.campaign import write
from support.design_commands import elastocal as run
from support.registered import forgotten
from support.tracker_exports import kr270_readings, krl, spatialanalyzer

from elastocal.model.evaluate import VARIABLE, chosen_backend


def test_the_backend_is_what_models_use_and_what_results_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, "")
    done = run("--backend", "nunpy", "identify", "no-cell.toml", "no-data.csv")
    assert done.exit_code == 2 and "no-cell.toml" not in done.output
    assert "--backend: unknown backend 'nunpy' (did you mean 'numpy'" in done.output
    run("--backend", "auto", "identify", "no-cell.toml", "no-data.csv")
    assert os.environ[VARIABLE] == chosen_backend() == "auto"
    write(tmp_path)
    cell, data = tmp_path / "placed.toml", tmp_path / "placed.csv"
    files = [tmp_path / "result.json", tmp_path / "report.html"]
    done = run("--backend", "numpy", "identify", cell, data, "-o", files[0], "--report", files[1])
    assert done.exit_code == 0, done.output
    backend = json.loads(files[0].read_text())["backend"]
    assert backend.startswith("numpy (") and "thread" in backend
    assert backend in files[1].read_text("utf-8")


@pytest.mark.parametrize(
    "words",
    [
        "identify data.csv cell.toml", "diagnose data.parquet cell.toml", "design plan.csv -o p",
        "simulate plan.csv cell.toml -o d.csv -q", "next data.csv cell.toml -o n.csv",
        "compensate result.json cell.toml --target 1,2,3", "export result.json cell.toml -o a.urdf",
        "compare old.json new.json cell.toml", "effects data.csv",
    ],
)  # fmt: skip
def test_a_cell_file_in_anothers_place_is_told_so(words: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = words.split()[1]
    for name in ("data.csv", "cell.toml", "plan.csv", "data.parquet", "result.json", "new.json"):
        (tmp_path / name).write_text("x,y\n1,2\n")
    done = run(*words.split())
    ending = first[first.rindex(".") :]
    assert done.exit_code == 2 and not done.stdout
    assert f"elastocal: {first}: ends in {ending}, where the cell file" in done.stderr
    assert "the cell file (.toml) comes first" in " ".join(done.stderr.split())


def test_a_first_cell_that_cannot_be_read_is_not_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from elastocal.importing import first_cell

    write(tmp_path)
    monkeypatch.setattr(first_cell, "first_cell", lambda *given: "[robot]\nnothing = 1\n")
    done = run("init", tmp_path / "arm.urdf", "-o", tmp_path / "first.toml")
    assert done.exit_code == 2 and "arm.urdf" in done.stderr
    assert not (tmp_path / "first.toml").exists()


def test_what_the_robot_cannot_have_measured_is_shown_and_not_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, degrees, points = kr270_readings(tmp_path)
    monkeypatch.chdir(tmp_path)
    Path("points.txt").write_text(spatialanalyzer(points), encoding="utf-8")
    Path("poses.dat").write_text(krl(degrees), encoding="utf-8")
    Path("map.toml").write_text("[joints]\noffset_deg = [0, 300, 0, 0, 0, 0]\n")
    presets = ("--preset", "spatialanalyzer", "--preset", "kuka", "--map", "map.toml")
    done = run("import", "points.txt", "poses.dat", *presets, "--preview", "--cell", "cell.toml",
               "-o", "d.csv")  # fmt: skip
    assert done.exit_code == 2 and "joint2" in done.stderr and "beyond its limits" in done.stderr
    assert "offset_deg" in done.stderr and "Ranges" in done.stdout
    assert not Path("d.csv").exists()


MINE = """\
from elastocal.plugins import *
class Mine(DrivenEffect):
  name, stage, entry = 'mine', 'transmission', JointMotion()
  def places(self, chain, cell): return turning_joints(chain)
  def parameters(self, place, chain, cell): return [ParameterSpec('a', 'rad', 0, 1e-5)]
  def drive(self, arm, place, p): return p['b']
register_effect(Mine())
"""
NOISE = """\
from elastocal.plugins import *
class Mine(NoiseModel):
  name, description = 'mine', 'one variance'
  def supports(self, readings): return readings.nothing
  def components(self, readings): return {'all': 1.0}
register_noise_model(Mine())
"""


@pytest.mark.parametrize(
    ("module", "code", "told"),
    [
        ("mine.py", MINE, r"mine\.py, line 6: 'mine': KeyError: 'b'; correct the plug-in"),
        ("mine_by_name", MINE, r"mine_by_name\.py, line 6: 'mine': KeyError"),
        ("mine.py", MINE.replace("[ParameterSpec('a', 'rad', 0, 1e-5)]", "1"),
         r"mine\.py.*'mine': TypeError"),
        ("mine.py", NOISE, r"mine\.py, line 4: 'mine': AttributeError"),
    ],
)  # fmt: skip
def test_a_plug_in_that_fails_at_work_is_to_blame_itself(
    module: str, code: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path)
    cell, data = tmp_path / "placed.toml", tmp_path / "placed.csv"
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / f"{module.removesuffix('.py')}.py").write_text(code)
    effects = '"joint_offset", "mine"' if "DrivenEffect" in code else '"joint_offset"'
    text = cell.read_text().replace('"joint_offset"', effects)
    cell.write_text(f'{text}\n[plugins]\nmodules = ["{module}"]\n')
    # Ctrl-C in an earlier command of this process is not one here.
    monkeypatch.setattr("elastocal.cli.app.interrupts", [2])
    with forgotten():
        done = run("identify", cell, data, "--plugins", "-q")
    assert done.exit_code == 2 and re.search(told, done.stderr), done.stderr
    assert "placed.csv" not in done.stderr
