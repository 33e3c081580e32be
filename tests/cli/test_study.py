"""elastocal study: the command, its messages and exit codes, Ctrl-C and SIGTERM."""

import builtins
import os
import re
import signal
import subprocess
import sys
import time

import pandas as pd
import pytest
from support.study_folders import SCRIPT, numbers, run_study, write_study
from typer.testing import CliRunner

from elastocal.cli.main import app
from elastocal.cli.using import Pace
from elastocal.studies import read_results

# A child may inherit that SIGINT is ignored; here it must not.
PROGRAM = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from elastocal.cli.main import main; main()"
)
SUMMARY = """

def summary(frame):
    sorted_too = list(frame.task.unique()) == sorted(frame.task)
    return f"\x1b[31mrows: {len(frame)}, tasks in order: {sorted_too}"
"""
# Tasks are slow where a test interrupts them, and not in the runs that go on.
SLOW = "import os, time\n" + SCRIPT.replace(
    "    x = rng", '    time.sleep(({sleep}) * ("SLOW" in os.environ))\n    x = rng'
)


def study(*arguments):
    return CliRunner().invoke(app, ["study", *map(str, arguments)])


@pytest.fixture
def folder(tmp_path):
    return write_study(tmp_path / "study")


def test_it_runs_once_and_then_finds_nothing_to_do(folder):
    first = study(folder, "--jobs", 1, "--progress")
    assert first.exit_code == 0, first.stderr
    assert first.stdout == f"12 of 12 tasks done; results in {folder / 'results'}\n"
    assert "… 12 of 12 tasks" in first.stderr and "per minute" in first.stderr
    second = study(folder, "--jobs", 1, "--no-progress")
    assert second.exit_code == 0 and "12 of 12 tasks done (12 were there)" in second.stdout
    assert second.stderr == "" == study(folder, "--jobs", 1, "--progress", "--quiet").stderr


def test_a_summary_is_written_once_all_is_there(tmp_path):
    script = SCRIPT + SUMMARY.replace("sorted(frame.task)", "sorted(set(frame.task))")
    folder = write_study(tmp_path / "study", script)
    study(folder, "--jobs", 1, "--only", 3)
    assert not (folder / "result.md").exists()
    told = study(folder, "--jobs", 1)
    page = "\\x1b[31mrows: 24, tasks in order: True\n"
    assert (folder / "result.md").read_text() == page
    assert told.stdout.endswith(page)
    study(folder, "--jobs", 1, "-o", tmp_path / "other")
    assert (tmp_path / "other" / "result.md").read_text() == page
    study(folder, "--jobs", 1, "-o", tmp_path / "other", "--restart", "--only", 3)
    assert not (tmp_path / "other" / "result.md").exists()  # it was of results discarded


def test_a_missing_extra_is_named(folder, monkeypatch):
    imported = builtins.__import__

    def without(name, *rest, **more):
        if name.partition(".")[0] == "distributed":
            raise ImportError(name)
        return imported(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    result = study(folder, "--cluster", "config")
    assert result.exit_code == 2 and "pip install 'elastocal[cluster]'" in result.stderr
    assert not list(folder.glob("results/*.jsonl"))


def begin(folder, *arguments, **how):
    command = [sys.executable, "-c", PROGRAM, "study", str(folder), "--no-progress", *arguments]
    return subprocess.Popen(
        command,
        env=os.environ | {"SLOW": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **how,
    )


def slow_study(tmp_path, sleep):
    """Tasks that last, and a folder in which each leaves a mark as it begins."""
    marks = tmp_path / "marks"
    marks.mkdir()
    script = SLOW.replace("{sleep}", str(sleep))
    script = script.replace(
        "    time.sleep",
        f'    open("{marks}/" + str(task["n"]) + "_" + str(task["replicate"]), "w").close()\n'
        "    time.sleep",
    )
    return write_study(tmp_path / "study", script), marks


def wait_for(marks, number, process):
    while len(os.listdir(marks)) < number:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.01)


posix = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")


@posix
@pytest.mark.parametrize(
    ("jobs", "number", "whole_group"),
    [("1", signal.SIGINT, False), ("2", signal.SIGINT, True), ("2", signal.SIGTERM, False)],
)
def test_an_interrupted_study_goes_on_and_ends_as_an_undisturbed_one(
    tmp_path, jobs, number, whole_group
):
    folder, marks = slow_study(tmp_path, 0.15)
    with begin(folder, "--jobs", jobs, start_new_session=True) as process:
        wait_for(marks, 4, process)
        if whole_group:  # as Ctrl-C in a terminal does
            os.killpg(process.pid, number)
        else:
            process.send_signal(number)
        out, told = process.communicate(timeout=60)
    assert process.returncode == 130, told
    assert "stopping: the running tasks have" in told and "Traceback" not in told
    assert "the same command goes on with the rest" in out
    kept = read_results(folder / "results")
    begun = len(os.listdir(marks))
    assert 4 <= begun < 12
    assert kept["task"].nunique() == begun  # what ran was waited for
    assert study(folder, "--jobs", "1").exit_code == 0
    run_study(folder, tmp_path / "undisturbed")
    pd.testing.assert_frame_equal(numbers(folder / "results"), numbers(tmp_path / "undisturbed"))


@posix
@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_second_interrupt_stops_at_once(tmp_path, jobs):
    folder, marks = slow_study(tmp_path, '0.01 if task["replicate"] < 2 else 600')
    with begin(folder, "--jobs", jobs) as process:
        wait_for(marks, 2 + int(jobs), process)
        for _ in range(2):
            process.send_signal(signal.SIGINT)
            time.sleep(0.3)
        out, told = process.communicate(timeout=30)
    assert process.returncode == 130 and "Traceback" not in told
    assert "2 of 12 tasks done;" in out
    assert set(read_results(folder / "results")["task"]) == {0, 1}


@posix
def test_a_killed_study_leaves_nothing_half_written(tmp_path):
    folder, marks = slow_study(tmp_path, 0.05)
    with begin(folder, "--jobs", "1") as process:
        wait_for(marks, 6, process)
        process.kill()
    assert study(folder, "--jobs", "1").exit_code == 0
    run_study(folder, tmp_path / "undisturbed")
    pd.testing.assert_frame_equal(numbers(folder / "results"), numbers(tmp_path / "undisturbed"))


@pytest.mark.long
@posix
def test_a_study_on_a_cluster_is_interrupted_and_goes_on(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    folder, marks = slow_study(tmp_path, 0.15)
    monkeypatch.setenv("SLOW", "1")  # the workers are this process's children
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
    ) as cluster:
        arguments = ("--cluster", cluster.scheduler_address)
        with begin(folder, *arguments) as process:
            wait_for(marks, 4, process)
            process.send_signal(signal.SIGINT)
            _, told = process.communicate(timeout=60)
        assert process.returncode == 130 and "Traceback" not in told
        assert read_results(folder / "results")["task"].nunique() == len(os.listdir(marks)) < 12
        assert study(folder, *arguments).exit_code == 0
    monkeypatch.delenv("SLOW")
    run_study(folder, tmp_path / "undisturbed")
    pd.testing.assert_frame_equal(numbers(folder / "results"), numbers(tmp_path / "undisturbed"))


def test_it_says_the_rate_and_the_time_left():
    told = []
    pace = Pace(told.append)
    pace.show(40, 10, 1)
    pace.show(40, 11, 2)
    assert told[0] == "10 of 40 tasks, 1 failed"
    assert re.fullmatch(r"11 of 40 tasks, \S+ per minute, [\d:]+ left, 2 failed", told[1])
