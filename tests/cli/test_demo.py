"""The demo ends well, again too, and never writes over somebody's own campaign."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from elastocal.cli.main import app


def demo(folder: Path):
    return CliRunner().invoke(app, ["demo", "-o", str(folder), "-q"], catch_exceptions=False)


def test_the_demo_may_be_made_again_and_says_the_same(tmp_path: Path, monkeypatch) -> None:
    # A report takes as long as all else.
    monkeypatch.setattr("elastocal.report.renderers.write_page", lambda *found, **more: None)
    first = demo(tmp_path / "new" / "demo")
    assert first.exit_code == 0, first.stderr
    written = (tmp_path / "new" / "demo" / "result.json").read_text()
    assert json.loads(written)["schema"] == "elastocal/identification/1"
    assert demo(tmp_path / "new" / "demo").exit_code == 0
    assert (tmp_path / "new" / "demo" / "result.json").read_text() == written


@pytest.mark.parametrize("name", ["cell.toml", "data.csv", "plan.csv", "result.json"])
def test_somebodys_own_files_stay(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    outcome = demo(tmp_path)
    assert outcome.exit_code == 2
    assert f"{tmp_path / name} is not the demo's" in outcome.stderr
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"
