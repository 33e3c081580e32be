"""How far the gap shrinks on poses that had no part in choosing or fitting the effect.

The error of a model at a fresh pose is its prediction less the truth, without noise:

    e(θ*) = f(q, x̂) − h(q, θ*),    θ* ~ posterior given all data,

where f is the model before and after the effect is added, each fitted by the instrument's noise
as a calibration would, and h what is held to be the truth: at times a rival or another constant,
as probable as each is, which charges the interval for the selection.  The remaining fraction is
the ratio of the rms errors over a set of FRESH poses, drawn anew for every θ* from a population
that is itself known from the campaign's poses only (Bayesian bootstrap, Rubin 1981).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DRAWS = 400
FRESH = 100  # poses of the fresh set that the intervals are for


@dataclass(frozen=True)
class Shrinkage:
    """Fraction by which the fresh-pose error falls: best value, `ci90` and `ci95`."""

    reduction: float
    ci90: tuple[float, float]
    ci95: tuple[float, float]


@dataclass(frozen=True)
class Truth:
    """What may be true: errors (rows, components) of the models `before` and `after` at fresh
    poses if it is, at its most probable values; the truth moves by `spread` (rows, components, k)
    times standard normal numbers.  `pose` (rows,) numbers the fresh pose of each reading."""

    before: Array
    after: Array
    spread: Array
    pose: NDArray[np.int64]
    probability: float


@dataclass(frozen=True)
class Change:
    """A change that happened in a pause between visits: how far (m² per reading) one on its wrong
    side is off, the largest `share` of the time that may be on it, and the number of `visits` of
    a pose: the readings of a visit are on the same side."""

    square: float = 0.0
    share: float = 0.0
    visits: float = 1.0


def shrinkage(
    truths: Sequence[Truth],
    measured: int,
    unnamed: float,
    change: Change,
    rng: np.random.Generator,
) -> Shrinkage:
    """Reduction of the rms error from before to after, one of `truths` being true.

    `measured` is the number of poses that tell what poses there are.

    `unnamed` (m²) is the mean squared length of what is known to be there without a name: neither
    model has it, and it is taken to be as large at fresh poses as it was at the measured ones.
    """
    weights = np.array([t.probability for t in truths])
    which = rng.choice(len(truths), DRAWS, p=weights / weights.sum())
    parts = [
        _reductions(truths[k], int((which == k).sum()), measured, unnamed, change, rng)
        for k in np.unique(which)
    ]
    drawn = np.concatenate(parts)
    low95, low90, middle, high90, high95 = np.quantile(drawn, [0.025, 0.05, 0.5, 0.95, 0.975])
    return Shrinkage(float(middle), (float(low90), float(high90)), (float(low95), float(high95)))


def _reductions(
    truth: Truth, n: int, measured: int, unnamed: float, change: Change, rng: np.random.Generator
) -> Array:
    """(n,) draws."""
    moved = truth.spread @ rng.normal(size=(truth.spread.shape[2], n))
    poses, at, count = np.unique(truth.pose, return_inverse=True, return_counts=True)
    share = rng.dirichlet(np.full(len(poses), measured / len(poses)), n)
    chosen = rng.multinomial(FRESH, share)
    mean = []
    for error in (truth.before, truth.after):
        squares = ((error[:, :, None] - moved) ** 2).sum(axis=1)
        total = np.zeros((len(poses), n))
        np.add.at(total, at, squares)
        readings = chosen @ count
        mean.append((chosen.T * total).sum(axis=0) / readings + unnamed)
    times = round(FRESH * change.visits)
    late = rng.binomial(times, change.share * rng.random(n)) / times
    mean[1] = mean[1] + late * change.square
    return np.asarray(1 - np.sqrt(mean[1] / np.maximum(mean[0], 1e-300)))
