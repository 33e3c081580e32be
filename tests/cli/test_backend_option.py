"""`elastocal --backend` reaches the model, and a wrong one is told before anything is read."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from elastocal.cli.main import app
from elastocal.model.evaluate import VARIABLE, chosen_backend

ABSENT = ["identify", "no-cell.toml", "no-data.csv"]


@pytest.fixture(autouse=True)
def unset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "")


@pytest.mark.parametrize("name", ["numpy", "auto"])
def test_the_option_is_what_models_will_use(name: str) -> None:
    CliRunner().invoke(app, ["--backend", name, *ABSENT])
    assert os.environ[VARIABLE] == name
    assert chosen_backend() == name


def test_results_and_report_say_what_evaluated_the_model(tmp_path: Path) -> None:
    """The KR 270 of the demo, few readings: with numpy, whose choice the files then name."""
    runner, folder = CliRunner(), str(tmp_path / "demo")
    done = runner.invoke(app, ["--backend", "numpy", "demo", "-o", folder])
    assert done.exit_code == 0, done.output
    backend = json.loads(Path(folder, "result.json").read_text("utf-8"))["backend"]
    assert backend.startswith("numpy (") and "thread" in backend
    assert backend in Path(folder, "report.html").read_text("utf-8")


def test_an_unknown_backend_is_told_with_the_known_ones() -> None:
    found = CliRunner().invoke(app, ["--backend", "nunpy", *ABSENT])
    assert found.exit_code == 2
    assert "--backend: unknown backend 'nunpy' (did you mean 'numpy'" in found.output
    assert "no-cell.toml" not in found.output
