"""What commands say: of any length of name in a file, of what has no end, of whose fault it is."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.files import write_campaign
from support.registered import forgotten
from typer.testing import CliRunner, Result

from elastocal.cli.main import app
from elastocal.errors import InputError


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.mark.parametrize("key", ["a" * 20_000, "a b " * 5_000, "'" + "é" * 20_000 + "'"])
def test_a_message_has_an_end(key: str, tmp_path: Path) -> None:
    cell = tmp_path / "cell.toml"
    name = key if key.isalnum() else f'"{key}"'
    cell.write_text(f"[robot]\n{name} = 1\n", encoding="utf-8")
    done = run("effects", cell)
    assert done.exit_code == 2 and len(done.stderr) < 4000 and "cell.toml" in done.stderr
    assert len(str(InputError(key))) < 9000


def test_a_first_cell_that_cannot_be_read_is_not_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from elastocal.importing import first_cell

    write_campaign(tmp_path)
    monkeypatch.setattr(first_cell, "first_cell", lambda *given: "[robot]\nnothing = 1\n")
    done = run("init", tmp_path / "arm.urdf", "-o", tmp_path / "first.toml")
    assert done.exit_code == 2 and "arm.urdf" in done.stderr
    assert not (tmp_path / "first.toml").exists()


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
        ("mine.py", MINE.replace("p['b']", "'b'"), r"mine\.py.*'mine': \w+Error"),
        ("mine.py", MINE.replace("[ParameterSpec('a', 'rad', 0, 1e-5)]", "1"),
         r"mine\.py.*'mine': TypeError"),
        ("mine.py", NOISE, r"mine\.py, line 4: 'mine': AttributeError"),
    ],
)  # fmt: skip
def test_a_plug_in_that_fails_at_work_is_to_blame_itself(
    module: str, code: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_campaign(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / f"{module.removesuffix('.py')}.py").write_text(code)
    cell = tmp_path / "cell.toml"
    effects = '"joint_offset", "mine"' if "DrivenEffect" in code else '"joint_offset"'
    text = cell.read_text().replace('"joint_offset"', effects)
    cell.write_text(f'{text}\n[plugins]\nmodules = ["{module}"]\n')
    # Ctrl-C in an earlier command of this process is not one here.
    monkeypatch.setattr("elastocal.cli.app.interrupts", [2])
    with forgotten():
        done = run("identify", cell, tmp_path / "data.csv", "--plugins", "-q")
    assert done.exit_code == 2 and re.search(told, done.stderr), done.stderr
    assert "data.csv" not in done.stderr
