"""Estimates of a set: what its columns stand for, and the fit of the model with them in it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from elastocal.diagnosis.baseline import Baseline, fit_baseline
from elastocal.diagnosis.extend import extended
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import Item, ModelSet
from elastocal.diagnosis.scene import Scene


def linear_estimates(scene: Scene, chosen: ModelSet) -> dict[str, float]:
    """Posterior means of the known items' parameters by name."""
    out: dict[str, float] = {}
    for item, span in zip(chosen.items, chosen.spans, strict=True):
        if isinstance(item.what, Hypothesis):
            values = chosen.at.beta[span] * scene.sizes[item.what.name, item.what.where]
            for p, v in zip(item.what.parameters, values, strict=True):
                out[f"{item.what.where}.{p.key}"] = float(v) + p.nominal
    return out


def fit_extended(scene: Scene, chosen: ModelSet, items: Sequence[Item]) -> Baseline:
    """The nonlinear fit of the model with `items` of the set in it, from the linear estimate."""
    base = scene.base
    model = extended(base.model, items)
    start = dict(zip(base.model.names, base.x, strict=True)) | linear_estimates(scene, chosen)
    x0 = np.array([start.get(p.name, p.nominal) for p in model.parameters])
    return fit_baseline(model, base.seen.table, x0=x0)
