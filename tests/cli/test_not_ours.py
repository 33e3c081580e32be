"""Nothing of the user's is deleted or written over unasked, whatever its name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.design_commands import DEFLECTION, altered, design, elastocal, write_cell
from support.study_folders import SCRIPT, write_study

SUMMARY = '\n\ndef summary(frame):\n    return f"{len(frame)} rows"\n'
MINE = "of years of work\n"


def mine(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(MINE, encoding="utf-8")
    return path


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    return write_cell(tmp_path, altered(DEFLECTION, poses="2", candidates="20"))


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("plan.csv.resume", "plan.csv.resume"), ("plan.csv.resume/notes.md", "plan.csv.resume"),
        ("plan.json", "plan.json: goes beside"),
    ],
)  # fmt: skip
def test_what_has_the_name_of_a_designs_own(cell: Path, name: str, told: str) -> None:
    own = mine(cell.parent / name)
    done = design(cell)
    assert done.exit_code == 2 and told in done.stderr
    assert own.read_text() == MINE and not (cell.parent / "plan.csv").exists()


def test_a_summary_of_a_plan_is_replaced_and_other_json_not(cell: Path) -> None:
    own = cell.parent / "plan.json"
    own.write_text('{"schema": "mine/1"}')
    assert design(cell).exit_code == 2 and own.read_text() == '{"schema": "mine/1"}'
    own.unlink()
    assert design(cell).exit_code == 0
    assert design(cell, "--seed", 1).exit_code == 0
    assert json.loads(own.read_text())["seed"] == 1


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_study(tmp_path / "study", SCRIPT + SUMMARY)


@pytest.mark.parametrize("name", ["results.jsonl", "_failures.log", "_study.json", "result.md"])
@pytest.mark.parametrize("more", [(), ("--restart",)])
def test_a_folder_that_no_study_made(folder: Path, name: str, more: tuple[str, ...]) -> None:
    own = mine(folder / "results" / name)
    done = elastocal("study", folder, "--jobs", 1, *more)
    assert done.exit_code == 2 and f"holds {name}" in done.stderr
    assert own.read_text() == MINE


def test_restart_removes_what_the_study_wrote_alone(folder: Path) -> None:
    assert elastocal("study", folder, "--jobs", 1).exit_code == 0
    lock, own = (mine(folder / "results" / name) for name in (".lock", "mine.jsonl"))
    done = elastocal("study", folder, "--jobs", 1, "--restart")
    assert done.exit_code == 2 and own.name in done.stderr
    assert own.read_text() == MINE == lock.read_text()
    own.unlink()
    assert elastocal("study", folder, "--jobs", 1, "--restart").exit_code == 0


@pytest.mark.parametrize("name", ["cell.toml", "result.json"])
def test_the_demo_writes_over_nobodys_files(tmp_path: Path, name: str) -> None:
    own = mine(tmp_path / name)
    done = elastocal("demo", "-o", tmp_path, "-q")
    assert done.exit_code == 2 and f"{own} is not the demo's" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == [name] and own.read_text() == MINE


def test_the_demo_may_be_made_again_and_says_the_same(tmp_path: Path, monkeypatch) -> None:
    # A report takes as long as all else.
    monkeypatch.setattr("elastocal.report.renderers.write_page", lambda *found, **more: None)
    folder, written = tmp_path / "new" / "demo", []
    for _ in range(2):
        assert elastocal("demo", "-o", folder, "-q").exit_code == 0
        written.append((folder / "result.json").read_text())
    assert written[0] == written[1]
    mine(folder / "cell.toml")
    done = elastocal("demo", "-o", folder, "-q")
    assert done.exit_code == 2 and (folder / "cell.toml").read_text() == MINE
