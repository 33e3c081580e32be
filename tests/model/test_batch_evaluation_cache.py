"""The cache folder: where it is, whole entries or none, the least recently used go first."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from elastocal.model import HashedFunction, cache_folder, content_key, fetch, store
from elastocal.model import function_cache as tape_cache
from elastocal.model import numpy_engine as backend_instructions

KEY = content_key("a test")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("ELASTOCAL_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_what_is_stored_is_found(folder: Path) -> None:
    stored = store(KEY, ".bin", b"content")
    assert stored is not None and stored.parent == folder
    assert fetch(KEY, ".bin") == stored
    assert stored.read_bytes() == b"content"


def test_nothing_else_is_found() -> None:
    store(KEY, ".bin", b"content")
    assert fetch(content_key("another"), ".bin") is None
    assert fetch(KEY, ".so") is None


@pytest.mark.parametrize("damage", [b"", b"conten", b"c0ntent"])
def test_a_damaged_entry_is_not_found_and_removed(damage: bytes) -> None:
    stored = store(KEY, ".bin", b"content")
    assert stored is not None
    stored.write_bytes(damage)
    assert fetch(KEY, ".bin") is None
    assert not stored.exists()


def test_keys_tell_parts_apart() -> None:
    keys = {content_key("ab", "c"), content_key("a", "bc"), content_key("abc"), content_key(b"x")}
    assert len(keys) == 4


def test_the_format_is_part_of_the_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tape_cache, "FORMAT", "another")
    assert content_key("a test") != KEY


def test_a_folder_that_cannot_be_made_is_no_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("ELASTOCAL_CACHE", str(tmp_path / "file" / "cache"))
    assert store(KEY, ".bin", b"content") is None
    assert fetch(KEY, ".bin") is None


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_a_folder_of_somebody_else_is_no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    store(KEY, ".bin", b"content")
    monkeypatch.setattr(os, "getuid", lambda: 12345678)
    assert fetch(KEY, ".bin") is None


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
@pytest.mark.parametrize("mode", [0o777, 0o750, 0o705, 0o720])
def test_a_folder_that_others_may_enter_is_refused_with_a_word(folder: Path, mode: int) -> None:
    assert store(KEY, ".bin", b"content") is not None
    assert folder.stat().st_mode & 0o777 == 0o700
    tape_cache.refused.clear()
    folder.chmod(mode)
    assert fetch(KEY, ".bin") is None and store(KEY, ".bin", b"content") is None
    assert [str(folder) in told and "chmod 700" in told for told in tape_cache.refused] == [True]
    folder.chmod(0o700)
    assert fetch(KEY, ".bin") is not None
    folder.parent.chmod(0o777)
    assert fetch(KEY, ".bin") is None and str(folder.parent) in tape_cache.refused[-1]
    tape_cache.refused.clear()


def test_an_entry_that_is_a_link_or_pipe_is_made_anew(folder: Path, tmp_path: Path) -> None:
    stored = store(KEY, ".bin", b"content")
    assert stored is not None
    stored.rename(tmp_path / "elsewhere")
    stored.symlink_to(tmp_path / "elsewhere")
    assert fetch(KEY, ".bin") is None and not stored.is_symlink()
    os.mkfifo(stored)
    assert fetch(KEY, ".bin") is None


def test_no_part_is_left_behind(folder: Path) -> None:
    store(KEY, ".bin", b"content")
    store(KEY, ".bin", b"content")
    assert len(list(folder.iterdir())) == 1


def test_the_least_recently_used_goes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tape_cache, "LARGEST_TOTAL", 250)
    keys = [content_key(str(k)) for k in range(3)]
    for age, key in zip((300, 200), keys[:2], strict=True):
        stored = store(key, ".bin", bytes(100))
        assert stored is not None
        os.utime(stored, (stored.stat().st_mtime - age,) * 2)
    fetch(keys[0], ".bin")  # used: now the second is the oldest
    store(keys[2], ".bin", bytes(100))
    assert [fetch(key, ".bin") is not None for key in keys] == [True, False, True]


def test_what_is_too_much_is_looked_for_now_and_then(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At first, since others have written too, and after each fiftieth of all that may be there."""
    monkeypatch.setattr(tape_cache, "LARGEST_TOTAL", 10_000)
    looked, largest, prune = [], 0, tape_cache.prune
    monkeypatch.setattr(tape_cache, "prune", lambda *a, **k: looked.append(prune(*a, **k)))
    for k in range(50):
        store(content_key(str(k)), ".bin", bytes(50))
    assert len(looked) == 13  # the first, and every fourth
    for k in range(300):
        store(content_key(str(k)), ".bin", bytes(70))
        largest = max(largest, sum(path.stat().st_size for path in folder.iterdir()))
    assert 10_000 <= largest <= 10_200


