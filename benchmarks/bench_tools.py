"""What the benchmarks measure and print with: clocks, processes, tables and goals in Markdown."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
PEERS = "ELASTOCAL_PEERS_PYTHON"


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
    cpuinfo = Path("/proc/cpuinfo")
    told = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    models = [x.partition(":")[2].strip() for x in told if x.startswith("model name")]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return (
        f"{time.strftime('%Y-%m-%d %H:%M')}, commit {done.stdout.strip() or '–'}, "
        f"{[*models, platform.machine()][0]}, {cores} cores, {platform.system()}, "
        f"Python {platform.python_version()}; load average {os.getloadavg()[0]:.1f}"
    )


@dataclass(frozen=True)
class Seconds:
    """Wall and CPU time, the latter of all threads and of child processes that have ended; it
    hardly depends on what else runs."""

    wall: float
    cpu: float

    def __add__(self, other: Seconds) -> Seconds:
        return Seconds(self.wall + other.wall, self.cpu + other.cpu)

    @classmethod
    def since(cls, wall: float = 0.0, cpu: float = 0.0) -> Seconds:
        spent = os.times()
        cpu = time.process_time() + spent.children_user + spent.children_system - cpu
        return cls(time.perf_counter() - wall, cpu)


def timed(work: Callable[[], Any]) -> tuple[Any, Seconds]:
    start = Seconds.since()
    done = work()
    return done, Seconds.since(start.wall, start.cpu)


class Clock:
    """`seconds`: wall_NAME and cpu_NAME of every step."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        start = Seconds.since()
        yield
        took = Seconds.since(start.wall, start.cpu)
        self.seconds |= {f"wall_{name}": took.wall, f"cpu_{name}": took.cpu}


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
class Ran(Seconds):
    """One process, with its peak of resident memory in MB, without that of its children."""

    peak_mb: float


def elastocal(*arguments: Any, **environment: str) -> Ran:
    """One run of the command line; stops the benchmark with its errors where it fails."""
    # A child starts with its parent's peak as its own (Linux), hence a small one in between.
    small = [sys.executable, "-S", "-E", str(HERE / "bench_launch.py")]
    command = [sys.executable, "-m", "elastocal", *map(str, arguments)]
    every = os.environ | ONE_THREAD | environment
    with tempfile.TemporaryDirectory() as folder:
        facts = Path(folder, "facts.json")
        done = subprocess.run([*small, str(facts), *command], env=every, capture_output=True)
        found = json.loads(facts.read_text())
    if found.pop("code"):
        sys.exit(f"{' '.join(command)} failed:\n{done.stderr.decode()}")
    return Ran(**found)


def peer(script: str, *arguments: Path | str, own: bool = False) -> Any:
    """Run a script in the peers' environment (`own`: in this one); what it wrote to the last of its
    arguments."""
    python = sys.executable if own else os.environ.get(PEERS)
    if python is None:
        sys.exit(f"{PEERS} names no Python; benchmarks/README.md says how to make the environment")
    command = [python, str(HERE / script), *map(str, arguments)]
    one = os.environ | ONE_THREAD | {"OMP_NUM_THREADS": "1"}
    ran = subprocess.run(command, capture_output=True, text=True, env=one)
    if ran.returncode:
        sys.exit(f"{script} failed:\n{ran.stderr}")
    import numpy as np  # imported later than a peer's own clock starts

    return np.load(arguments[-1])


def packaged(package: str, ending: str) -> Path:
    """A file of an installed package by the end of its path."""
    files = metadata.distribution(package).files or ()
    return next(Path(str(f.locate())) for f in files if str(f).endswith(ending))
