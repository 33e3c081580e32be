"""Which other effects would look the same in these poses: what no size of noise can tell apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.gram import Grams, scales_of
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import Item, ModelSet, beside, packed_columns
from elastocal.diagnosis.projection import project
from elastocal.diagnosis.scene import Scene

Array = NDArray[np.float64]

PLAUSIBLE = 5.0


def signal_of(scene: Scene, chosen: ModelSet, k: int) -> Array:
    """What item k does to the readings (C, m) at its estimate."""
    columns = packed_columns(scene, chosen.items[k])
    return scene.data.masked(columns @ chosen.at.beta[chosen.spans[k]])


def distances(scene: Scene, chosen: ModelSet, k: int) -> tuple[float, dict[tuple[str, str], float]]:
    """d of item k from nothing, and from each other hypothesis that the data could mean instead.

    d² = min over β, γ of |v − Xβ − Cγ|²_V⁻¹ + |γ|²/s² with the item's signal v, the rival's
    columns C at its best settings and s = PLAUSIBLE times the widest of the size prior: in
    standard deviations.  A rival larger than usual is less probable, but it is no less alike.
    """
    v, data = signal_of(scene, chosen, k), beside(scene, chosen, k)
    at = project(replace(data, r=v), chosen.noise)
    grams = Grams(scene, data, at)
    whole = float((v * at.u).sum())
    out: dict[tuple[str, str], float] = {}
    for h in scene.hypotheses:
        if h is chosen.items[k].what:
            continue
        found = grams.of_hypothesis(h, settings_to_try(scene, h, chosen.items[k]))
        s = PLAUSIBLE * float(scales_of(h).max())
        explained = float(found.explained(s).max())
        out[h.name, h.where] = float(np.sqrt(max(whole - explained, 0.0)))
    return float(np.sqrt(max(whole, 0.0))), out


def settings_to_try(scene: Scene, rival: Hypothesis, item: Item) -> Array | None:
    """Settings (G, …) at which a rival may imitate an item: those of the search and, where both
    have the same kind of constant, the item's own, which was refined between them.  None where
    the rival has none."""
    what = item.what
    if not rival.settings:
        return None
    values = scene.grids[rival.name, rival.where].values
    if not isinstance(what, Hypothesis):
        return values
    alike = [s.kind for s in rival.settings] == [s.kind for s in what.settings]
    within = alike and all(
        s.lower <= v <= s.upper for s, v in zip(rival.settings, item.settings, strict=True)
    )
    return np.vstack([values, item.settings]) if within else values


def item_key(item: Item) -> tuple[str, str]:
    """(effect, place) of a known item."""
    assert isinstance(item.what, Hypothesis)
    return item.what.name, item.what.where
