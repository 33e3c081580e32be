"""The fewest candidates that tell the rivals apart: greedy addition, then exchange.

The design module's criteria are functions of one information matrix, convex and homogeneous of
degree −1, which its bounds rest on.  Distances of rivals are neither: they start from data in
hand, and a pair's distance is a difference of two informations.  So this search is its own: one
candidate more at a time until they are enough, each then exchanged for the best other until none
helps, and what has become needless left out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.separate.contest import Contest

Array = NDArray[np.float64]

ENOUGH = 0.97  # probability of the right answer from which no further pose is asked for
ROUNDS = 3  # of exchange, at most
WORTH = 1e-3  # relative fall of the error that an exchange is made for
RANDOM_DRAWS = 32


def fewest(contests: Sequence[Contest], most: int, enough: float = ENOUGH) -> list[int]:
    """Candidates, at most `most`, with which the right one is named with a probability of
    `enough`; `most` where fewer do not reach it."""
    chosen: list[int] = []
    while len(chosen) < min(most, len(contests[0].rows.pool)):
        chosen.append(_best(contests, chosen)[0])
        if expected(contests, chosen) >= enough:
            break
    _exchange(contests, chosen)
    while len(chosen) > 1 and expected(contests, chosen) >= enough:
        fewer = _without_least(contests, chosen)
        _exchange(contests, fewer)
        if expected(contests, fewer) < enough:
            break
        chosen = fewer
    return chosen


def expected(contests: Sequence[Contest], chosen: Sequence[int]) -> float:
    """Probability that the right one of every set is named after the chosen visits."""
    each = [c.probability(c.squared(c.gram(chosen))) for c in contests]
    return float(np.prod(each))


def expected_of_random(contests: Sequence[Contest], n: int, rng: np.random.Generator) -> float:
    """The same for as many candidates drawn at random: the mean of RANDOM_DRAWS draws."""
    N = len(contests[0].rows.pool)
    picks = [rng.choice(N, size=n, replace=False).tolist() for _ in range(RANDOM_DRAWS)]
    return float(np.mean([expected(contests, pick) for pick in picks]))


def _best(contests: Sequence[Contest], chosen: Sequence[int]) -> tuple[int, float]:
    """The candidate not chosen yet that lowers the error most, and the error with it."""
    error = sum((c.error_bound(c.squared_with_each(c.gram(chosen))) for c in contests), 0.0)
    error = np.array(error)
    error[list(chosen)] = np.inf
    best = int(np.argmin(error))
    return best, float(error[best])


def _without_least(contests: Sequence[Contest], chosen: list[int]) -> list[int]:
    """All but the one without which the error grows least."""
    fewer = [chosen[:k] + chosen[k + 1 :] for k in range(len(chosen))]
    return min(fewer, key=lambda left: _error(contests, left))


def _error(contests: Sequence[Contest], chosen: Sequence[int]) -> float:
    return sum(float(c.error_bound(c.squared(c.gram(chosen)))) for c in contests)


def _exchange(contests: Sequence[Contest], chosen: list[int]) -> None:
    """Replace candidates in place while another one is better."""
    for _ in range(ROUNDS if len(chosen) > 1 else 0):
        changed = False
        for k, own in enumerate(list(chosen)):
            others = chosen[:k] + chosen[k + 1 :]
            best, error = _best(contests, others)
            if best == own:
                continue
            if error < (1 - WORTH) * _error(contests, chosen):
                chosen[k], changed = best, True
        if not changed:
            break
