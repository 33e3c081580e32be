"""Compilers to test compiled tapes with: the system's, one that counts its runs, one that fails."""

from __future__ import annotations

import shlex
import shutil
import sys
from pathlib import Path

import pytest


def system_compiler() -> str:
    """Path of cc, gcc or clang; skips the test where there is none."""
    path = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if path is None:
        pytest.skip("no C compiler on the PATH")
    return path


def counting_compiler(folder: Path, version: str = "") -> Path:
    """A script to name in CC that runs the system's compiler; `compilations` counts its runs.

    `version` is what it says about itself, where that is to differ from the system's.
    """
    if sys.platform == "win32":
        pytest.skip("the counting compiler is a shell script")
    script, log = folder / "counting-cc", folder / "runs.log"
    answer = f"echo {shlex.quote(version)}; exit 0" if version else ":"
    script.write_text(
        f'#!/bin/sh\nif [ "$1" = --version ]; then {answer}; '
        f"else echo run >> {shlex.quote(str(log))}; fi\n"
        f'exec {shlex.quote(system_compiler())} "$@"\n'
    )
    script.chmod(0o755)
    return script


def compilations(folder: Path) -> int:
    """How often `counting_compiler` of this folder compiled."""
    log = folder / "runs.log"
    return len(log.read_text().splitlines()) if log.exists() else 0


def failing_compiler(folder: Path) -> Path:
    """A script to name in CC that has a version and compiles nothing."""
    if sys.platform == "win32":
        pytest.skip("the failing compiler is a shell script")
    script = folder / "failing-cc"
    script.write_text(
        '#!/bin/sh\n[ "$1" = --version ] && { echo failing 1.0; exit 0; }\n'
        "echo out of ink >&2; exit 3\n"
    )
    script.chmod(0o755)
    return script
