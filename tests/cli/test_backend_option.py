"""`elastocal --backend` reaches the model, and a wrong one is told before anything is read."""

from __future__ import annotations

import os

import pytest
from typer.testing import CliRunner

from elastocal.cli import app
from elastocal.manipulator.backend import VARIABLE, chosen_backend

ABSENT = ["identify", "no-cell.toml", "no-data.csv"]


@pytest.fixture(autouse=True)
def unset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "")


@pytest.mark.parametrize("name", ["numpy", "compiled", "auto"])
def test_the_option_is_what_tapes_will_use(name: str) -> None:
    CliRunner().invoke(app, ["--backend", name, *ABSENT])
    assert os.environ[VARIABLE] == name
    assert chosen_backend() == name


def test_an_unknown_backend_is_told_with_the_known_ones() -> None:
    found = CliRunner().invoke(app, ["--backend", "compild", *ABSENT])
    assert found.exit_code == 2
    assert "compild" in found.output and "compiled" in found.output
    assert "no-cell.toml" not in found.output


def test_the_environment_is_checked_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "gpu")
    found = CliRunner().invoke(app, ABSENT)
    assert found.exit_code == 2
    assert VARIABLE in found.output and "gpu" in found.output
