"""Clocks of the benchmarks: best of several rounds, and processes with their peak memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bench_part import HERE, ONE_THREAD


@dataclass(frozen=True)
class Took:
    """Least wall and CPU seconds over the rounds; CPU of all threads."""

    wall: float
    cpu: float


def race(
    entrants: Mapping[str, Callable[[], Any]], least_rounds: int = 3, seconds: float = 2.0
) -> dict[str, Took]:
    """Every entrant in turn, round after round, so that all meet the same disturbances.

    Rounds go on until there are `least_rounds` and `seconds` per entrant are used up (at most
    200), or until three times these seconds are.  The first round warms up; it counts only where
    there is no other.
    """
    walls: dict[str, list[float]] = {name: [] for name in entrants}
    cpus: dict[str, list[float]] = {name: [] for name in entrants}
    start, rounds = time.perf_counter(), 0
    while rounds < 200:
        spent = (time.perf_counter() - start) / max(len(entrants), 1)
        if (rounds > least_rounds and spent > seconds) or (rounds and spent > 3 * seconds):
            break
        for name, work in entrants.items():
            wall, cpu = time.perf_counter(), time.process_time()
            work()
            walls[name].append(time.perf_counter() - wall)
            cpus[name].append(time.process_time() - cpu)
        rounds += 1
    first = 1 if rounds > 1 else 0
    return {name: Took(min(walls[name][first:]), min(cpus[name][first:])) for name in entrants}


@dataclass(frozen=True)
class Ran:
    """One process: seconds, peak resident memory in MB, exit code, what it printed."""

    wall: float
    cpu: float
    peak_mb: float
    code: int
    out: str
    errors: str


def process(command: Sequence[str], cwd: Path | None = None, **environment: str) -> Ran:
    """Run a command to its end.  Memory is that of the command, not of its children."""
    # A child starts with its parent's peak as its own (Linux), hence a small one in between.
    with tempfile.TemporaryDirectory() as folder:
        facts = Path(folder, "facts.json")
        done = subprocess.run(
            [sys.executable, "-S", "-E", str(HERE / "bench_launch.py"), str(facts), *command],
            cwd=cwd, env=os.environ | ONE_THREAD | environment, capture_output=True, text=True,
        )  # fmt: skip
        found = json.loads(facts.read_text())
    return Ran(**found, out=done.stdout, errors=done.stderr)


def own(script: str | Path, *arguments: Any, **environment: str) -> dict[str, Any]:
    """A benchmark's own child: `script --child …` prints one line of JSON last.

    Stops the benchmark with the child's errors where it fails.
    """
    ran = process([sys.executable, str(script), "--child", *map(str, arguments)], **environment)
    if ran.code:
        sys.exit(f"{Path(script).name} --child {arguments} failed:\n{ran.errors}")
    found = json.loads(ran.out.strip().splitlines()[-1])
    return {"wall": ran.wall, "cpu": ran.cpu, "peak_mb": ran.peak_mb} | found


def elastocal(*arguments: Any, **environment: str) -> Ran:
    """One run of the command line."""
    return process([sys.executable, "-m", "elastocal", *map(str, arguments)], **environment)


def exponent(x: Sequence[float], y: Sequence[float]) -> float:
    """Slope of log y over log x, by least squares."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])
