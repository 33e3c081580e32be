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


@pytest.mark.parametrize("name", ["plan.csv.resume", "plan.csv.resume/notes.md"])
def test_what_has_the_name_of_a_designs_own(cell: Path, name: str) -> None:
    own = mine(cell.parent / name)
    done = design(cell)
    assert done.exit_code == 2 and "plan.csv.resume" in done.stderr
    assert own.read_text() == MINE and not (cell.parent / "plan.csv").exists()


@pytest.mark.parametrize("text", [MINE, "[]", '{"schema": "mine/1"}'])
def test_a_file_where_the_summary_of_a_plan_goes(cell: Path, text: str) -> None:
    own = cell.parent / "plan.json"
    own.write_text(text)
    done = design(cell)
    assert done.exit_code == 2 and f"{own}: goes beside" in done.stderr
    assert own.read_text() == text and not (cell.parent / "plan.csv").exists()


def test_a_summary_of_a_plan_is_replaced(cell: Path) -> None:
    assert design(cell).exit_code == 0
    assert design(cell, "--seed", 1).exit_code == 0
    assert json.loads((cell.parent / "plan.json").read_text())["seed"] == 1


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


@pytest.mark.parametrize("name", ["mine.jsonl", "part-000009.parquet"])
def test_restart_removes_what_the_study_wrote_alone(folder: Path, name: str) -> None:
    assert elastocal("study", folder, "--jobs", 1).exit_code == 0
    lock = mine(folder / "results" / ".lock")
    own = mine(folder / "results" / name)
    done = elastocal("study", folder, "--jobs", 1, "--restart")
    assert done.exit_code == 2 and name in done.stderr
    assert own.read_text() == MINE == lock.read_text()
    own.unlink()
    assert elastocal("study", folder, "--jobs", 1, "--restart").exit_code == 0


def test_an_example_that_was_changed_is_not_made_anew(tmp_path: Path) -> None:
    from elastocal.demo.example import _copy_example

    cell, _ = _copy_example(tmp_path)
    mine(cell)
    done = elastocal("demo", "-o", tmp_path, "-q")
    assert done.exit_code == 2 and str(cell) in done.stderr and cell.read_text() == MINE
