"""The documentation names every key of the JSON and every option of the command."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from support.cells import kr270_cell, kr270_chain
from support.diagnoses import ECCENTRICITY, EXTRA, UNKNOWN
from typer.testing import CliRunner

from elastocal.cli.main import app
from elastocal.diagnosis.diagnosis import publish
from elastocal.model.manipulator import Model

DOCS = Path(__file__).parents[2] / "docs"


def named(page: str) -> set[str]:
    """What stands in backticks in a page's text."""
    text = re.sub(r"```.*?```", "", (DOCS / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    return set(re.findall(r"`([^`]+)`", text))


def test_every_key_of_the_json_is_explained():
    model = Model.assembled(kr270_chain(), kr270_cell(("base_frame",)))
    content = publish(replace(UNKNOWN, extra=EXTRA, effects=(ECCENTRICITY,)), model, "data.csv")
    inner = ("gap", "location", "noise", "extra_plan")
    lists = ("budget", "effects", "candidates", "structure", "curves", "untested")
    keys = set(content).union(*(content[k] for k in inner), *(content[k][0] for k in lists))
    assert keys - named("file-formats.md") - {"evidence"} == set()


def test_every_option_is_explained():
    help_text = CliRunner().invoke(app, ["diagnose", "--help"]).stdout
    options = set(re.findall(r"(--[a-z-]+)", help_text)) - {"--help", "--output", "--quiet"}
    words = {word.rstrip(",") for name in named("diagnosing.md") for word in name.split()}
    assert options <= words
