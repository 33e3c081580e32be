"""Wall and CPU seconds of named steps, in any environment: it imports nothing but Python's own."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager


class Clock:
    """`seconds`: wall_NAME and cpu_NAME of every step; CPU time of child processes counts."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        wall, cpu = time.perf_counter(), _cpu()
        yield
        self.seconds[f"wall_{name}"] = time.perf_counter() - wall
        self.seconds[f"cpu_{name}"] = _cpu() - cpu


def _cpu() -> float:
    spent = os.times()
    return time.process_time() + spent.children_user + spent.children_system
