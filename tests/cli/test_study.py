"""elastocal study: the command, its messages and exit codes, Ctrl-C, SIGTERM and SIGKILL."""

import builtins
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import nullcontext

import pandas as pd
import pytest
from support.design_commands import PROGRAM, elastocal
from support.study_folders import SCRIPT, numbers, run_study, write_study

from elastocal.studies import read_results

SUMMARY = """

def summary(frame):
    in_order = list(frame.task.unique()) == sorted(set(frame.task))
    return f"\x1b[31mrows: {len(frame)}, tasks in order: {in_order}"
"""
# Each task leaves a mark as it begins, and is slow where a test interrupts it.
SLOW = "import os, time\n" + SCRIPT.replace(
    "    x = rng",
    """    open(f"MARKS/{task['n']}_{task['replicate']}", "w").close()
    time.sleep((SLEEP) * ("SLOW" in os.environ))
    x = rng""",
)
posix = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")


def study(*arguments):
    return elastocal("study", *arguments)


@pytest.fixture
def folder(tmp_path):
    return write_study(tmp_path / "study")


def test_it_runs_once_and_then_finds_nothing_to_do(folder):
    first = study(folder, "--jobs", 1, "--progress")
    assert first.exit_code == 0, first.stderr
    assert first.stdout == f"12 of 12 tasks done; results in {folder / 'results'}\n"
    assert re.search(r"… 12 of 12 tasks, \S+ per minute, [\d:]+ left", first.stderr)
    second = study(folder, "--jobs", 1, "--no-progress")
    assert second.exit_code == 0 and "12 of 12 tasks done (12 were there)" in second.stdout
    assert second.stderr == "" == study(folder, "--jobs", 1, "--progress", "--quiet").stderr


def test_a_summary_is_written_once_all_is_there(tmp_path):
    folder, other = write_study(tmp_path / "study", SCRIPT + SUMMARY), tmp_path / "other"
    study(folder, "--jobs", 1, "--only", 3)
    assert not (folder / "result.md").exists()
    told = study(folder, "--jobs", 1)
    page = "\\x1b[31mrows: 24, tasks in order: True\n"
    assert (folder / "result.md").read_text() == page and told.stdout.endswith(page)
    study(folder, "--jobs", 1, "-o", other)
    assert (other / "result.md").read_text() == page
    study(folder, "--jobs", 1, "-o", other, "--restart", "--only", 3)
    assert not (other / "result.md").exists()  # it was of results discarded


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


def slow_study(tmp_path, sleep):
    marks = tmp_path / "marks"
    marks.mkdir()
    script = SLOW.replace("MARKS", str(marks)).replace("SLEEP", sleep)
    return write_study(tmp_path / "study", script), marks


def begin(folder, marks, number, *words):
    """A study in a process of its own, of which so many tasks have begun."""
    command = [sys.executable, "-c", PROGRAM, "study", str(folder), "--no-progress", *words]
    process = subprocess.Popen(
        command, env=os.environ | {"SLOW": "1"}, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, start_new_session=True,
    )  # fmt: skip
    until = time.monotonic() + 300
    while len(os.listdir(marks)) < number:
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < until, "no task begins"
        time.sleep(0.01)
    return process


def local_cluster():
    distributed = pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    how = {"threads_per_worker": 1, "processes": True, "dashboard_address": ":0"}
    return distributed.LocalCluster(n_workers=2, **how)


@posix
@pytest.mark.parametrize(
    ("where", "number"),
    [("2", signal.SIGINT), ("1", signal.SIGTERM), ("1", signal.SIGKILL),
     pytest.param("cluster", signal.SIGINT, marks=pytest.mark.long)],
)  # fmt: skip
def test_an_interrupted_study_goes_on_and_ends_as_an_undisturbed_one(
    tmp_path, monkeypatch, where, number
):
    folder, marks = slow_study(tmp_path, "0.15")
    with monkeypatch.context() as patch:
        patch.setenv("SLOW", "1")  # workers of the cluster are this process's children
        with local_cluster() if where == "cluster" else nullcontext() as cluster:
            words = ("--cluster", cluster.scheduler_address) if cluster else ("--jobs", where)
            with begin(folder, marks, 4, *words) as process:
                if where == "2":  # as Ctrl-C in a terminal does
                    os.killpg(process.pid, number)
                else:
                    process.send_signal(number)
                out, told = process.communicate(timeout=60)
            begun = len(os.listdir(marks))
            assert 4 <= begun < 12
            if number != signal.SIGKILL:
                assert process.returncode == 130 and "Traceback" not in told, told
                assert "stopping: the running tasks have" in told
                assert "the same command goes on with the rest" in out
                # What ran was waited for.
                assert read_results(folder / "results")["task"].nunique() == begun
            assert study(folder, *words).exit_code == 0
    run_study(folder, tmp_path / "undisturbed")
    pd.testing.assert_frame_equal(numbers(folder / "results"), numbers(tmp_path / "undisturbed"))


@posix
def test_a_second_interrupt_stops_at_once(tmp_path):
    folder, marks = slow_study(tmp_path, '0.01 if task["replicate"] < 2 else 600')
    with begin(folder, marks, 4, "--jobs", "2") as process:
        for _ in range(2):
            process.send_signal(signal.SIGINT)
            time.sleep(0.3)
        out, told = process.communicate(timeout=30)
    assert process.returncode == 130 and "Traceback" not in told
    assert "2 of 12 tasks done;" in out
    assert set(read_results(folder / "results")["task"]) == {0, 1}
