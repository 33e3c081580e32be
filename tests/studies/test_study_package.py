"""What travels to a worker, and what a worker imports."""

import sys

import pytest
from support.study_folders import SCRIPT, TOML, write_study

from elastocal.errors import InputError
from elastocal.studies import Sources, execute, read_study

WITH_PARTS = """\
from pathlib import Path

import study_part_of_test


def tasks(options):
    return [{"k": 0}]


def run(task, rng):
    text = (Path(__file__).parent / "data" / "number.txt").read_text()
    return {"mean": study_part_of_test.FACTOR * float(text)}
"""


@pytest.fixture
def folder(tmp_path):
    toml = TOML.replace("seed = 11", 'seed = 11\nfiles = ["data/number.txt"]')
    folder = write_study(tmp_path / "study", WITH_PARTS, toml)
    (folder / "study_part_of_test.py").write_text("FACTOR = 2\n")
    (folder / "data").mkdir()
    (folder / "data" / "number.txt").write_text("21")
    return folder


def result_of(study, sources=None):
    return execute(sources or study.sources, study.tasks[0])


def test_a_worker_without_the_folder_unpacks_it(folder, tmp_path, monkeypatch):
    study = read_study(folder)
    monkeypatch.setattr("elastocal.studies._here", ("", folder.resolve(), None))
    elsewhere = Sources(tmp_path / "not here", study.sources.contents, study.sources.columns)
    assert result_of(study, elsewhere)["rows"][0]["mean"] == 42
    module = sys.modules["study_part_of_test"]
    assert not module.__file__.startswith(str(folder))


def test_a_worker_of_another_version_refuses(folder):
    study = read_study(folder)
    sources = Sources(folder, study.sources.contents, study.sources.columns, version="0.0.1")
    assert "this worker has elastocal" in result_of(study, sources)["task_error"]


def refused(folder, *options):
    with pytest.raises(InputError) as error:
        read_study(folder, None, options)
    return str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("seed = 11", "sead = 11", "unknown key sead; did you mean seed?"),
        ("seed = 11", "", "key seed is missing; it takes a whole number"),
        ("seed = 11", "seed = -1", "key seed takes a whole number"),
        ("seed = 11", "seed = ", "not valid TOML"),
        ("seed = 11", "seed = 1\nfiles = ['../x']", "outside the folder"),
        ("seed = 11", "seed = 1\nfiles = ['x.csv']", "'x.csv', which is no file of the folder"),
        ('mean = "mm"', "mean = 3", "key columns.mean takes the unit"),
        ("[columns]", "[colums]", "unknown key colums; did you mean columns?"),
    ],
)
def test_a_wrong_study_file_is_told_by_its_key(tmp_path, old, new, told):
    folder = write_study(tmp_path / "study", SCRIPT, TOML.replace(old, new))
    message = refused(folder)
    assert str(folder / "study.toml") in message and told in message


@pytest.mark.parametrize(
    ("old", "new", "line", "told"),
    [
        ("def run", "def run(:", 6, "SyntaxError"),
        ("def tasks", "import nothing_of_this_name\ndef tasks", 1, "ModuleNotFoundError"),
        ("    return [{", "    1 / 0\n    return [{", 2, "tasks() raised ZeroDivisionError"),
    ],
)
def test_an_error_in_study_py_is_told_by_its_line(tmp_path, old, new, line, told):
    folder = write_study(tmp_path / "study", SCRIPT.replace(old, new, 1))
    message = refused(folder)
    assert f"study.py, line {line}: " in message and told in message


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("def run", "def ran", "defines no function run()"),
        ('return [{"n"', 'return [{"task_row"', "'task_row' cannot be a key"),
        ('{"n": n,', '{"n": {n},', "task 0: Object of type set"),
        ('{"n": n,', '{"n": float("nan"),', "task 0: Out of range float"),
        ('replicates"])]', 'replicates"] * 0)]', "tasks() gives no task"),
        ("return [", "return ({} for _ in iter(int, 1))\n    [", "more than 200000 tasks"),
    ],
)
def test_wrong_tasks_are_told(tmp_path, old, new, told):
    assert told in refused(write_study(tmp_path / "study", SCRIPT.replace(old, new, 1)))
