"""What docs/importing.md shows is what the tool accepts and prints."""

import re
from pathlib import Path

from support.tracker_exports import kr270_readings, krl, spatialanalyzer
from typer.testing import CliRunner

from elastocal.cli.main import app
from elastocal.importing.mapping_file import read_mapping, wanted

PAGE = (Path(__file__).parents[2] / "docs" / "importing.md").read_text(encoding="utf-8")


def test_the_mapping_shown_is_a_mapping(tmp_path):
    (text,) = re.findall(r"```toml mapping\n(.*?)```", PAGE, re.S)
    path = tmp_path / "mapping.toml"
    path.write_text(text, encoding="utf-8")
    mapping = read_mapping(path)
    assert [source.role for source in mapping.sources] == ["points", "points", "joints"]
    for source in mapping.sources:
        assert wanted("doc", source.columns or {}, source.optional or {})


def test_the_preview_shown_is_what_is_printed(tmp_path, monkeypatch):
    (block,) = re.findall(r"```console\n\$ (elastocal import points.*?)```", PAGE, re.S)
    command, _, shown = block.replace("\\\n", " ").partition("\n")
    _, degrees, points = kr270_readings(tmp_path)
    (tmp_path / "points.txt").write_text(spatialanalyzer(points), encoding="utf-8")
    (tmp_path / "poses.dat").write_text(krl(degrees), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    result = CliRunner().invoke(app, command.split()[1:], catch_exceptions=False)
    assert result.exit_code == 0
    printed = [" ".join(line.split()) for line in result.stdout.splitlines()]
    for line in (" ".join(line.split()) for line in shown.splitlines()):
        if line and line != "..." and not line.startswith("Nominal arm"):
            assert line in printed
