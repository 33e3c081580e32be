"""Ordered residuals against normal order statistics, with a band that holds for all of them.

The i-th smallest of n standard normal values stands beside its expectation, by Blom's formula

    m_i = Φ⁻¹((i − 3/8) / (n + 1/4))                    (Blom 1958, Statistical Estimates, p. 71)

Its probability U_(i) ~ Beta(i, n + 1 − i).  The band takes the same local level η at every i, so
that it looks as sharply into the tails as into the middle, and η such that all n points together
stay inside with 95 % (Aldor-Noiman et al. 2013, Am. Stat. 67, 249).  A pointwise band would be
left by one point in twenty, neighbours together, and seem to accuse where nothing is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from elastocal.errors import require

Array = NDArray[np.float64]

MOST_POINTS = 200
# Local levels of a simultaneous 5 % in small samples, from 1e5 simulated ones each; between them
# log η is interpolated in log n.
SMALL_N = (8.0, 12.0, 20.0, 32.0, 50.0, 100.0, 200.0)
SMALL_ETA = (0.00880, 0.00661, 0.00471, 0.00371, 0.00295, 0.00219, 0.00173)


@dataclass(frozen=True)
class NormalScores:
    """Points (k,) in ascending order: expected and observed value, and the band at each.

    `n` values were ordered; k ≤ n of them are given, evenly spaced over the expected values.
    `inside` says whether every given point lies in the simultaneous 95 % band.
    """

    n: int
    expected: Array
    observed: Array
    low: Array
    high: Array

    @property
    def inside(self) -> bool:
        return bool(((self.low <= self.observed) & (self.observed <= self.high)).all())

    def to_json(self) -> dict[str, Any]:
        points = {k: getattr(self, k).tolist() for k in ("expected", "observed", "low", "high")}
        return {"n": self.n, "inside": self.inside, **points}


def normal_scores(z: Array, most: int = MOST_POINTS) -> NormalScores:
    """Normal scores of z (n,), which should be standard normal, at most `most` of them.

    Points are chosen evenly over the expected values, so both tails keep their single values.
    Raises InputError for fewer than 8 values, or where one is not finite.
    """
    z = np.asarray(z, dtype=np.float64)
    n = z.size
    require(
        z.ndim == 1 and n >= SMALL_N[0] and bool(np.isfinite(z).all()) and most >= 2,
        f"normal scores need at least 8 finite values and 2 points; found shape {z.shape}, "
        f"{int(np.isfinite(z).sum())} finite, {most} points",
    )
    rank = np.arange(1, n + 1)
    if n > most:
        end = special.ndtri((n - 0.375) / (n + 0.25))
        share = special.ndtr(np.linspace(-end, end, most))
        rank = np.unique(np.clip(np.rint(share * (n + 0.25) + 0.375), 1, n).astype(np.int64))
    half = simultaneous_level(n) / 2
    return NormalScores(
        n=n,
        expected=special.ndtri((rank - 0.375) / (n + 0.25)),
        observed=np.partition(z, rank - 1)[rank - 1] if n > most else np.sort(z),
        low=special.ndtri(special.betaincinv(rank, n + 1 - rank, half)),
        # The complement of the mirrored point: 1 − u near one has no digits to spare.
        high=-special.ndtri(special.betaincinv(n + 1 - rank, rank, half)),
    )


def simultaneous_level(n: int) -> float:
    """Local level η at which all n order statistics stay in their bands with 95 %.

    From n = 200 on, η = −ln 0.95 / (2 ln n · lln n) · (1 − 1.3 llln n / lln n), with lln = ln ln
    (Weine, McPeek and Abney 2023, J. Stat. Softw. 106(10)); below, a table.
    """
    if n < SMALL_N[-1]:
        return float(np.exp(np.interp(np.log(n), np.log(SMALL_N), np.log(SMALL_ETA))))
    log = np.log(n)
    twice = np.log(log)
    return float(-np.log(0.95) / (2 * log * twice) * (1 - 1.3 * np.log(twice) / twice))
