"""The default estimate: faulty readings set apart, noise model chosen, x by its weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from elastocal.errors import ElastocalError
from elastocal.identification.outlier import FALSE_ALARM
from elastocal.identification.variance.choose import NoiseFit, estimate_noise
from elastocal.identification.variance.judge import beyond_noise, own_noise
from elastocal.identification.variance.readings import Readings

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROUNDS = 12
FEWEST_GOOD = 0.5


@dataclass(frozen=True)
class Verdict:
    """The noise found from the `good` readings (N,); the others lie beyond it."""

    noise: NoiseFit
    good: Mask


def settle(readings: Readings, kind: str = "auto", good: Mask | None = None) -> Verdict:
    """Noise and good readings that agree with each other, starting from `good` (default all).

    The noise model is fitted to the good readings, every reading is judged by the error of its
    prediction from them (false-alarm rate 1 % for the whole table), and so on.  Starting from
    all, errors that hide each other may stay: start from a robust fit.  A set that comes back
    after others ends the search: readings that were good at any time of that round are kept.

    Faulty readings that are taken back bend the fit, so that more of them seem to fit.  Where the
    better half of all readings is left worse explained than by an earlier set, beyond what chance
    allows, that set stands.
    """
    good = np.ones(len(readings), dtype=bool) if good is None else good
    noise = estimate_noise(readings.take(good), kind)
    own = np.asarray(np.linalg.inv(own_noise(noise.fit, readings)[0]), dtype=np.float64)
    visited = [(_misfit(noise, readings, own), good, noise)]
    for _ in range(ROUNDS):
        updated = ~beyond_noise(noise, readings, good, FALSE_ALARM)
        if np.array_equal(updated, good) or updated.mean() < FEWEST_GOOD:
            break
        masks = [mask for _, mask, _ in visited]
        again = next((k for k, mask in enumerate(masks) if np.array_equal(mask, updated)), None)
        if again is not None:
            updated = np.logical_or.reduce(masks[again:])
        try:
            noise = estimate_noise(readings.take(updated), noise.kind)
        except ElastocalError:
            break  # so few readings cannot judge the others
        good = updated
        visited.append((_misfit(noise, readings, own), good, noise))
        if again is not None:
            break
    last, best = visited[-1], min(visited, key=lambda v: v[0])
    half = (len(readings) // 2 + 1) * readings.size
    if last[0] > best[0] * stats.f.isf(FALSE_ALARM, half, half):
        last = best
    _, good, noise = last
    if len(visited) > 1 and kind == "auto":
        noise = estimate_noise(readings.take(good), kind)
    return Verdict(noise, good)


def _misfit(noise: NoiseFit, readings: Readings, precision: Array) -> float:
    """Sum of the smaller half of the squared residuals, in units of `precision` (N, size, size)."""
    r = readings.e - readings.B @ noise.x
    squared = np.einsum("ni,nij,nj->n", r, precision, r)
    return float(np.sort(squared)[: len(squared) // 2 + 1].sum())
