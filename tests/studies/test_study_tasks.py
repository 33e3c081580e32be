"""What travels to a worker and what is wrong with it; tasks that fail, kill or are stopped."""

import sys
from dataclasses import replace
from functools import partial

import pytest
from support.study_folders import SCRIPT, TOML, numbers, on_processes, run_study, write_study

from elastocal.messages import InputError
from elastocal.studies import StudyStop, execute, read_results, read_study

posix = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")

RAISING = SCRIPT.replace(
    "    x = rng",
    '    if task["replicate"] == 2:\n        raise BaseException("two\\udcff")\n    x = rng',
)
LETHAL = """\
import os, signal, time
from pathlib import Path

HERE = Path("{marks}")


def tasks(options, task={{}}):  # the same one again and again
    return (task.update(k=k) or task for k in range(8))


def run(task, rng):
    mark = HERE / f"{{task['k']}}_{{os.urandom(4).hex()}}"
    mark.touch()
    time.sleep(0.1 if task["k"] == 3 else 0.3)  # somebody is always out beside the one that kills
    if task["k"] == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return {{"mean": rng.random()}}
"""


def failures(results):
    frame = read_results(results, failed=True)
    return dict(zip(frame["task"], frame["task_error"], strict=True))


def test_one_that_raises_is_recorded_with_its_traceback_until_it_is_retried(tmp_path):
    script = RAISING.replace('["replicate"] == 2', '["replicate"] == 2 and not FLAG.exists()')
    script = f'from pathlib import Path\nFLAG = Path("{tmp_path}") / "mended"\n{script}'
    folder, results = write_study(tmp_path / "study", script), tmp_path / "r"
    ending = run_study(folder, results, lambda study: on_processes(study, 2))
    assert (ending.done, ending.failed, ending.complete) == (10, 2, True)
    assert failures(results) == dict.fromkeys((2, 8), r"BaseException: two\udcff")  # half a letter
    assert not list(folder.glob("__pycache__"))  # nothing is left in it
    log = (results / "_failures.log").read_text("utf-8")
    assert log.count('raise BaseException("two') == 2
    assert 'task 8 {"n": 16, "label": "many", "replicate": 2}' in log
    assert set(numbers(results)["task"]) == set(range(12)) - {2, 8}
    again = run_study(folder, results)
    assert (again.before, again.failed) == (12, 2)
    (tmp_path / "mended").touch()
    write_study(folder, script + "# corrected")
    with pytest.raises(InputError, match=r"study\.py changed.*retry_failed=True"):
        run_study(folder, results)
    retried = run_study(folder, results, retry_failed=True)
    assert (retried.before, retried.done, retried.failed) == (10, 12, 0)
    assert run_study(folder, results).before == 12
    assert not failures(results) and len(numbers(results)) == 24
    for wrong in ({"jobs": 0}, {"only": -1}, {"seed": -1}, {"progress": 3}):
        with pytest.raises(InputError, match=rf"^`{next(iter(wrong))}` takes"):
            run_study(folder, results, **wrong)


@pytest.mark.parametrize(
    ("returned", "told"),
    [
        ("None", "run() returned NoneType; it returns a dict or a list of them"),
        ("{'maen': 1.0}", "did you mean 'mean'"),
        ("{'mean': 'high'}", "column 'mean' takes a number; found str"),
        ("{'above': 1.5}", "column 'above' takes a whole number; found float"),
        ("{'inside': 1}", "column 'inside' takes true or false; found int"),
    ],
)
def test_what_run_returns_is_checked(tmp_path, returned, told):
    script = SCRIPT[: SCRIPT.index('    return [{"mean"')] + f"    return {returned}\n"
    folder = write_study(tmp_path / "study", script)
    assert run_study(folder, tmp_path / "r", only=1).failed == 1
    assert told in failures(tmp_path / "r")[0]


def test_one_that_kills_its_process_is_tried_three_times(tmp_path):
    marks = tmp_path / "marks"
    marks.mkdir()
    folder = write_study(tmp_path / "study", LETHAL.format(marks=marks))
    ending = run_study(folder, tmp_path / "r", partial(on_processes, workers=2))
    assert (ending.done, ending.failed) == (7, 1)
    assert sorted(read_results(tmp_path / "r")["task"]) == [0, 1, 2, 4, 5, 6, 7]
    assert len(list(marks.glob("3_*"))) == 3
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


def test_a_worker_without_the_folder_unpacks_it(with_parts, tmp_path, monkeypatch):
    study = read_study(with_parts)
    monkeypatch.setattr("elastocal.studies._here", ("", with_parts.resolve()))
    elsewhere = replace(study.sources, folder=tmp_path / "not here")
    assert execute(elsewhere, study.tasks[0])["rows"][0]["mean"] == 42
    module = sys.modules["study_part_of_test"]
    assert not module.__file__.startswith(str(with_parts))


def test_a_worker_of_another_version_refuses(with_parts):
    study = read_study(with_parts)
    found = execute(replace(study.sources, version="0.0.1"), study.tasks[0])
    assert "this worker has elastocal" in found["task_error"]


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("seed = 11", "seed = -1", r"study\.toml: key seed takes a whole number"),
        ("seed = 11", "seed = 1\nfiles = ['../x']", r"study\.toml.*outside the folder"),
        ("seed = 11", "seed = 1\nfiles = ['x.csv']", "'x.csv', which is no file of the folder"),
        ("def run", "def run(:", r"study\.py, line 6: .*SyntaxError"),
        ("def tasks", "import nothing_of_this\ndef tasks", "line 1: .*ModuleNotFoundError"),
        ("    return [{", "    1 / 0\n    return [{", r"line 2: .*tasks\(\) raised ZeroDivision"),
        ('return [{"n"', 'return [{"task_row"', "'task_row' cannot be a key"),
        ('{"n": n,', '{"n": {n},', "task 0: Object of type set"),
        ('replicates"])]', 'replicates"] * 0)]', r"tasks\(\) gives no task"),
        ("return [", "return ({} for _ in iter(int, 1))\n    [", "more than 200000 tasks"),
    ],
)
def test_a_wrong_study_is_told_by_its_key_or_line(tmp_path, old, new, told):
    script, toml = (text.replace(old, new, 1) for text in (SCRIPT, TOML))
    with pytest.raises(InputError, match=told):
        read_study(write_study(tmp_path / "study", script, toml))


# Task 2 gets a signal and goes on; task 3 of that study is never begun.
SIGNALLED = """\
import signal
import time


def tasks(options):
    return [{"n": 4, "label": "", "replicate": k} for k in range(6)]


def run(task, rng):
    if task["replicate"] == 2:
        signal.raise_signal(signal.SIGINT)
        time.sleep(60)
    return {"mean": rng.normal()}
"""


@posix
def test_a_task_that_does_not_end_when_it_is_told_to_is_dropped(tmp_path):
    folder, told = write_study(tmp_path / "study", SIGNALLED), []
    with StudyStop(0.1, told.append) as stop:
        alone = partial(on_processes, workers=1, stop=stop)
        ending = run_study(folder, tmp_path / "r", alone, stop=stop)
    assert len(told) == 1 and told[0].startswith("stopping: the running tasks have")
    assert ending.stopped and not ending.complete
    assert list(read_results(tmp_path / "r")["task"]) == [0, 1]
