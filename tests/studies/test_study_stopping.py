"""The first signal asks, the second or a time limit stops; what was done is kept."""

import sys

import pytest
from support.study_folders import on_processes, run_study, write_study

from elastocal.studies import StudyStop, read_results

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")

# Task 2 gets a signal, and another one a moment later; task 3 of that study is never begun.
SIGNALLED = """\
import signal
import time


def tasks(options):
    return [{"n": 4, "label": "", "replicate": k} for k in range(6)]


def run(task, rng):
    if task["replicate"] == 2:
        for _ in range(%(times)d):
            signal.raise_signal(signal.%(name)s)
            time.sleep(%(wait)s)
    return {"mean": rng.normal()}
"""
SWALLOWING = SIGNALLED.replace(
    "            signal.raise_signal(signal.%(name)s)",
    "            try:\n                signal.raise_signal(signal.%(name)s)\n"
    "            except KeyboardInterrupt:\n                pass",
)


def stopped(tmp_path, grace=60.0, script=SIGNALLED, times=1, name="SIGINT", wait=0.0):
    script = script % {"times": times, "name": name, "wait": wait}
    folder = write_study(tmp_path / "study", script)
    told = []
    with StudyStop(grace, told.append) as stop:
        runner = lambda study: on_processes(study, 1, stop)  # noqa: E731
        ending = run_study(folder, tmp_path / "r", runner, stop=stop)
    assert len(told) == 1 and told[0].startswith("stopping: the running tasks have")
    assert ending.stopped and not ending.complete
    return list(read_results(tmp_path / "r")["task"])


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_the_first_signal_lets_the_running_task_end(tmp_path, name):
    assert stopped(tmp_path, name=name) == [0, 1, 2]


def test_the_second_signal_drops_it(tmp_path):
    assert stopped(tmp_path, times=2) == [0, 1]


def test_a_task_that_swallows_the_second_signal_is_dropped(tmp_path):
    assert stopped(tmp_path, times=2, script=SWALLOWING) == [0, 1]


def test_a_task_that_takes_too_long_to_end_is_dropped(tmp_path):
    assert stopped(tmp_path, grace=0.1, wait=60) == [0, 1]
