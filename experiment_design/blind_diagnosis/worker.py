"""A separate process that diagnoses visible folders and is told of nothing else."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

SCRIPT = Path(__file__).resolve().parent / "diagnose_many.py"
TIMEOUT = 300.0  # s
RENEWED_AFTER = 50  # worlds; memory of one process stays bounded
KEPT = ("PATH", "LANG", "LC_ALL", "SYSTEMROOT")  # of the environment


@dataclass(frozen=True)
class Run:
    """One run of the command: exit code (−1: killed or crashed), seconds, stderr."""

    exit: int
    seconds: float
    message: str


class Worker:
    """Started when first asked, renewed from time to time and after a crash.

    Its environment, working directory and import path (-I: neither the study's folder nor the
    user's) come without any trace of the study; all it gets are the folders it is asked about.
    """

    def __init__(self, timeout: float = TIMEOUT) -> None:
        self._timeout = timeout
        self._process: subprocess.Popen[str] | None = None
        self._served = 0

    def diagnose(self, folder: Path, *arguments: str) -> Run:
        """Run `elastocal diagnose cell.toml data.csv ARGUMENTS` in the visible folder."""
        return self.run(folder, "diagnose", "cell.toml", "data.csv", *arguments)

    def run(self, folder: Path, *arguments: str) -> Run:
        """Run `elastocal ARGUMENTS` in the visible folder."""
        if self._process is None or self._served >= RENEWED_AFTER:
            self.close()
            environment = {key: os.environ[key] for key in KEPT if key in os.environ}
            self._process = subprocess.Popen(
                [sys.executable, "-I", str(SCRIPT)], stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
                env=environment | {"OPENBLAS_NUM_THREADS": "1"}, cwd=tempfile.gettempdir(),
                start_new_session=True,  # an interrupted study is no failure of the command
            )  # fmt: skip
        process, self._served = self._process, self._served + 1
        assert process.stdin is not None and process.stdout is not None
        asked = json.dumps({"folder": str(folder), "arguments": arguments})
        start = time.perf_counter()
        with suppress(BrokenPipeError):
            process.stdin.write(asked + "\n")
            process.stdin.flush()
        ready, _, _ = select.select([process.stdout], [], [], self._timeout)
        # The end of its output is ready to be read, too.
        line = process.stdout.readline() if ready else ""
        if line:
            return Run(**json.loads(line))
        self.close()
        why = "crashed" if ready else "no answer in time"
        return Run(-1, time.perf_counter() - start, why)

    def close(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
        self._process, self._served = None, 0
