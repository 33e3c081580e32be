"""When the arm stood still, in a log of joint values over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
CHUNK = 1024


@dataclass(frozen=True)
class Standstill:
    """Rows `first` to `last` of the log, both included; the arm's `q` (n,) then (median)."""

    first: int
    last: int
    q: Array


def standstills(time: Array, q: Array, still: Array, shortest: float) -> list[Standstill]:
    """The longest runs of rows in which no joint moves by more than `still`.

    `time` (m,) s, rising; `q` (m, n); `still` (n,): the largest max - min of each joint within a
    standstill, in the unit of q; `shortest` s between its first and last row.  Runs are taken from
    the start of the log on, each as long as it can be; shorter ones count as motion.
    """
    found: list[Standstill] = []
    start, m = 0, len(time)
    while start + 1 < m:
        # The first row with which the run is long enough.
        end = max(int(np.searchsorted(time, time[start] + shortest)), start + 1)
        if end >= m:
            break
        spread = _spread(q[start : end + 1][::-1])[::-1]
        moved = np.flatnonzero((spread > still).any(axis=1))
        if len(moved):
            # From there to `end` is too much, and every run that starts before holds both.
            start += int(moved[-1]) + 1
            continue
        end = _last(q, start, still)
        found.append(Standstill(start, end, np.median(q[start : end + 1], axis=0)))
        start = end + 1
    return found


def _spread(q: Array) -> Array:
    """(rows, n) max - min of each joint over the rows so far."""
    return np.maximum.accumulate(q) - np.minimum.accumulate(q)


def _last(q: Array, start: int, still: Array) -> int:
    """The last row of the run from `start` in which no joint moves by more than `still`."""
    size = CHUNK
    while True:
        over = np.flatnonzero((_spread(q[start : start + size]) > still).any(axis=1))
        if len(over):
            return start + int(over[0]) - 1
        if start + size >= len(q):
            return len(q) - 1
        size *= 2


def groups_alike(q: Array, tolerance: Array) -> NDArray[np.int64]:
    """(m,) codes by first appearance: rows of q (m, n) within `tolerance` (n,) of a group's first
    row are of that group."""
    codes = np.empty(len(q), dtype=np.int64)
    firsts: list[Array] = []
    for i, row in enumerate(q):
        if firsts:
            near = np.flatnonzero((np.abs(np.array(firsts) - row) <= tolerance).all(axis=1))
            if len(near):
                codes[i] = near[0]
                continue
        codes[i] = len(firsts)
        firsts.append(row)
    return codes
