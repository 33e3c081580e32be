"""Which other effects would look the same in these poses: what no size of noise can tell apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.gram import Grams, scales_of
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import Item, ModelSet, fit_columns, packed_columns
from elastocal.diagnosis.noise import NoisyData, project
from elastocal.diagnosis.scene import Scene

Array = NDArray[np.float64]

PLAUSIBLE = 5.0


def signal_of(scene: Scene, chosen: ModelSet, k: int) -> tuple[Array, NoisyData]:
    """What item k does to the readings (C, m) at its estimate, and the data without the item."""
    scales = chosen.scales
    base = fit_columns(
        scene, replace(chosen, items=chosen.without(k)), scales[:k] + scales[k + 1 :]
    )
    at = chosen.at
    mean = at.beta
    columns = [packed_columns(scene, item) for item in chosen.items]
    widths = [C.shape[2] for C in columns]
    stop = len(mean) - sum(widths[k + 1 :])
    return scene.data.masked(columns[k] @ mean[stop - widths[k] : stop]), base


def distances(scene: Scene, chosen: ModelSet, k: int) -> tuple[float, dict[tuple[str, str], float]]:
    """d of item k from nothing, and from each other hypothesis that the data could mean instead.

    d² = min over β, γ of |v − Xβ − Cγ|²_V⁻¹ + |γ|²/s² with the item's signal v, the rival's
    columns C at its best settings and s = PLAUSIBLE times the widest of the size prior: in
    standard deviations.  A rival larger than usual is less probable, but it is no less alike.
    """
    v, data = signal_of(scene, chosen, k)
    at = project(replace(data, r=v), chosen.noise)
    grams = Grams(scene, data, at)
    whole = float((v * at.u).sum())
    out: dict[tuple[str, str], float] = {}
    for h in scene.hypotheses:
        if h is chosen.items[k].what:
            continue
        found = grams.of_hypothesis(h)
        s = PLAUSIBLE * float(scales_of(h).max())
        explained = (s**2 * found.beta**2 / (1 + s**2 * found.lam)).sum(axis=1).max()
        out[h.name, h.where] = float(np.sqrt(max(whole - float(explained), 0.0)))
    return float(np.sqrt(max(whole, 0.0))), out


def item_key(item: Item) -> tuple[str, str]:
    """(effect, place) of a known item."""
    assert isinstance(item.what, Hypothesis)
    return item.what.name, item.what.where
