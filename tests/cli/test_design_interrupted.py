"""An interrupted design goes on where it was, and ends as if nothing had happened."""

import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from support.design_commands import (
    DEFLECTION,
    PROGRAM,
    altered,
    design,
    elastocal,
    everything_in,
    write_cell,
)

from elastocal.planning import search

WHOLE_SEARCH = True  # as in the process that is stopped
GOING_ON = "resuming the interrupted design"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    assert design(write_cell(folder)).exit_code == 0
    return (folder / "plan.csv").read_bytes()


def interrupt_after(monkeypatch, saves):
    save, count = search.atomic_write, [0]

    def saving(path, state):
        save(path, state)
        count[0] += 1
        if count[0] == saves:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(search, "atomic_write", saving)


@pytest.mark.parametrize("edited", [False, True])
def test_it_goes_on_and_ends_with_the_same_plan(tmp_path, monkeypatch, whole, edited):
    cell = write_cell(tmp_path)
    with monkeypatch.context() as patch:
        interrupt_after(patch, 3)
        result = design(cell)
    assert result.exit_code == 130 and result.stderr == "elastocal: interrupted\n"
    assert everything_in(tmp_path) == ["cell.toml", "plan.csv.resume"]
    if edited:
        write_cell(tmp_path, altered(DEFLECTION, poses="4"))
    result = design(cell, quiet=False)
    assert result.exit_code == 0
    assert (GOING_ON in result.stderr) == ("drawing candidates" not in result.stderr) != edited
    assert edited != ((tmp_path / "plan.csv").read_bytes() == whole)
    assert len((tmp_path / "plan.csv").read_text().splitlines()) == 6 - edited
    assert everything_in(tmp_path) == ["cell.toml", "plan.csv", "plan.json"]


def stages_in(begun):
    """What is kept of an interrupted design, in the file that says where it stands."""
    if not begun.exists():
        return set()
    with np.load(begun) as kept:
        return {name.partition("/")[0] for name in kept.files} - {search.KEY}


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("effort", "stage", "number"),
    [("quick", "candidates", signal.SIGKILL),
     *(pytest.param("normal", stage, number, marks=pytest.mark.long)
       for stage in ("start0", "warm0") for number in (signal.SIGINT, signal.SIGKILL))],
)  # fmt: skip
def test_a_process_that_is_stopped(tmp_path, whole, effort, stage, number):
    cell, begun = write_cell(tmp_path), tmp_path / "plan.csv.resume"
    words = ["design", str(cell), "--effort", effort, "-o"]
    command = [sys.executable, "-c", PROGRAM, *words, str(tmp_path / "plan.csv")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) as process:
        while stage not in stages_in(begun):
            assert process.poll() is None, process.stderr.read().decode()
            time.sleep(0.01)
        process.send_signal(number)
        told = process.communicate()[1].decode()
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert told.endswith("elastocal: interrupted\n") and "Traceback" not in told
    else:
        assert process.returncode == -signal.SIGKILL
    assert everything_in(tmp_path) == ["cell.toml", "plan.csv.resume"]
    assert GOING_ON in elastocal(*words, tmp_path / "plan.csv").stderr
    if effort != "quick":
        assert elastocal(*words, tmp_path / "whole.csv").exit_code == 0
        whole = (tmp_path / "whole.csv").read_bytes()
    assert (tmp_path / "plan.csv").read_bytes() == whole
    assert not begun.exists()
