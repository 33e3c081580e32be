"""What every verb owes: its line in --help, inputs that are kept, options that are checked."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.exports import write_result
from support.files import write_campaign
from typer.testing import CliRunner

from elastocal.cli.app import VERBS
from elastocal.cli.main import app

SIMULATE = ("simulate", "cell.toml", "plan.csv", "-o", "out.csv")
IDENTIFY = ("identify", "cell.toml", "data.csv", "-q")
COMPENSATE = ("compensate", "cell.toml", "result.json", "--target", "500,0,800", "-q")
EXPORT = ("export", "cell.toml", "result.json", "-q", "-o", "out.urdf")
DESIGN = ("design", "cell.toml", "-o", "out.csv", "-q")
DIAGNOSE = ("diagnose", "cell.toml", "data.csv", "-q")


def run(*arguments: str):
    return CliRunner().invoke(app, list(arguments), catch_exceptions=False)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_campaign(tmp_path)
    write_result(tmp_path, 'urdf = "arm.urdf"')
    header, first, *_ = (tmp_path / "data.csv").read_text().splitlines()
    keep = [k for k, name in enumerate(header.split(",")) if name.startswith("q")]
    lines = [",".join(line.split(",")[k] for k in keep) for line in (header, first)]
    rows = (tmp_path / "data.csv").read_text().splitlines()
    marked = [f"marker,{rows[0]}", *(f"M1,{row}" for row in rows[1:])]
    (tmp_path / "data.csv").write_text("\n".join(marked) + "\n")
    (tmp_path / "plan.csv").write_text("\n".join(lines) + "\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_help_lists_every_verb_in_the_order_of_the_work_with_a_whole_sentence():
    shown = run("--help").stdout.partition("Commands:")[2].strip().splitlines()
    assert [line.split()[0] for line in shown] == list(VERBS)
    for line in shown:
        assert len(line.split()) > 3 and not line.endswith("..."), line


@pytest.mark.parametrize("verb", VERBS)
def test_no_help_text_shows_what_only_a_programmer_knows(verb: str) -> None:
    options = run(verb, "--help").stdout.partition("Options:")[2]
    assert "list[" not in options and "float,float" not in options
    assert all(line.split()[0].startswith("--frames") for line in options.splitlines()
               if " / " in line.partition("  ")[2])  # fmt: skip


@pytest.mark.parametrize(
    "verb",
    [
        (*SIMULATE[:-1], "plan.csv"),
        (*SIMULATE[:-1], "cell.toml"),
        (*SIMULATE[:-1], "arm.urdf"),
        (*SIMULATE, "--truth", "out.csv"),
        (*IDENTIFY, "-o", "data.csv"),
        (*IDENTIFY, "--report", "cell.toml"),
        (*IDENTIFY, "--residuals", "arm.urdf"),
        (*IDENTIFY, "-o", "out.json", "--report", "out.json"),
        (*COMPENSATE, "-o", "arm.urdf"),
        (*COMPENSATE, "-o", "result.json"),
        (*EXPORT[:-1], "arm.urdf"),
        ("import", "data.csv", "--preset", "leica", "--cell", "cell.toml", "-o", "arm.urdf"),
    ],
    ids=lambda verb: f"{verb[0]}-{verb[-1]}",
)
def test_no_verb_writes_over_its_inputs_or_two_outputs_into_one(
    folder: Path, verb: tuple[str, ...]
) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    outcome = run(*verb)
    assert outcome.exit_code == 2
    assert "written over" in outcome.stderr or "two outputs" in outcome.stderr
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
