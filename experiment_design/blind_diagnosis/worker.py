"""The command in a process of its own that is told of a visible folder and of nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

# -I: neither the study's folder nor the user's can be imported.
COMMAND = (sys.executable, "-I", "-m", "elastocal")
TIMEOUT = 300.0  # s
KEPT = ("PATH", "LANG", "LC_ALL", "SYSTEMROOT")  # of the environment
MESSAGE = 2000  # characters


@dataclass(frozen=True)
class Run:
    """One run of the command: exit code (−1: no answer in time), seconds, the last of stderr."""

    exit: int
    seconds: float
    message: str


def run(folder: Path, *arguments: str) -> Run:
    """`elastocal ARGUMENTS` in the visible folder, with nothing of the study in its environment."""
    environment = {key: os.environ[key] for key in KEPT if key in os.environ}
    start = time.perf_counter()
    try:
        done = subprocess.run(
            [*COMMAND, *arguments, "--quiet"], cwd=folder, capture_output=True, text=True,
            env=environment | {"OPENBLAS_NUM_THREADS": "1"}, timeout=TIMEOUT,
            start_new_session=True,  # an interrupted study is no failure of the command
        )  # fmt: skip
        code, told = done.returncode, done.stderr
    except subprocess.TimeoutExpired:
        code, told = -1, "no answer in time"
    return Run(code, time.perf_counter() - start, told[-MESSAGE:])
