"""What travels to a worker and what is wrong with it; tasks that fail, kill or are stopped."""

import sys

import pytest
from support.study_folders import SCRIPT, TOML, numbers, on_processes, run_study, write_study

from elastocal.errors import InputError
from elastocal.studies import Sources, StudyStop, execute, read_results, read_study

posix = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")

RAISING = SCRIPT.replace(
    "    x = rng",
    '    if task["replicate"] == 2:\n        raise ArithmeticError("two")\n    x = rng',
)
LETHAL = """\
import os, signal, time
from pathlib import Path

HERE = Path("{marks}")


def tasks(options):
    return [{{"k": k}} for k in range(8)]


def run(task, rng):
    mark = HERE / f"{{task['k']}}_{{os.urandom(4).hex()}}"
    mark.touch()
    time.sleep(0.1 if task["k"] == 3 else 0.3)  # somebody is always out beside the one that kills
    if task["k"] == 3 and len(list(HERE.glob("3_*"))) <= {deaths}:
        os.kill(os.getpid(), signal.SIGKILL)
    return {{"mean": rng.random()}}
"""


def failures(results):
    frame = read_results(results, failed=True)
    return dict(zip(frame["task"], frame["task_error"], strict=True))


def test_one_that_raises_is_recorded_with_its_traceback_and_the_others_go_on(tmp_path):
    folder = write_study(tmp_path / "study", RAISING)
    ending = run_study(folder, tmp_path / "r", lambda study: on_processes(study, 2))
    assert (ending.done, ending.failed, ending.complete) == (10, 2, True)
    assert failures(tmp_path / "r") == {2: "ArithmeticError: two", 8: "ArithmeticError: two"}
    log = (tmp_path / "r" / "_failures.log").read_text("utf-8")
    assert log.count('raise ArithmeticError("two")') == 2
    assert 'task 8 {"n": 16, "label": "many", "replicate": 2}' in log
    assert set(numbers(tmp_path / "r")["task"]) == set(range(12)) - {2, 8}


def test_failed_ones_stay_failed_until_they_are_retried(tmp_path):
    script = RAISING.replace('["replicate"] == 2', '["replicate"] == 2 and not FLAG.exists()')
    script = f'from pathlib import Path\nFLAG = Path("{tmp_path}") / "mended"\n{script}'
    folder = write_study(tmp_path / "study", script)
    run_study(folder, tmp_path / "r")
    (tmp_path / "mended").touch()
    again = run_study(folder, tmp_path / "r")
    assert (again.before, again.failed) == (12, 2)
    retried = run_study(folder, tmp_path / "r", retry_failed=True)
    assert (retried.before, retried.done, retried.failed) == (10, 12, 0)
    assert not failures(tmp_path / "r") and len(numbers(tmp_path / "r")) == 24


@pytest.mark.parametrize(
    ("returned", "told"),
    [
        ("None", "run() returned NoneType; it returns a dict or a list of them"),
        ("{'maen': 1.0}", "did you mean 'mean'"),
        ("{'n': 1.0}", "'n', which is a value of the task itself"),
        ("{'mean': 'high'}", "column 'mean' takes a number; found str"),
        ("{'mean': x}", "column 'mean' takes a number; found ndarray"),
        ("{'above': 1.5}", "column 'above' takes a whole number; found float"),
        ("{'inside': 1}", "column 'inside' takes true or false; found int"),
        ("exit(3)", "SystemExit: 3"),
    ],
)
def test_what_run_returns_is_checked(tmp_path, returned, told):
    script = SCRIPT[: SCRIPT.index('    return [{"mean"')] + f"    return {returned}\n"
    folder = write_study(tmp_path / "study", script)
    assert run_study(folder, tmp_path / "r", only=1).failed == 1
    assert told in failures(tmp_path / "r")[0]


