"""Columns anew at the nonlinear fit with a large effect in it, before anything else is sought."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.baseline import fit_baseline
from elastocal.diagnosis.columns import is_driven
from elastocal.diagnosis.estimate import linear_estimates
from elastocal.diagnosis.extend import extended
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import Item, ModelSet, fit_set, packed_columns
from elastocal.diagnosis.scene import Scene, scene_of

Array = NDArray[np.float64]

# Rms signal in m beyond which the products of an effect with the fitted parameters, which it
# moves by a tenth or so, are no longer small beside the noise.
FAR = 2e-4


def is_far(scene: Scene, chosen: ModelSet) -> bool:
    """Whether one of the set's effects that are not mere motions is large."""
    return any(_rms(scene, chosen, k) > FAR for k in _direct(chosen))


def relinearised(scene: Scene, chosen: ModelSet) -> Scene:
    """The scene about the nonlinear fit with the set's known effects in the model.

    The residual is that of the fitted parameters alone: what the effects explain is put back, so
    that sets with and without them are judged on the same footing.
    """
    items = [chosen.items[k] for k in _direct(chosen)]
    base, table = scene.base, scene.base.seen.table
    model = extended(base.model, items)
    start = dict(zip(base.model.names, base.x, strict=True)) | linear_estimates(scene, chosen)
    x0 = np.array([start.get(p.name, p.nominal) for p in model.parameters])
    fitted = fit_baseline(model, table, x0=x0)
    x = dict(zip(model.names, fitted.x, strict=True))
    added = np.array([k for k, name in enumerate(model.names) if name not in base.model.names])
    B = model.regressor(table, fitted.x, added, base.seen).B
    away = np.array([fitted.x[k] - model.parameters[k].nominal for k in added])
    moved = replace(
        base,
        x=np.array([x[name] for name in base.model.names]),
        residual=fitted.residual + B @ away,
    )
    fresh = scene_of(moved, list(scene.hypotheses), model, fitted.x)
    return replace(fresh, data=replace(fresh.data, left_out=scene.data.left_out))


def restarted(scene: Scene, chosen: ModelSet) -> ModelSet:
    """The set fitted anew on another scene."""
    return fit_set(scene, chosen.items, chosen.noise)


def _direct(chosen: ModelSet) -> list[int]:
    return [
        k
        for k, item in enumerate(chosen.items)
        if isinstance(item.what, Hypothesis) and not is_driven(item.what)
    ]


def _rms(scene: Scene, chosen: ModelSet, k: int) -> float:
    item: Item = chosen.items[k]
    assert isinstance(item.what, Hypothesis)
    estimates = linear_estimates(scene, chosen)
    size = scene.sizes[item.what.name, item.what.where]
    amounts = np.array(
        [estimates[f"{item.what.where}.{p.key}"] - p.nominal for p in item.what.parameters]
    )
    units = np.divide(amounts, size, out=np.zeros(len(size)), where=size > 0)
    signal = packed_columns(scene, item) @ units
    used = ~scene.data.left_out
    return float(np.sqrt((signal[used] ** 2).mean()))
