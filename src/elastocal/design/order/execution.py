"""The order of execution as it is handed on: stops, how to get to them, what it takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Motion

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Stop:
    """One reading: pose `pose` at joints `q` (n,) in load state `load` (0-based both).

    The arm moves straight through `via` (k, n), where nothing is measured, and then to `q`, in
    `travel` s.  `change_after`: the load is changed once that many of these k + 1 moves are done;
    None: it stays.  `approach` (n,): +1 or −1, the direction of each joint's last motion, and
    `side` 0 or 1 where the pose is approached from both sides.
    """

    pose: int
    load: int
    q: Array
    via: Array
    travel: float
    change_after: int | None = None
    approach: IntArray | None = None
    side: int = 0


@dataclass(frozen=True)
class Execution:
    """The stops in order, and the way home, through `home_via` (k, n), where there is a home.

    `travel` s in all; no order of these visits, whose moves go straight or through the given
    points, travels less than `bound` s.  `checked` moves were tried, `blocked` of them in the
    way of something.  `take_off`: the load hangs on the arm after the last stop.
    """

    stops: tuple[Stop, ...]
    home_via: Array
    home_travel: float
    take_off: bool
    motion: Motion
    bound: float
    checked: int
    blocked: int

    @property
    def travel(self) -> float:
        return sum(stop.travel for stop in self.stops) + self.home_travel

    @property
    def gap(self) -> float:
        """How much longer than the best order this one can be: travel / bound − 1."""
        if self.travel <= self.bound:
            return 0.0
        return self.travel / self.bound - 1 if self.bound > 0 else np.inf

    @property
    def one_sided(self) -> tuple[int, ...]:
        """Poses that were to be approached from both sides but can be from one only."""
        sides: dict[tuple[int, int], int] = {}
        for stop in self.stops:
            sides[stop.pose, stop.load] = sides.get((stop.pose, stop.load), 0) + 1
        few = {pose for (pose, _), n in sides.items() if self.motion.both_directions and n < 2}
        return tuple(sorted(few))

    @property
    def load_changes(self) -> int:
        """Loads hung, exchanged or taken off; the arm begins and ends without."""
        return sum(stop.change_after is not None for stop in self.stops) + self.take_off

    @property
    def total(self) -> float:
        """s of travelling, measuring and changing loads."""
        motion = self.motion
        waiting = motion.dwell * len(self.stops) + motion.load_change * self.load_changes
        return self.travel + waiting
