"""How far a study is: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Self

from elastocal.cli.app import console

EVERY = 10.0  # s between plain lines


class StudyProgress:
    """Done of total, rate per minute of this run, time left, failures; on stderr.

    Use it in `with`; silent where `shown` is false.
    """

    def __init__(self, shown: bool) -> None:
        self._shown, self._screen = shown, console(stderr=True)
        self._total = self._done = self._failed = self._new = 0
        self._begun = self._told = time.monotonic()
        self._bar: Any = None
        self._context: AbstractContextManager[Any] = nullcontext()

    def __enter__(self) -> Self:
        if self._shown and self._screen.is_terminal:
            from rich.progress import BarColumn, Progress, TextColumn

            columns = (BarColumn(), TextColumn("{task.description}"))
            self._bar = Progress(*columns, console=self._screen)
            self._context = self._bar
        self._context.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._context.__exit__(*error)

    def begin(self, total: int, done: int, failed: int) -> None:
        """`done` of `total` tasks, failures among them, are there already."""
        self._total, self._done, self._failed = total, done, failed
        self._begun = self._told = time.monotonic()
        if self._bar is not None:
            self._bar.add_task(self._line(), total=total, completed=done)
        elif self._shown:
            self._screen.print(f"… {self._line()}")

    def advance(self, failed: bool) -> None:
        """One more task came back."""
        self._done += 1
        self._new += 1
        self._failed += failed
        now = time.monotonic()
        if self._bar is not None:
            only = self._bar.task_ids[0]
            self._bar.update(only, completed=self._done, description=self._line())
        elif self._shown and (now - self._told > EVERY or self._done == self._total):
            self._told = now
            self._screen.print(f"… {self._line()}")

    def tell(self, message: str) -> None:
        """A message beside the bar, also where no progress is shown."""
        self._screen.print(f"… {message}")

    def _line(self) -> str:
        text = f"{self._done}/{self._total} tasks"
        if self._new:
            rate = self._new / max(time.monotonic() - self._begun, 1e-3)
            left = round((self._total - self._done) / rate)
            hours, rest = divmod(left, 3600)
            clock = f"{hours}:{rest // 60:02d}:{rest % 60:02d}"
            text += f", {60 * rate:.{0 if rate > 1 else 1}f} per minute, {clock} left"
        return text + (f", {self._failed} failed" if self._failed else "")
