"""How many poses, and how many readings at each, leave the least error within a time.

A stop takes `dwell_s`, and `reading_s` for each reading of each marker; between stops the arm
moves, and loads are changed by hand.  For each number of repeats so many poses are taken as fit,
and the best plan of them on few candidates: readings make Φ fall, but what the arm does not repeat
(`repeatability_um`), and parameters that few poses show, call for poses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from elastocal.cell.plan_wishes import Motion
from elastocal.cell.work_cell import Cell
from elastocal.errors import ElastocalError, InsufficientDataError
from elastocal.planning.candidates import Candidates
from elastocal.planning.choices import Choice
from elastocal.planning.exchange import exact_plan
from elastocal.planning.execution import greedy_tour, tour_cost
from elastocal.planning.information import plan_forces
from elastocal.planning.moves import travel_times
from elastocal.planning.plan import Plan, TimedSize
from elastocal.planning.relaxation import balanced, check_enough
from elastocal.planning.setup import shares_of
from elastocal.units import Array

REPEATS = (1, 2, 3, 4, 6, 8, 12, 16, 24)
WORSE = 2  # numbers of repeats in a row that are worse than fewer: more are not tried
TRIES = 3  # plans whose moves took longer than was thought


def at_stops(cell: Cell) -> Motion:
    """The motion, with what the readings of a stop take in its dwell."""
    motion, readings = cell.design.motion, cell.design.repeats * max(len(cell.tool.markers), 1)
    return replace(motion, dwell=motion.dwell + motion.reading * readings)


def within(
    choice: Choice, cell: Cell, plan_of: Callable[[Cell], Plan], minutes: float
) -> Plan:  # fmt: skip
    """The plan of least error that takes no longer than `minutes`, with its alternatives.

    Raises InsufficientDataError where nothing that determines the parameters fits.
    """
    asked = minutes
    for left in reversed(range(TRIES)):
        sizes, best = _Budget(choice, cell, asked).sizes()
        plan = plan_of(_sized(cell, best.poses, best.repeats))
        took = plan.execution.total / 60
        if took <= minutes or not left:
            break
        asked *= minutes / took
    more = (f"the plan takes {took:.0f} minutes, as its moves are longer than was thought",)
    warnings = plan.warnings + (more if took > minutes else ())
    return replace(plan, timed=sizes, warnings=warnings)


@dataclass(frozen=True)
class _Budget:
    choice: Choice
    cell: Cell
    minutes: float

    def sizes(self) -> tuple[tuple[TimedSize, ...], TimedSize]:
        """What fits, by numbers of repeats, and the best of them."""
        spec = self.cell.design
        # Where a reading takes no time nothing says how many of them there may be.
        numbers = REPEATS if spec.motion.reading > 0 else (spec.repeats,)
        drawn, found = self.choice.draw(self.cell), []
        for repeats in numbers:
            self.choice.progress(f"within {self.minutes:.4g} minutes: {repeats} readings each")
            size = self._best(drawn, repeats)
            if size is not None:
                found.append(size)
            least = min((value for _, value, _ in found), default=np.inf)
            if len(found) > WORSE and min(value for _, value, _ in found[-WORSE:]) > least:
                break
        if not found:
            raise InsufficientDataError(
                f"{self.cell.path or self.cell.name}: no plan that determines the parameters takes "
                f"{self.minutes:.4g} minutes or less; allow more time, or lower dwell_s, reading_s "
                "and load_change_s of [design.motion] where they are too high"
            )
        # A plan that holds more parameters errs less in the others, but not in all.
        most = max(kept for kept, _, _ in found)
        whole = [(value, size) for kept, value, size in found if kept == most]
        return tuple(size for _, size in whole), min(whole, key=lambda one: one[0])[1]

    def _best(self, drawn: Candidates, repeats: int) -> tuple[int, float, TimedSize] | None:
        """How many parameters a plan of as many poses as fit determines, Φ of it, and what it is;
        None where there is none."""
        poses = self._fitting(drawn.q, repeats)
        while poses > 0:
            cell = _sized(self.cell, poses, repeats)
            try:
                point = self.choice.relaxed(cell, drawn)
                if point is None:
                    return None
                problem = point.setup.problem(point.pool, shares_of(cell))
                check_enough(problem)
                chosen, phi = exact_plan(balanced(problem)[0], point.relaxed)
            except ElastocalError:
                return None
            took = _minutes(cell, point.pool.q[chosen])
            if took <= self.minutes:
                value = point.setup.criterion.figure(phi)
                return len(problem.prior), phi, TimedSize(poses, repeats, took, value)
            poses = min(int(poses * self.minutes / took), poses - 1)
        return None

    def _fitting(self, q: Array, repeats: int) -> int:
        """How many of the poses q (N, n), as they come, fit."""
        low, high = 0, len(q)
        while low < high:
            middle = (low + high + 1) // 2
            fits = _minutes(_sized(self.cell, middle, repeats), q[:middle]) <= self.minutes
            low, high = (middle, high) if fits else (low, middle - 1)
        return low


def _sized(cell: Cell, poses: int, repeats: int) -> Cell:
    # What poses read twice would take, more poses may have.
    motion = replace(cell.design.motion, extra_time=cell.design.motion.longer)
    spec = replace(
        cell.design, poses=poses, per_level=(), repeats=repeats, minutes=None, motion=motion
    )
    return replace(cell, design=spec)


def _minutes(cell: Cell, q: Array) -> float:
    """About how long the poses q (N, n) take, on a short way without obstacles."""
    motion, forces = at_stops(cell), plan_forces(cell)
    heavy = int(np.any(forces != 0, axis=1).sum())
    changes = (motion.load_changes or heavy + 1) if heavy else 0
    visits = len(forces)
    home = q[:1] if motion.home is None else motion.home[None]
    cost = travel_times(np.vstack([home, q]), motion.speed)
    waiting = visits * len(q) * motion.dwell * (2 if motion.both_directions else 1)
    travel = visits * tour_cost(cost, greedy_tour(cost))
    total = waiting + travel + changes * motion.load_change
    return float(total * (1 + motion.longer) / 60)
