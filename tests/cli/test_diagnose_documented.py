"""docs/diagnosing.md names every key of the JSON and every option of the command."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from support.cells import kr270_cell, kr270_chain
from support.diagnoses import ECCENTRICITY, EXTRA, UNKNOWN
from typer.testing import CliRunner

from elastocal.cli import app
from elastocal.diagnosis.published import publish
from elastocal.manipulator.model import Model

PAGE = (Path(__file__).parents[2] / "docs" / "diagnosing.md").read_text(encoding="utf-8")
NAMED = set(re.findall(r"`([^`]+)`", PAGE))


def test_every_key_of_the_json_is_explained():
    model = Model(kr270_chain(), kr270_cell(("base_frame",)))
    content = publish(replace(UNKNOWN, extra=EXTRA, effects=(ECCENTRICITY,)), model, "data.csv")
    inner = ("gap", "location", "noise", "extra_plan")
    lists = ("budget", "effects", "candidates", "structure", "curves", "untested")
    keys = set(content).union(*(content[k] for k in inner), *(content[k][0] for k in lists))
    assert keys - NAMED - {"evidence"} == set()


def test_every_option_is_explained():
    help_text = CliRunner().invoke(app, ["diagnose", "--help"]).stdout
    options = set(re.findall(r"(--[a-z-]+)", help_text)) - {"--help", "--output", "--quiet"}
    words = {word.rstrip(",") for name in NAMED for word in name.split()}
    assert options <= words
