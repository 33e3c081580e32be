"""Where an effect's constants are searched: change times, time constants, orders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import index
from elastocal.measurements import Measurements

Array = NDArray[np.float64]

CHANGE_TIMES = 120  # at most; more moments are refined after the search
TIME_CONSTANTS = 8
HIGHEST_ORDER, LOWEST_ORDER = 600.0, 2.5
# Step of the orders in units of 1/range(q): half a step off, a ripple keeps 0.95 of its size.
ORDER_STEP = 1.5
KNOWN_SHARE = 0.5  # of the prior, on orders the cell names


@dataclass(frozen=True)
class Grid:
    """Values (G, settings) to try, and the log prior of each, which sum to one."""

    values: Array
    log_prior: Array
    step: Array

    def nearest(self, settings: Array) -> int:
        """The point that stands for `settings` (settings,), which were refined from it."""
        return int(np.abs(self.values - settings).sum(axis=1).argmin())


def grid_of(hypothesis: Hypothesis, visits: Measurements, chain: Chain) -> Grid:
    """Grid of a hypothesis' settings for these visits; one empty point where it has none."""
    if not hypothesis.settings:
        return Grid(np.zeros((1, 0)), np.zeros(1), np.zeros((1, 0)))
    (setting,) = hypothesis.settings
    if setting.kind == "order":
        return _orders(hypothesis, visits)
    assert visits.time is not None
    if setting.kind == "change_time":
        values = change_times(visits.time)
    else:
        span = float(np.ptp(visits.time))
        low, high = max(span / 20, setting.lower), min(3 * span, setting.upper)
        values = np.geomspace(min(low, high), high, TIME_CONSTANTS)
    step = np.gradient(values) if len(values) > 1 else np.ones(1)
    return Grid(values[:, None], np.full(len(values), -np.log(len(values))), step[:, None])


def moments_between(time: Array) -> Array:
    """Every moment between two visits, two visits at least on either side."""
    known = np.sort(time)
    middle = np.unique((known[1:-2] + known[2:-1]) / 2)
    return middle if len(middle) else np.array([known.mean()])


def change_times(time: Array) -> Array:
    """Moments between visits that are tried first: CHANGE_TIMES at most, evenly spaced."""
    middle = moments_between(time)
    if len(middle) > CHANGE_TIMES:
        chosen = np.linspace(0, len(middle) - 1, CHANGE_TIMES).round().astype(int)
        middle = middle[chosen]
    return middle


def _orders(hypothesis: Hypothesis, visits: Measurements) -> Grid:
    spread = max(float(np.ptp(visits.q[:, index(hypothesis.where)])), 1e-3)
    step = ORDER_STEP / spread
    values = np.arange(LOWEST_ORDER, HIGHEST_ORDER, step)
    (setting,) = hypothesis.settings
    known = [] if setting.default is None else [setting.default]
    share = KNOWN_SHARE if known else 0.0
    prior = np.concatenate(
        [np.full(len(known), share), np.full(len(values), (1 - share) / len(values))]
    )
    return Grid(
        np.concatenate([known, values])[:, None], np.log(prior), np.full((len(prior), 1), step)
    )
