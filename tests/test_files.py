"""Reading: regular files of a bounded size.  Writing: whole files or none."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from elastocal.config import read_toml
from elastocal.files import (
    DEEPEST,
    atomic_write,
    atomic_writer,
    check_exists,
    read_bytes,
    read_json,
    read_text,
    together,
)
from elastocal.measurements import read_matrix
from elastocal.messages import InputError

NESTED = {
    "lists": "a = {}1{}".format("[" * 400_000, "]" * 400_000),
    "tables": "a = " + "{a = " * 150_000 + "1" + "}" * 150_000,
    "dots": ".".join("a" * 400_000) + " = 1",
    "quoted": ".".join(['"a"', " 'b' "] * 50_000) + " = 1",
    "header": "[" + ".".join("a" * 400_000) + "]",
    "within": "b = {c = 1, " + ".".join("a" * 400_000) + " = 1}",
}


@pytest.mark.parametrize("reader", [read_bytes, read_text, read_toml])
def test_a_pipe_or_device_is_refused_and_not_waited_for(tmp_path, reader):
    os.mkfifo(tmp_path / "pipe")
    for path, kind in ((tmp_path / "pipe", "pipe"), ("/dev/zero", "device")):
        with pytest.raises(InputError, match=f"is a {kind}.*not a regular file; save the cell"):
            reader(path, "cell", 1000)
        with pytest.raises(InputError, match=f"key robot.dh names .*: is a {kind}"):
            check_exists(tmp_path / path, "key robot.dh")


@pytest.mark.parametrize("kind", NESTED)
def test_nesting_is_refused_at_once(tmp_path, kind):
    (tmp_path / "cell.toml").write_text(f"name = 'arm'  # [[[\n{NESTED[kind]}\n")
    begun = time.perf_counter()
    told = (
        "nested without end"
        if kind in ("lists", "tables")
        else f"line 2: nested more than {DEEPEST}"
    )
    with pytest.raises(InputError, match=told):
        read_toml(tmp_path / "cell.toml", "cell")
    assert time.perf_counter() - begun < 5.0


@pytest.mark.parametrize("text", [
    "[" * 100_000, '{"a": NaN}', '{"a": 1,}', "Infinity", "{", "9" * 5000, "-1e400",
])  # fmt: skip
def test_what_is_no_strict_json_is_refused_with_the_remedy(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match=r"a\.json.*; write it anew"):
        read_json(tmp_path / "a.json", "result", 1_000_000, "write it anew")


def test_a_matrix_that_states_more_than_it_holds_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.eye(3))
    assert np.array_equal(read_matrix(tmp_path / "a.npy", "noise covariance"), np.eye(3))
    data = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "b.npy").write_bytes(data.replace(b"(3, 3), }", b"(9999999, 9999999), }", 1))
    np.save(tmp_path / "c.npy", np.array([["a"]]))
    np.save(tmp_path / "d.npy", np.array([[1.0, np.inf]]))
    (tmp_path / "e.csv").write_text("1, 2\n3, inf\n")
    (tmp_path / "f.csv").write_text("1, 2\n3\n")
    (tmp_path / "g.csv").write_text(" \n")
    for name in ("b.npy", "c.npy", "d.npy", "e.csv", "f.csv", "g.csv"):
        with pytest.raises(InputError, match=name):
            read_matrix(tmp_path / name, "noise covariance")


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_a_failure_leaves_the_old_file_and_no_temporary_one(tmp_path, failure):
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(failure), atomic_writer(tmp_path / "a.txt") as handle:
        handle.write("half")
        raise failure
    assert (tmp_path / "a.txt").read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_folder_or_a_path_through_a_file_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path, tmp_path / "file" / "a.txt", tmp_path / ("x" * 5000), "a\0b"):
        with pytest.raises(InputError):
            atomic_write(path, "")


def test_a_link_keeps_pointing_at_its_target(tmp_path):
    (tmp_path / "target").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "target")
    atomic_write(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_text() == "new"


def test_a_pipe_or_device_is_written_to_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    try:
        atomic_write(tmp_path / "pipe", "text")
        assert os.read(reader, 10) == b"text"
    finally:
        os.close(reader)
    assert (tmp_path / "pipe").is_fifo()


def test_what_replaces_a_file_is_as_secret_as_it_was(tmp_path):
    (tmp_path / "a.txt").write_text("old")
    (tmp_path / "a.txt").chmod(0o600)
    atomic_write(tmp_path / "a.txt", "new")
    assert (tmp_path / "a.txt").stat().st_mode & 0o777 == 0o600


WRITER = """
import os, sys
from elastocal.files import atomic_writer, atomic_write, together
with together():
    atomic_write(sys.argv[1], "half")
    with atomic_writer(sys.argv[2]) as handle:
        handle.write("half")
        print(flush=True)
        sys.stdin.read()
"""


def test_what_a_killed_process_left_goes_when_the_output_is_written_again(tmp_path):
    """Not before it is killed; and nothing but what it wrote."""
    outputs = [tmp_path / "a.txt", tmp_path / ("b" * 60)]
    others = [
        tmp_path / name for name in (".a.txt.tmp", ".c.txt.999999999-0123abcd.tmp", "a.txt.tmp")
    ]
    (tmp_path / ".a.txt.999999999-0123abcd.tmp").symlink_to("link")
    for path in (*others, tmp_path / "link"):
        path.write_text("of the user")
    command = [sys.executable, "-c", WRITER, *map(str, outputs)]
    writer = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    writer.stdout.readline()

    def unfinished() -> int:
        return len([n for n in os.listdir(tmp_path) if n.startswith((".a", ".b"))]) - 2

    for output in outputs:
        atomic_write(output, "new")
    assert unfinished() == 2
    writer.kill()
    writer.communicate()
    for output, left in zip(outputs, (1, 0), strict=True):
        atomic_write(output, "newer")
        assert unfinished() == left and output.read_text() == "newer"
    assert all(path.read_text() == "of the user" for path in others)


def test_files_written_together_appear_at_the_end(tmp_path):
    first, second = tmp_path / "a.txt", tmp_path / "b.bin"
    first.write_text("old")
    with together():
        atomic_write(first, "new")
        atomic_write(second, b"new")
        assert (first.read_text(), second.exists()) == ("old", False)
    assert (first.read_text(), second.read_bytes()) == ("new", b"new")
    assert sorted(os.listdir(tmp_path)) == ["a.txt", "b.bin"]
    atomic_write(first, "later")
    assert first.read_text() == "later"


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_of_files_written_together_none_appears_where_one_fails(tmp_path, failure):
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(failure), together():
        atomic_write(tmp_path / "a.txt", "new")
        atomic_write(tmp_path / "b.txt", "new")
        raise failure
    assert (tmp_path / "a.txt").read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_an_interrupt_between_files_written_together_waits_for_the_last(tmp_path, monkeypatch):
    first, second = tmp_path / "a.txt", tmp_path / "b.txt"
    replace = os.replace

    def interrupted(*paths):
        signal.raise_signal(signal.SIGINT)
        replace(*paths)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(os, "replace", interrupted)
    try:
        with pytest.raises(KeyboardInterrupt), together():
            atomic_write(first, "new")
            atomic_write(second, "new")
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert sorted(os.listdir(tmp_path)) == ["a.txt", "b.txt"]
