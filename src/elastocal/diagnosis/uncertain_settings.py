"""What an effect's searched constants may be instead, and what that does to fresh poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.alike import signal_of
from elastocal.diagnosis.columns import is_driven
from elastocal.diagnosis.confirm import Change
from elastocal.diagnosis.gram import Grams
from elastocal.diagnosis.heldout import squared_lengths
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import Item, ModelSet, beside
from elastocal.diagnosis.projection import project
from elastocal.diagnosis.scene import Scene

Array = NDArray[np.float64]

MOST = 6  # settings that are kept
WORTH = 0.02  # probability from which one is


def other_settings(scene: Scene, chosen: ModelSet, k: int) -> list[tuple[Item, float]]:
    """Item k at each of its plausible settings, its own first, and their probabilities.

    Only the item itself where it has none.
    """
    item = chosen.items[k]
    what = item.what
    if not isinstance(what, Hypothesis) or not is_driven(what) or not what.settings:
        return [(item, 1.0)]
    data = beside(scene, chosen, k)
    grid = scene.grids[what.name, what.where]
    grams = Grams(scene, data, project(data, chosen.noise))
    own = float(grams.of_hypothesis(what, item.settings[None]).evidence(item.scales)[0])
    each = grams.of_hypothesis(what).evidence(item.scales)
    # The chosen one stands for the point of the grid that it was refined from.
    nearest = grid.nearest(item.settings)
    each[nearest] = own
    share = np.exp(each - each.max())
    share /= share.sum()
    others = [int(i) for i in np.argsort(-share)[:MOST] if share[i] > WORTH and i != nearest]
    out = [(item, float(share[nearest]))]
    return out + [(replace(item, settings=grid.values[i]), float(share[i])) for i in others]


def between_visits(scene: Scene, chosen: ModelSet, k: int) -> Change:
    """How far readings on the wrong side of a change are off, and how many there may be.

    A change between two visits is put into the middle of the pause; fresh readings that fall
    between that and the true moment, a share of up to half the pause over the duration, are
    off by the whole change.  Nothing for effects that do not change once.
    """
    what = chosen.items[k].what
    time = scene.base.seen.table.time
    kinds = [s.kind for s in what.settings] if isinstance(what, Hypothesis) else []
    if "change_time" not in kinds or time is None:
        return Change()
    moments = np.unique(time)
    changed = chosen.items[k].settings[kinds.index("change_time")]
    later = int(np.searchsorted(moments, changed))
    if not 0 < later < len(moments):
        return Change()
    pause = float(moments[later] - moments[later - 1]) / float(np.ptp(moments))
    squares, count = squared_lengths(scene.data, signal_of(scene, chosen, k))
    shown = squares > 0
    per_reading = float(squares[shown].sum() / max(count[shown].sum(), 1))
    return Change(per_reading, pause / 2, float(scene.present.sum() / len(scene.present)))
