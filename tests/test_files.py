"""Writing: whole files or none."""

from __future__ import annotations

import os

import pytest

from elastocal.errors import InputError
from elastocal.files import (
    atomic_binary_writer,
    atomic_write_bytes,
    atomic_write_text,
    atomic_writer,
)


def test_text_is_written_as_utf8_and_nothing_else_is_left(tmp_path):
    atomic_write_text(tmp_path / "a.txt", "µ\n")
    assert (tmp_path / "a.txt").read_bytes() == "µ\n".encode()
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_a_failure_leaves_the_old_file_and_no_temporary_one(tmp_path, failure):
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(failure), atomic_writer(tmp_path / "a.txt") as handle:
        handle.write("half")
        raise failure
    assert (tmp_path / "a.txt").read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_bytes_are_written_whole_or_not_at_all(tmp_path):
    atomic_write_bytes(tmp_path / "a.bin", b"\r\n\0")
    assert (tmp_path / "a.bin").read_bytes() == b"\r\n\0"
    with pytest.raises(RuntimeError), atomic_binary_writer(tmp_path / "a.bin") as handle:
        handle.write(b"half")
        raise RuntimeError
    assert (tmp_path / "a.bin").read_bytes() == b"\r\n\0"
    assert os.listdir(tmp_path) == ["a.bin"]


def test_missing_folder_is_an_input_error_that_names_it(tmp_path):
    with pytest.raises(InputError, match=r"folder .*absent does not exist"):
        atomic_write_text(tmp_path / "absent" / "a.txt", "")


def test_a_folder_or_a_path_through_a_file_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path, tmp_path / "file" / "a.txt", tmp_path / ("x" * 5000), "a\0b"):
        with pytest.raises(InputError):
            atomic_write_text(path, "")


def test_a_link_keeps_pointing_at_its_target(tmp_path):
    (tmp_path / "target").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "target")
    atomic_write_text(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_text() == "new"


def test_a_pipe_or_device_is_written_to_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    try:
        atomic_write_text(tmp_path / "pipe", "text")
        assert os.read(reader, 10) == b"text"
    finally:
        os.close(reader)
    assert (tmp_path / "pipe").is_fifo()


def test_permissions_follow_the_umask(tmp_path):
    old = os.umask(0o022)
    try:
        atomic_write_text(tmp_path / "a.txt", "")
    finally:
        os.umask(old)
    assert (tmp_path / "a.txt").stat().st_mode & 0o777 == 0o644
