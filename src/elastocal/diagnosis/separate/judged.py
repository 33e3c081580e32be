"""The contests of a diagnosis over a pool, and which of their rivals any poses can tell apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.stats import norm

from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.separate.contest import Contest
from elastocal.diagnosis.separate.pool import Pool
from elastocal.diagnosis.separate.result import RivalPair
from elastocal.diagnosis.separate.rivals import Suspects
from elastocal.diagnosis.separate.rows import campaign_of, rows_of

# A pair that all candidates together would not tell apart with this probability is inseparable.
HOPE = 0.9


def contests_of(base: Baseline, pool: Pool, suspects: Suspects, seed: int) -> list[Contest]:
    """The contests of the diagnosis, with the candidates of a pool."""
    campaign = campaign_of(base, pool, suspects.hypotheses, suspects.diagnosis)
    sets = list(suspects.sets)
    if suspects.unknown:
        sets.append(suspects.unknown_set(campaign.so_far, campaign.noise))
    return [Contest.of(s, rows_of(campaign, s), np.random.default_rng(seed)) for s in sets]


def judged(
    contests: Sequence[Contest],
) -> tuple[list[Contest], dict[tuple[str, str], float]]:
    """Each contest in classes that the whole pool could tell apart, and the pairs that it could
    not, with their distance in all of it."""
    out, hopeless = [], {}
    for c in contests:
        d = c.distances(c.squared(c.gram(range(len(c.rows.pool)))))
        near = d < 2 * float(norm.ppf(HOPE))
        classes = connected_components(near, directed=False)[1].astype(np.int64)
        out.append(c.in_classes(classes))
        names = c.rivals.names
        for a, b in zip(*np.nonzero(np.triu(near, 1)), strict=True):
            hopeless[names[a], names[b]] = float(d[a, b])
    return out, hopeless


def together(c: Contest) -> Iterator[tuple[str, ...]]:
    """The rivals of each class that has several."""
    for k in np.unique(c.classes):
        names = [name for name, own in zip(c.rivals.names, c.classes, strict=True) if own == k]
        if len(names) > 1:
            yield tuple(names)


def pairs_of(contests: Sequence[Contest], chosen: Sequence[int]) -> tuple[RivalPair, ...]:
    out = []
    for c in contests:
        before, after = c.distances(c.before), c.distances(c.squared(c.gram(chosen)))
        names = c.rivals.names
        for a, b in zip(*np.triu_indices(len(names), 1), strict=True):
            out.append(RivalPair(names[a], names[b], float(before[a, b]), float(after[a, b])))
    return tuple(out)
