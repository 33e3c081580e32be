"""The settings with which one rival may imitate the others: its order, its time.

The best in the data so far need not be the best once further poses are measured, when the
diagnosis seeks them anew: what is nearly as good stays possible.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.alike import settings_to_try
from elastocal.diagnosis.gram import Grams
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import Item, packed_columns, with_items
from elastocal.diagnosis.noise import NoiseValues
from elastocal.diagnosis.projection import project
from elastocal.diagnosis.scene import Scene
from elastocal.diagnosis.separate.rivals import RivalSet

Array = NDArray[np.float64]

NEARLY = 4.0  # in d²: two standard deviations
SETTINGS = 6  # of a rival that are tried, at most


def imitations(scene: Scene, noise: NoiseValues, contest: RivalSet) -> tuple[tuple[Item, ...], ...]:
    """Of each rival that has settings the item at those which explain most of another's signal,
    the bests first, then what explains NEARLY as much; of other rivals nothing.

    A signal is a rival's at its estimate; `scene` with only the data so far counting.
    """
    rivals = contest.rivals
    widest = tuple(float(item.scales.max()) for item in contest.beside)
    data = with_items(scene, tuple(contest.beside), widest)
    grams = {}
    for a, item in enumerate(rivals):
        C = data.masked(packed_columns(scene, item))
        at = project(data.with_columns(C, np.ones(C.shape[2])), noise)
        signal = C @ at.beta[data.X.shape[2] :]
        grams[a] = Grams(scene, data, project(replace(data, r=signal), noise))
    return tuple(_of_rival(scene, rivals, b, grams) for b in range(len(rivals)))


def _of_rival(
    scene: Scene, rivals: tuple[Item, ...], b: int, grams: dict[int, Grams]
) -> tuple[Item, ...]:
    what, size = rivals[b].what, float(rivals[b].scales.max())
    others = [a for a in range(len(rivals)) if a != b]
    if not isinstance(what, Hypothesis) or not what.settings or not others:
        return ()
    lists = [settings_to_try(scene, what, rivals[a]) for a in others]
    tried = np.unique(np.vstack([each for each in lists if each is not None]), axis=0)
    explained = np.array([grams[a].of_hypothesis(what, tried).explained(size) for a in others])
    short = explained.max(axis=1, keepdims=True) - explained
    near = np.flatnonzero((short <= NEARLY).any(axis=0))
    evenly = near[np.linspace(0, len(near) - 1, min(SETTINGS, len(near))).round().astype(int)]
    chosen = list(dict.fromkeys([*short.argmin(axis=1), *evenly]))[:SETTINGS]
    return tuple(replace(rivals[b], settings=tried[k]) for k in chosen)
