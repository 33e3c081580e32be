"""Compiled libraries between processes: found, never stale, rebuilt when damaged."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from support.backends import compilations, counting_compiler

from elastocal.model import BatchFunction
from elastocal.model import c_engine as compiled_build

# Prints the values of sin(factor·x) + x, and whether the library came from the cache.
PROGRAM = """
import sys, casadi as ca, numpy as np
from elastocal.model.evaluate import BatchFunction
x = ca.SX.sym("x")
function = BatchFunction([x], [ca.sin(float(sys.argv[1]) * x) + x], "compiled")
print(function(np.array([[0.5], [1.5]]))[0].ravel().tolist(), function.report.cached)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a compiler that counts and an empty cache, both in use."""
    monkeypatch.setenv("CC", str(counting_compiler(tmp_path)))
    monkeypatch.setenv("ELASTOCAL_CACHE", str(tmp_path / "cache"))
    return tmp_path


def started(factor: float) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", PROGRAM, str(factor)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def finished(process: subprocess.Popen[str]) -> tuple[list[float], bool]:
    """(values, cached) of a process that ended well."""
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    values, cached = output.rsplit(maxsplit=1)
    return [float(v) for v in values.strip("[]").split(",")], cached == "True"


def expected(factor: float) -> list[float]:
    x = np.array([0.5, 1.5])
    return pytest.approx((np.sin(factor * x) + x).tolist(), rel=1e-15)


def libraries(folder: Path) -> list[Path]:
    return list((folder / "cache").glob(f"*{compiled_build.SUFFIX}"))


def test_a_second_process_does_not_compile(folder: Path) -> None:
    assert finished(started(2.0)) == (expected(2.0), False)
    assert finished(started(2.0)) == (expected(2.0), True)
    assert compilations(folder) == 1


def test_another_expression_is_another_library(folder: Path) -> None:
    assert finished(started(2.0)) == (expected(2.0), False)
    assert finished(started(2.0000000000000004)) == (expected(2.0), False)
    assert compilations(folder) == 2


@pytest.mark.parametrize("damage", ["truncated", "empty", "changed"])
def test_a_damaged_library_is_compiled_anew(folder: Path, damage: str) -> None:
    finished(started(2.0))
    (library,) = libraries(folder)
    whole = library.read_bytes()
    middle = len(whole) // 2
    changed = whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]
    library.write_bytes({"truncated": whole[:middle], "empty": b"", "changed": changed}[damage])
    assert finished(started(2.0)) == (expected(2.0), False)
    assert finished(started(2.0)) == (expected(2.0), True)
    assert compilations(folder) == 2


def test_the_whole_library_of_another_function_is_not_loaded_but_replaced(folder: Path) -> None:
    finished(started(2.0))
    (library,) = libraries(folder)
    key = library.name.split(".")[0]
    finished(started(3.0))
    (other,) = (path for path in libraries(folder) if path != library)
    library.unlink()
    # Its name states the digest of its content truly, as one that means harm would see to.
    other.rename(other.with_name(f"{key}{other.name[len(key) :]}"))
    assert finished(started(2.0)) == (expected(2.0), False)
    assert finished(started(2.0)) == (expected(2.0), True)


def test_two_processes_at_once(folder: Path) -> None:
    both = [started(3.0), started(3.0)]
    assert [finished(process)[0] for process in both] == [expected(3.0)] * 2
    assert finished(started(3.0)) == (expected(3.0), True)
    assert not list((folder / "cache").glob(".*"))


def small(factor: float = 2.0) -> BatchFunction:
    x = ca.SX.sym("x")
    return BatchFunction([x], [ca.sin(factor * x) + x], "compiled")


AT = np.array([[0.5], [1.5]])


def test_a_new_compiler_compiles_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small()(AT)
    monkeypatch.setenv("CC", str(counting_compiler(folder, version="counting cc 2.0")))
    function = small()
    assert function(AT)[0].ravel().tolist() == expected(2.0)
    assert "counting cc 2.0" in str(function.report.compiler)
    assert compilations(folder) == 2


def test_other_flags_compile_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small()(AT)
    monkeypatch.setattr("elastocal.model.c_engine.FLAGS", (*compiled_build.FLAGS, "-g"))
    small()(AT)
    assert compilations(folder) == 2


def test_other_code_that_writes_c_compiles_anew(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small()(AT)
    monkeypatch.setattr("elastocal.model.c_engine.written_by", lambda *sources: "another")
    small()(AT)
    assert compilations(folder) == 2


def test_a_library_that_does_not_load_is_compiled_anew(folder: Path) -> None:
    """Whole, but not a library: say, of another system that shares the folder."""
    from elastocal.model import store

    small()(AT)
    (library,) = libraries(folder)
    library.unlink()
    store(library.name.partition(".")[0], compiled_build.SUFFIX, b"not a library")
    for _ in range(2):
        assert small()(AT)[0].ravel().tolist() == expected(2.0)
    assert compilations(folder) == 2


def test_without_a_cache_every_tape_is_compiled(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "file").write_text("in the way")
    monkeypatch.setenv("ELASTOCAL_CACHE", str(folder / "file" / "cache"))
    for _ in range(2):
        function = small()
        assert function(AT)[0].ravel().tolist() == expected(2.0)
        assert not function.report.cached
    assert compilations(folder) == 2


def test_no_source_or_object_is_left_behind(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scratch = folder / "scratch"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    small()(AT)
    assert not list(scratch.iterdir())
    assert len(os.listdir(folder / "cache")) == 1
