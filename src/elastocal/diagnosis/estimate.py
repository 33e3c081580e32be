"""Linear estimates of a set: posterior means of what its columns stand for."""

from __future__ import annotations

from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import Item, ModelSet, columns_of
from elastocal.diagnosis.scene import Scene


def linear_estimates(scene: Scene, chosen: ModelSet) -> dict[str, float]:
    """Linear estimates of the known items' parameters by name."""
    mean = chosen.at.beta
    first = scene.data.X.shape[2]
    out: dict[str, float] = {}
    for item in chosen.items:
        count = item_width(scene, item)
        if isinstance(item.what, Hypothesis):
            size = scene.sizes[item.what.name, item.what.where]
            values = mean[first : first + count] * size
            for p, v in zip(item.what.parameters, values, strict=True):
                out[f"{item.what.where}.{p.key}"] = float(v) + p.nominal
        first += count
    return out


def item_width(scene: Scene, item: Item) -> int:
    """Number of columns of an item."""
    if isinstance(item.what, Hypothesis):
        return len(item.what.parameters)
    return columns_of(item.what)
