"""The settings with which one rival imitates another best: its order, its time."""

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
from elastocal.diagnosis.separate_rivals import RivalSet

Array = NDArray[np.float64]


def best_imitations(
    scene: Scene, noise: NoiseValues, contest: RivalSet
) -> dict[tuple[int, int], Item]:
    """(a, b) → rival b at the settings that explain most of rival a's signal.

    Only where b has settings; the signal is a's at its estimate.  `scene` with only the data so
    far counting.
    """
    searched = {
        b: item.what
        for b, item in enumerate(contest.rivals)
        if isinstance(item.what, Hypothesis) and item.what.settings
    }
    widest = tuple(float(item.scales.max()) for item in contest.beside)
    data = with_items(scene, tuple(contest.beside), widest)
    out: dict[tuple[int, int], Item] = {}
    for a, item in enumerate(contest.rivals):
        others = {b: h for b, h in searched.items() if b != a}
        if not others:
            continue
        C = data.masked(packed_columns(scene, item))
        both = data.with_columns(C, np.ones(C.shape[2]))
        at = project(both, noise)
        signal = C @ at.beta[data.X.shape[2] :]
        grams = Grams(scene, data, project(replace(data, r=signal), noise))
        for b, h in others.items():
            tried = settings_to_try(scene, h, item)
            assert tried is not None  # it has settings
            explained = grams.of_hypothesis(h, tried).explained(
                float(contest.rivals[b].scales.max())
            )
            best = tried[int(np.argmax(explained))]
            out[a, b] = replace(contest.rivals[b], settings=best)
    return out
