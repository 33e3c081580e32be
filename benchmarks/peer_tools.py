"""What the comparisons measure with: times, tables, peers in a process of their own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

HERE = Path(__file__).parent
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
T = TypeVar("T")


@dataclass(frozen=True)
class Seconds:
    """Wall and CPU time; CPU time hardly depends on what else the machine does."""

    wall: float
    cpu: float

    def __add__(self, other: Seconds) -> Seconds:
        return Seconds(self.wall + other.wall, self.cpu + other.cpu)


@dataclass(frozen=True)
class Row:
    """What was found, its value, and what it took."""

    what: str
    value: float
    took: Seconds | None = None

    @property
    def wall(self) -> float:
        return self.took.wall if self.took else 0.0

    @property
    def cpu(self) -> float:
        return self.took.cpu if self.took else 0.0


def timed(work: Callable[[], T]) -> tuple[T, Seconds]:
    wall, cpu = time.perf_counter(), time.process_time()
    done = work()
    return done, Seconds(time.perf_counter() - wall, time.process_time() - cpu)


def table(
    what: str,
    value: str,
    digits: int,
    beside: str,
    rows: Sequence[Row],
    remark: Callable[[float], str],
) -> None:
    """Print a Markdown table, values to `digits`; `remark` says how one stands beside the bound."""
    print(f"\n| {what} | {value} | {beside} | wall, s | CPU, s |\n|---|---|---|---|---|")
    for row in rows:
        times = f"{row.took.wall:.2f} | {row.took.cpu:.2f}" if row.took else "– | –"
        print(f"| {row.what} | {row.value:.{digits}f} | {remark(row.value)} | {times} |")
    print(flush=True)


def required(what: str, met: bool) -> None:
    print(f"- {what}: {'met' if met else 'NOT MET'}", flush=True)


def peer(python: Path, script: str, *arguments: Path | str) -> Any:
    """Run a script in the peers' environment; what it wrote to the last of its arguments."""
    command = [str(python), str(HERE / script), *map(str, arguments)]
    ran = subprocess.run(command, capture_output=True, text=True, env=os.environ | ONE_THREAD)
    if ran.returncode:
        sys.exit(f"{script} failed:\n{ran.stderr}")
    return np.load(arguments[-1])


def seconds_of(found: Any, step: str) -> Seconds:
    """Times that a peer took itself."""
    return Seconds(float(found[f"wall_{step}"]), float(found[f"cpu_{step}"]))


def starts(number: int) -> str:
    return f"{number} start{'s' if number > 1 else ''}"
