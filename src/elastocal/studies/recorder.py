"""Outcomes become parts of the dataset: a batch every few seconds, each written once."""

from __future__ import annotations

import threading
import time
from types import TracebackType
from typing import Self

from elastocal.studies.dataset import Dataset
from elastocal.studies.execution import Outcome
from elastocal.studies.table import Table

SOONEST, LATEST = 5.0, 60.0  # s between parts; a long run writes fewer, or there are thousands


class Recorder:
    """Collects outcomes in a `with` block and writes them; at its end all of them are written.

    A timer writes too, so that a result is kept although the next one takes an hour.  Whatever
    interrupts a write, the same batch is written again under the same name, so nothing is lost
    and nothing is there twice.
    """

    def __init__(self, dataset: Dataset, table: Table, soonest: float = SOONEST) -> None:
        self._dataset, self._table, self._soonest = dataset, table, soonest
        self._begun = time.monotonic()
        self._lock = threading.Lock()
        # Number of the open part and what goes into it.  One attribute: an interrupt that fell
        # between a new number and a new list would write the batch twice.
        self._open: tuple[int, list[Outcome]] = (dataset.next_number(), [])
        self._timer: threading.Timer | None = None
        self._failure: BaseException | None = None

    def add(self, outcome: Outcome) -> None:
        """Take an outcome; raises what an earlier write on the timer raised."""
        if self._failure is not None:
            raise self._failure
        with self._lock:
            self._open[1].append(outcome)
        if self._timer is None or not self._timer.is_alive():
            elapsed = time.monotonic() - self._begun
            wait = max(self._soonest, min(elapsed / 50, LATEST))
            self._timer = threading.Timer(wait, self._on_time)
            self._timer.daemon = True
            self._timer.start()

    def flush(self) -> None:
        """Write what is open."""
        with self._lock:
            number, outcomes = self._open
            if not outcomes:
                return
            for outcome in outcomes:
                if outcome.error is not None:
                    task = self._table.jobs[outcome.index].text
                    trace = outcome.trace or outcome.error + "\n"
                    self._dataset.log(f"task {outcome.index} {task}\n{trace}\n")
            self._dataset.write(number, self._table.of(outcomes))
            self._open = (number + 1, [])

    def _on_time(self) -> None:
        try:
            self.flush()
        except BaseException as error:
            self._failure = error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self.flush()
