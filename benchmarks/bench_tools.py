"""What the benchmarks measure and print with: clocks, processes, tables and goals in Markdown."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

HERE = Path(__file__).parent
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
T = TypeVar("T")


def number(value: Any) -> str:
    """Three digits, no exponent between 0.001 and a million; – for None; text as it is."""
    if value is None:
        return "–"
    if isinstance(value, str | int):
        return str(value)
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        return f"{value:.2e}"
    digits = max(0, 2 - int(f"{abs(value):e}".partition("e")[2])) if value else 0
    return f"{value:.{min(digits, 5)}f}"


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    print(f"\n### {title}\n\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for row in rows:
        print(f"| {' | '.join(map(number, row))} |")
    print(flush=True)


def goal(what: str, found: float, limit: float, unit: str = "", least: bool = False) -> None:
    """A number that should be at most (`least`: at least) its limit."""
    required(what, f"{number(found)} {unit}".strip(), found >= limit if least else found <= limit)


def required(what: str, found: str, met: bool) -> None:
    print(f"- {what}: {found}: {'met' if met else 'NOT MET'}", flush=True)


def where() -> str:
    """When, at which commit (+: files differ from it), on which machine, under which load."""
    describe = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    done = subprocess.run(describe, cwd=HERE, capture_output=True, text=True)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return (
        f"{time.strftime('%Y-%m-%d %H:%M')}, commit {done.stdout.strip() or '–'}, "
        f"{_processor()}, {cores} cores, {platform.system()}, Python {platform.python_version()}; "
        f"load average {os.getloadavg()[0]:.1f}"
    )


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    text = cpuinfo.read_text() if cpuinfo.exists() else ""
    models = [x for x in text.splitlines() if x.startswith("model name")]
    return models[0].partition(":")[2].strip() if models else platform.machine()


@dataclass(frozen=True)
class Seconds:
    """Wall and CPU time, the latter of all threads; it hardly depends on what else runs."""

    wall: float
    cpu: float

    def __add__(self, other: Seconds) -> Seconds:
        return Seconds(self.wall + other.wall, self.cpu + other.cpu)


def timed(work: Callable[[], T]) -> tuple[T, Seconds]:
    wall, cpu = time.perf_counter(), time.process_time()
    done = work()
    return done, Seconds(time.perf_counter() - wall, time.process_time() - cpu)


def race(
    entrants: Mapping[str, Callable[[], Any]], least_rounds: int = 3, seconds: float = 2.0
) -> dict[str, Seconds]:
    """Every entrant in turn, round after round, so that all meet the same disturbances: least
    seconds over the rounds.

    Rounds go on until there are `least_rounds` and `seconds` per entrant are used up (at most
    200), or until three times these seconds are.  The first round warms up; it counts only where
    there is no other.
    """
    found: dict[str, list[Seconds]] = {name: [] for name in entrants}
    start, rounds = time.perf_counter(), 0
    while rounds < 200:
        spent = (time.perf_counter() - start) / max(len(entrants), 1)
        if (rounds > least_rounds and spent > seconds) or (rounds and spent > 3 * seconds):
            break
        for name, work in entrants.items():
            found[name].append(timed(work)[1])
        rounds += 1
    return {
        name: Seconds(min(s.wall for s in kept), min(s.cpu for s in kept))
        for name, all_of_them in found.items()
        for kept in [all_of_them[1:] or all_of_them]
    }


@dataclass(frozen=True)
class Ran:
    """One process: seconds, peak resident memory in MB, exit code, what it printed."""

    wall: float
    cpu: float
    peak_mb: float
    code: int
    out: str
    errors: str


def process(*command: Any, **environment: str) -> Ran:
    """Run a command to its end; stops the benchmark with its errors where it fails.  Memory is
    that of the command, not of its children."""
    # A child starts with its parent's peak as its own (Linux), hence a small one in between.
    with tempfile.TemporaryDirectory() as folder:
        facts = Path(folder, "facts.json")
        done = subprocess.run(
            [sys.executable, "-S", "-E", str(HERE / "bench_launch.py"), str(facts),
             *map(str, command)],
            env=os.environ | ONE_THREAD | environment, capture_output=True, text=True,
        )  # fmt: skip
        found = json.loads(facts.read_text())
    if found["code"]:
        sys.exit(f"{' '.join(map(str, command))} failed:\n{done.stderr}")
    return Ran(**found, out=done.stdout, errors=done.stderr)


def elastocal(*arguments: Any, **environment: str) -> Ran:
    """One run of the command line."""
    return process(sys.executable, "-m", "elastocal", *arguments, **environment)


def peer(python: Path, script: str, *arguments: Path | str) -> Any:
    """Run a script in the peers' environment; what it wrote to the last of its arguments."""
    command = [str(python), str(HERE / script), *map(str, arguments)]
    one = os.environ | ONE_THREAD | {"OMP_NUM_THREADS": "1"}
    ran = subprocess.run(command, capture_output=True, text=True, env=one)
    if ran.returncode:
        sys.exit(f"{script} failed:\n{ran.stderr}")
    return np.load(arguments[-1])