def test_pruning_leaves_files_of_others_alone(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tape_cache, "LARGEST_TOTAL", 0)
    folder.mkdir(mode=0o700)
    (folder / "thesis.final.pdf").write_bytes(bytes(1000))
    assert store(KEY, ".bin", b"content") is not None
    assert (folder / "thesis.final.pdf").exists()


def test_abandoned_parts_are_removed(folder: Path) -> None:
    folder.mkdir(mode=0o700)
    others = [folder / ".thesis.0123abcd.tmp", folder / f".{KEY}.old.tmp"]
    left = folder / f".{KEY}.0123456.0123abcd.tmp"
    for path in (*others, left):
        path.write_bytes(b"half")
    store(content_key("another"), ".bin", b"content")
    assert not left.exists() and all(path.exists() for path in others)


# --- where it is ---------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="the XDG rule is Linux's")
@pytest.mark.parametrize("xdg, expected", [
    ("/somewhere", "/somewhere/elastocal"), ("", "~/.cache/elastocal"),
    ("relative", "~/.cache/elastocal"),
])  # fmt: skip
def test_xdg_folder(monkeypatch: pytest.MonkeyPatch, xdg: str, expected: str) -> None:
    monkeypatch.delenv("ELASTOCAL_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", xdg)
    assert cache_folder() == Path(expected).expanduser()


@pytest.mark.parametrize("platform, tail", [
    ("darwin", "Library/Caches/elastocal"), ("win32", "AppData/Local/elastocal"),
])  # fmt: skip
def test_folder_of_other_systems(monkeypatch: pytest.MonkeyPatch, platform: str, tail: str) -> None:
    monkeypatch.delenv("ELASTOCAL_CACHE")
    monkeypatch.delenv("LOCALAPPDATA", raising=False)
    monkeypatch.setattr(sys, "platform", platform)
    assert cache_folder() == Path.home() / tail


# --- instructions --------------------------------------------------------------------------


def long_function(factor: float) -> HashedFunction:
    x = ca.SX.sym("x")
    y = x
    for k in range(backend_instructions.SMALLEST_CACHED):
        y = ca.sin(factor * y) + k
    return HashedFunction([x], [y])


def test_long_functions_are_read_from_the_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    first = backend_instructions.instructions(long_function(3.0))
    monkeypatch.setattr(backend_instructions, "_extracted", None)  # not asked again
    second = backend_instructions.instructions(long_function(3.0))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])
    assert first[2] == second[2]


def test_another_constant_is_another_tape() -> None:
    first = backend_instructions.instructions(long_function(3.0))
    second = backend_instructions.instructions(long_function(3.5))
    assert not np.array_equal(first[1], second[1])


def test_short_functions_are_not_cached(folder: Path) -> None:
    x = ca.SX.sym("x")
    backend_instructions.instructions(HashedFunction([x], [ca.sin(x)]))
    assert not folder.exists()


def test_entries_differ_between_versions_of_casadi(monkeypatch: pytest.MonkeyPatch) -> None:
    x = ca.SX.sym("x")
    before = HashedFunction([x], [ca.sin(x)]).digest
    monkeypatch.setattr("elastocal.model.function_cache.casadi_version", lambda: "0")
    assert HashedFunction([x], [ca.sin(x)]).digest != before


def test_a_foreign_tape_is_made_anew(folder: Path) -> None:
    first = backend_instructions.instructions(long_function(3.0))
    (entry,) = folder.iterdir()
    key, _, _ = entry.name.partition(".")
    entry.unlink()
    store(key, backend_instructions.SUFFIX, b"no archive of numpy")
    second = backend_instructions.instructions(long_function(3.0))
    np.testing.assert_array_equal(first[0], second[0])
