"""What commands say: of any length of name in a file, of what has no end, of whose fault it is."""

from __future__ import annotations

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


def test_a_plug_in_that_fails_at_work_is_to_blame_itself(tmp_path: Path) -> None:
    write_campaign(tmp_path)
    (tmp_path / "mine.py").write_text(
        "from elastocal.plugins import *\n"
        "class Mine(DrivenEffect):\n"
        "  name, stage, entry = 'mine', 'transmission', JointMotion()\n"
        "  def places(self, chain, cell): return turning_joints(chain)\n"
        "  def parameters(self, place, chain, cell): return [ParameterSpec('a', 'rad', 0, 1e-5)]\n"
        "  def drive(self, arm, place, p): return p['b']\n"
        "register_effect(Mine())\n"
    )
    cell = tmp_path / "cell.toml"
    text = cell.read_text().replace('"joint_offset"', '"joint_offset", "mine"')
    cell.write_text(f'{text}\n[plugins]\nmodules = ["mine.py"]\n')
    with forgotten():
        done = run("identify", cell, tmp_path / "data.csv", "--plugins", "-q")
    assert done.exit_code == 2 and "mine.py, line 6: KeyError" in done.stderr
    assert "data.csv" not in done.stderr
