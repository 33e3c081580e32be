"""On a Dask cluster of two workers: the same numbers, whichever of them dies."""

import threading
import time

import pandas as pd
import pytest
from support.study_folders import numbers, run_study, write_study

from elastocal.messages import InputError
from elastocal.studies import (
    ClusterLostError,
    StudyStop,
    _security,
    connect,
    on_cluster,
    read_results,
)

dask = pytest.importorskip("dask", reason="needs the extra 'cluster'")
distributed = pytest.importorskip("distributed", reason="needs the extra 'cluster'")

# A task notes that it began; where told so, it kills its worker after that.
MARKED = """\
import os, signal, time
from pathlib import Path

HERE = Path("{marks}")
LETHAL = {lethal}


def tasks(options):
    return [{{"n": 4, "label": "marked", "replicate": k}} for k in range({count})]


def run(task, rng):
    k = task["replicate"]
    (HERE / f"{{k}}_{{os.urandom(4).hex()}}").touch()
    times = len(list(HERE.glob(f"{{k}}_*")))
    if times <= LETHAL.get(k, 0):
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep({sleep})
    return {{"mean": rng.normal(), "inside": True, "above": 1}}
"""


def local_cluster(**options):
    """A cluster here; its event loop has ten seconds to start, which may pass on a busy machine."""
    for _ in range(2):
        try:
            return distributed.LocalCluster(dashboard_address=":0", **options)
        except AssertionError:
            continue
    return distributed.LocalCluster(dashboard_address=":0", **options)


@pytest.fixture(scope="module")
def cluster():
    """Two worker processes that are replaced when they die; a task may be killed twice."""
    settings = {"distributed.scheduler.allowed-failures": 2}
    with (
        dask.config.set(settings),
        local_cluster(n_workers=2, threads_per_worker=1, processes=True) as cluster,
    ):
        yield cluster


def marked(tmp_path, lethal=None, count=12, sleep=0.02):
    marks = tmp_path / "marks"
    marks.mkdir()
    script = MARKED.format(marks=marks, lethal=lethal or {}, count=count, sleep=sleep)
    return write_study(tmp_path / "study", script), marks


def at(address):
    client = connect(address)
    return lambda study: lambda tasks: on_cluster(study, tasks, StudyStop(), client, print)


def begun(marks):
    return [int(path.name.partition("_")[0]) for path in marks.iterdir()]


def test_a_worker_that_dies_in_the_middle_costs_nothing(cluster, tmp_path):
    folder, marks = marked(tmp_path, lethal={5: 1})
    ending = run_study(folder, tmp_path / "r", at(cluster.scheduler_address))
    assert (ending.done, ending.failed) == (12, 0)
    assert begun(marks).count(5) == 2  # it was killed, and ran again
    killed = numbers(tmp_path / "r")
    assert list(killed["task"]) == list(range(12))
    run_study(folder, tmp_path / "undisturbed")
    pd.testing.assert_frame_equal(killed, numbers(tmp_path / "undisturbed"))


def test_a_task_that_always_kills_its_worker_fails_and_is_told(cluster, tmp_path):
    folder, marks = marked(tmp_path, lethal={3: 10**6}, count=8)
    ending = run_study(folder, tmp_path / "r", at(cluster.scheduler_address))
    assert (ending.done, ending.failed) == (7, 1)
    assert begun(marks).count(3) == 3
    (error,) = read_results(tmp_path / "r", failed=True)["task_error"]
    assert error.startswith("its worker process died 3 times")


def test_no_scheduler_is_told(monkeypatch):
    monkeypatch.setattr("elastocal.studies.ANSWER", 0.5)
    nothing = dask.config.set({"scheduler-address": None})
    with nothing, pytest.raises(InputError, match="names no scheduler"):
        connect("config")
    with pytest.raises(InputError, match="no scheduler answers"):
        connect("tcp://127.0.0.1:9")
    with pytest.raises(InputError, match="cluster='nowhere at all'"):
        connect("nowhere at all", unencrypted=True)


@pytest.mark.parametrize(
    ("address", "allowed"),
    [
        ("tcp://127.0.0.1:9", True), ("tcp://[::1]:9", True), ("localhost:9", True),
        ("tls://far.away:9", True), ("wss://far.away:9", True), ("inproc://far/1", True),
        ("tcp://far.away:9", False), ("far.away:9", False), ("ws://far.away:9", False),
        ("tcp://127.evil.example:9", False), ("tcp://10.0.0.1:9", False),
    ],
)  # fmt: skip
def test_no_scheduler_beyond_this_host_is_reached_in_the_clear(address, allowed):
    if allowed:
        _security(distributed, address)
    else:
        with pytest.raises(InputError, match="not encrypted, so whoever stands between"):
            _security(distributed, address)
        _security(distributed, address, unencrypted=True)


def test_a_scheduler_that_goes_away_ends_the_run_and_keeps_what_is_done(tmp_path):
    folder, marks = marked(tmp_path, count=200, sleep=0.05)
    cluster = local_cluster(n_workers=1, threads_per_worker=1, processes=False)

    def close():
        while len(list(marks.iterdir())) < 5:
            time.sleep(0.01)
        cluster.close()

    closing = threading.Thread(target=close, daemon=True)
    closing.start()
    with pytest.raises(ClusterLostError, match="went away"):
        run_study(folder, tmp_path / "r", at(cluster.scheduler_address))
    closing.join(60)  # of a cluster that still closes the next test would see the workers die
    kept = read_results(tmp_path / "r")
    assert 3 <= len(kept) < 200
    assert run_study(folder, tmp_path / "r", only=len(kept) + 5).before >= len(kept)
