"""Rivals that the verdict has no room to name: what one of those named may also be.

A set names three effects at most.  Whichever of them is at work, further poses leave open what
imitates it, whether it was listed or not; a plan that did not know of it would promise too much.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from elastocal.diagnosis.alike import distances, item_key
from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import Item, fit_set
from elastocal.diagnosis.result import Diagnosis
from elastocal.diagnosis.scene import scene_of
from elastocal.diagnosis.separate.noise import left_out, noise_found
from elastocal.diagnosis.separate.rivals import CHANCE, RivalSet
from elastocal.diagnosis.verdict import ALIKE

# Alike, or so near (twice the deviate of 0.97, what a plan is to reach) that their evidence
# leaves them a chance; so many at most, those named among them.
NEAR, MOST = 3.76, 10


def with_neighbours(
    base: Baseline, diagnosis: Diagnosis, sets: tuple[RivalSet, ...],
    known: Mapping[tuple[str, str], tuple[Item, float]],
) -> tuple[RivalSet, ...]:  # fmt: skip
    """The sets with what each of their rivals may also be.

    `known`: the items of the diagnosis with their probabilities.
    """
    if not sets:
        return ()
    hypotheses = [i.what for i, _ in known.values() if isinstance(i.what, Hypothesis)]
    scene = scene_of(base, hypotheses)
    scene, noise = scene.without(left_out(base, diagnosis)), noise_found(diagnosis)
    out = []
    for s in sets:
        near = dict.fromkeys(known, np.inf)
        for rival in s.rivals:
            found = distances(scene, fit_set(scene, (rival, *s.beside), noise), 0)[1]
            near |= {key: min(near[key], d) for key, d in found.items()}
        taken = {item_key(item) for item in (*s.rivals, *s.beside)}
        free = [
            key
            for key, (_, p) in known.items()
            if key not in taken and (near[key] < ALIKE or (near[key] < NEAR and p >= CHANCE))
        ]
        free = sorted(free, key=lambda key: near[key])[: max(MOST - len(s.rivals), 0)]
        rivals = [*s.rivals, *(known[key][0] for key in free)]
        # Those named have their probability given that there is something, as these need, too.
        something = max(1 - diagnosis.probability_nothing, 1e-9)
        named = [known[item_key(item)][1] for item in s.rivals]
        p = [*named, *(known[key][1] / something for key in free)]
        out.append(RivalSet.of(rivals, p, s.beside))
    return tuple(out)
