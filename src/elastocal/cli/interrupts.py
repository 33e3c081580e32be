"""Ctrl-C, also where a library catches it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Self


class Interrupts:
    """In a `with` block, a SIGINT raises KeyboardInterrupt, and again at every `check`.

    CasADi catches a KeyboardInterrupt inside a solver and returns where the search stood, and
    Python drops one that falls into a finaliser: without `check` the work would go on, with
    results that depend on when the key was pressed.
    """

    def __init__(self) -> None:
        self._caught = False
        self._before: Callable[[int, FrameType | None], object] | None = None

    def check(self) -> None:
        """Raise KeyboardInterrupt where one came before."""
        if self._caught:
            raise KeyboardInterrupt

    def __enter__(self) -> Self:
        before = signal.getsignal(signal.SIGINT)
        # Ignored, as under nohup, it stays ignored; and only the main thread may set handlers.
        if callable(before) and threading.current_thread() is threading.main_thread():
            self._before = before
            signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)
            self._before = None

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._caught = True
        if self._before is not None:
            self._before(number, frame)
