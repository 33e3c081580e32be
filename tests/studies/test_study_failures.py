"""A task that raises, returns something wrong or kills its process fails alone, and is told."""

import pytest
from support.study_folders import SCRIPT, TOML, numbers, on_processes, run_study, write_study

from elastocal.studies import read_results

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
