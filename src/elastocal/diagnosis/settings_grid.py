"""Where an effect's constants are searched: change times, time constants, orders, ranges."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import index
from elastocal.manipulator.parameter import Setting
from elastocal.measurements import Measurements

Array = NDArray[np.float64]

CHANGE_TIMES = 120  # at most; more moments are refined after the search
TIME_CONSTANTS = 8
HIGHEST_ORDER, LOWEST_ORDER = 600.0, 2.5
# Step of the orders in units of 1/range(q): half a step off, a ripple keeps 0.95 of its size.
ORDER_STEP = 1.5
RANGE_VALUES = 25
MOST_POINTS = 20_000  # of several settings together
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
    """Grid of a hypothesis' settings for these visits; one empty point where it has none.

    Of several settings it holds every combination.  Where those are more than MOST_POINTS, each
    setting is tried at fewer values, and its step grows with their distance.
    """
    axes = [_axis(setting, hypothesis.where, visits) for setting in hypothesis.settings]
    if not axes:
        return Grid(np.zeros((1, 0)), np.zeros(1), np.zeros((1, 0)))
    if len(axes) == 1:
        return axes[0]
    share = min(1.0, MOST_POINTS / math.prod(len(axis.values) for axis in axes))
    return _product([_thinned(axis, share ** (1 / len(axes))) for axis in axes])


def _axis(setting: Setting, where: str, visits: Measurements) -> Grid:
    """Values (G, 1) of one setting."""
    if setting.kind == "order":
        return _orders(setting, where, visits)
    if setting.kind == "range":
        values = np.linspace(setting.lower, setting.upper, RANGE_VALUES)
    elif setting.kind == "change_time":
        values = change_times(_time(visits))
    else:
        span = float(np.ptp(_time(visits)))
        low, high = max(span / 20, setting.lower), min(3 * span, setting.upper)
        values = np.geomspace(min(low, high), high, TIME_CONSTANTS)
    step = np.gradient(values) if len(values) > 1 else np.ones(1)
    return Grid(values[:, None], np.full(len(values), -np.log(len(values))), step[:, None])


def _time(visits: Measurements) -> Array:
    assert visits.time is not None  # else the hypothesis is not tested
    return visits.time


def _product(axes: list[Grid]) -> Grid:
    """Every combination of the axes' values; the priors of settings are independent."""
    chosen = np.indices([len(axis.values) for axis in axes]).reshape(len(axes), -1)
    picked = list(zip(axes, chosen, strict=True))
    return Grid(
        np.concatenate([axis.values[k] for axis, k in picked], axis=1),
        np.sum([axis.log_prior[k] for axis, k in picked], axis=0),
        np.concatenate([axis.step[k] for axis, k in picked], axis=1),
    )


def _thinned(axis: Grid, share: float) -> Grid:
    """The axis at `share` of its values, from first to last."""
    count = max(2, int(len(axis.values) * share))
    if count >= len(axis.values):
        return axis
    kept = np.linspace(0, len(axis.values) - 1, count).round().astype(int)
    prior = np.exp(axis.log_prior[kept])
    wider = len(axis.values) / count
    return Grid(axis.values[kept], np.log(prior / prior.sum()), axis.step[kept] * wider)


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


def _orders(setting: Setting, where: str, visits: Measurements) -> Grid:
    """Orders of a joint's angle; at another place than a joint, of the one that moves most."""
    moved = np.ptp(visits.q, axis=0)
    spread = max(float(moved[index(where)] if where.startswith("joint") else moved.max()), 1e-3)
    step = ORDER_STEP / spread
    values = np.arange(LOWEST_ORDER, HIGHEST_ORDER, step)
    known = [] if setting.default is None else [setting.default]
    share = KNOWN_SHARE if known else 0.0
    prior = np.concatenate(
        [np.full(len(known), share), np.full(len(values), (1 - share) / len(values))]
    )
    return Grid(
        np.concatenate([known, values])[:, None], np.log(prior), np.full((len(prior), 1), step)
    )
