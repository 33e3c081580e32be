"""The starts from which one rival may imitate another: where a spring would be anchored.

A spring's geometry is sought by the diagnosis from several starts, and only the best so far has
given its columns to the scene.  Once further poses are measured it is sought anew, and what
another start explains of them is no longer told from a rival.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.columns import typical_sizes
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import Item
from elastocal.diagnosis.scene import Scene

Array = NDArray[np.float64]


def columns_of_starts(scene: Scene, item: Item) -> list[Array]:
    """Columns (C, m, k) of an item about each of its starts, per typical size; none without."""
    what, base = item.what, scene.base
    if not isinstance(what, Hypothesis):
        return []
    if not what.effect.starts(what.where, base.model.chain, base.model.cell):
        return []
    out = []
    for rows in scene.columns.from_each_start(what):
        measured = scene.columns.observed(rows)[: base.n_measured]
        out.append(scene.pack(rows) * typical_sizes(what, measured))
    return out
