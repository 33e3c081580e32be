"""When the arm stood still, in a log of joint values over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
    while start < m:
        low, high = q[start].copy(), q[start].copy()
        end = start
        while end + 1 < m:
            low, high = np.minimum(low, q[end + 1]), np.maximum(high, q[end + 1])
            if np.any(high - low > still):
                break
            end += 1
        if end > start and time[end] - time[start] >= shortest:
            found.append(Standstill(start, end, np.median(q[start : end + 1], axis=0)))
            start = end + 1
        else:
            start += 1
    return found


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
