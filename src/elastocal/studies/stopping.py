"""Ctrl-C and SIGTERM: the first asks to stop, the second stops at once."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any, Self

GRACE = 30.0  # s that running tasks are waited for


class Stop:
    """In a `with` block, `asked` says that no more tasks may be handed out.

    A second signal, or `grace` seconds after the first, raises KeyboardInterrupt, and `check`
    raises it again: CasADi catches one inside a solver and returns where the search stood, and
    such a result must not be kept.
    """

    def __init__(self, grace: float = GRACE, tell: Callable[[str], None] | None = None) -> None:
        self.asked = False
        self._now = False
        self._grace, self._tell = grace, tell or _write
        self._before: dict[int, Any] = {}
        self._timer: threading.Timer | None = None

    def check(self) -> None:
        """Raise KeyboardInterrupt where it came to that before."""
        if self._now:
            raise KeyboardInterrupt

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():  # only it may set handlers
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
                    self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        if self._timer is not None:
            self._timer.cancel()
        for number, before in self._before.items():
            signal.signal(number, before)
        self._before.clear()

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            self._now = True
            raise KeyboardInterrupt
        self.asked = True
        self._tell(
            f"stopping: the running tasks have {self._grace:.0f} s to end (Ctrl-C again: at once)"
        )
        self._timer = threading.Timer(self._grace, os.kill, (os.getpid(), number))
        self._timer.daemon = True
        self._timer.start()


def _write(message: str) -> None:
    # In a signal handler: the buffer of sys.stderr may be in use by what was interrupted.
    os.write(2, f"\nelastocal: {message}\n".encode())


def ignore_interrupts() -> None:
    """In a worker process: Ctrl-C reaches the whole terminal, and its task is to end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