@pytest.mark.parametrize(
    ("deaths", "failed"), [pytest.param(1, 0, marks=pytest.mark.long), (10**6, 1)]
)
def test_one_that_kills_its_process_is_tried_three_times(tmp_path, deaths, failed):
    marks = tmp_path / "marks"
    marks.mkdir()
    script = LETHAL.format(marks=marks, deaths=deaths)
    folder = write_study(tmp_path / "study", script, TOML)
    ending = run_study(folder, tmp_path / "r", lambda study: on_processes(study, 2))
    assert (ending.done, ending.failed) == (8 - failed, failed)
    assert sorted(read_results(tmp_path / "r")["task"]) == [
        k for k in range(8) if k != 3 or not failed
    ]
    assert len(list(marks.glob("3_*"))) == (3 if failed else 2)
    if failed:
        assert failures(tmp_path / "r")[3].startswith("its worker process died 3 times")


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
def with_parts(tmp_path):
    toml = TOML.replace("seed = 11", 'seed = 11\nfiles = ["data/number.txt"]')
    folder = write_study(tmp_path / "study", WITH_PARTS, toml)
    (folder / "study_part_of_test.py").write_text("FACTOR = 2\n")
    (folder / "data").mkdir()
    (folder / "data" / "number.txt").write_text("21")
    return folder


def result_of(study, sources=None):
    return execute(sources or study.sources, study.tasks[0])


def test_a_worker_without_the_folder_unpacks_it(with_parts, tmp_path, monkeypatch):
    study = read_study(with_parts)
    monkeypatch.setattr("elastocal.studies._here", ("", with_parts.resolve(), None))
    elsewhere = Sources(tmp_path / "not here", study.sources.contents, study.sources.columns)
    assert result_of(study, elsewhere)["rows"][0]["mean"] == 42
    module = sys.modules["study_part_of_test"]
    assert not module.__file__.startswith(str(with_parts))


def test_a_worker_of_another_version_refuses(with_parts):
    study = read_study(with_parts)
    sources = Sources(with_parts, study.sources.contents, study.sources.columns, version="0.0.1")
    assert "this worker has elastocal" in result_of(study, sources)["task_error"]


def refused(folder, *options):
    with pytest.raises(InputError) as error:
        read_study(folder, None, options)
    return str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("seed = 11", "seed = -1", "key seed takes a whole number"),
        ("seed = 11", "seed = 1\nfiles = ['../x']", "outside the folder"),
        ("seed = 11", "seed = 1\nfiles = ['x.csv']", "'x.csv', which is no file of the folder"),
        ('mean = "mm"', "mean = 3", "key columns.mean takes the unit"),
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


# Task 2 gets a signal, and another one a moment later; task 3 of that study is never begun.
SIGNALLED = """\
import signal
import time


def tasks(options):
    return [{"n": 4, "label": "", "replicate": k} for k in range(6)]


def run(task, rng):
    if task["replicate"] == 2:
        for _ in range(%(times)d):
            signal.raise_signal(signal.SIGINT)
            time.sleep(%(wait)s)
    return {"mean": rng.normal()}
"""
SWALLOWING = SIGNALLED.replace(
    "            signal.raise_signal(signal.SIGINT)",
    "            try:\n                signal.raise_signal(signal.SIGINT)\n"
    "            except KeyboardInterrupt:\n                pass",
)


def stopped(tmp_path, grace=60.0, script=SIGNALLED, times=1, wait=0.0):
    script = script % {"times": times, "wait": wait}
    folder = write_study(tmp_path / "study", script)
    told = []
    with StudyStop(grace, told.append) as stop:
        runner = lambda study: on_processes(study, 1, stop)  # noqa: E731
        ending = run_study(folder, tmp_path / "r", runner, stop=stop)
    assert len(told) == 1 and told[0].startswith("stopping: the running tasks have")
    assert ending.stopped and not ending.complete
    return list(read_results(tmp_path / "r")["task"])


@posix
def test_a_task_that_swallows_the_second_signal_is_dropped(tmp_path):
    assert stopped(tmp_path, times=2, script=SWALLOWING) == [0, 1]


@posix
def test_a_task_that_takes_too_long_to_end_is_dropped(tmp_path):
    assert stopped(tmp_path, grace=0.1, wait=60) == [0, 1]
