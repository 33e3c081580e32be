"""identify: limits that a calibration must keep, with an exit code and a reason of their own."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from fuzz import campaign
from fuzz.campaign import COMMANDS
from typer.testing import CliRunner

from elastocal.cli.main import app


@pytest.fixture(scope="module")
def command(tmp_path_factory) -> tuple[Path, list[str]]:
    """A folder with a campaign, and how identify is called in it."""
    folder = tmp_path_factory.mktemp("accepted")
    campaign.write(folder)
    line = next(c.line for c in COMMANDS if c.verb == "identify")
    words = shlex.split(line)
    return folder, ["identify", *words]


def test_limits_of_the_cell(command, monkeypatch) -> None:
    folder, words = command
    monkeypatch.chdir(folder)
    cell = next(word for word in words if word.endswith(".toml"))
    strict = folder / "strict.toml"
    strict.write_text(
        (folder / cell).read_text(encoding="utf-8") + "\n[require]\nheldout_um = 0.001\n",
        encoding="utf-8",
    )
    words = [strict.name if word == cell else word for word in words]
    assert CliRunner().invoke(app, words).exit_code == 3
    assert CliRunner().invoke(app, [*words, "--require", "heldout=1e6"]).exit_code == 0
