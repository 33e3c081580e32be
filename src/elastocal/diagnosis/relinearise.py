"""Columns anew at the nonlinear fit with a large effect in it, before anything else is sought."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.alike import signal_of
from elastocal.diagnosis.columns import is_driven
from elastocal.diagnosis.estimate import fit_extended
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import ModelSet
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
    base = scene.base
    fitted = fit_extended(scene, chosen, [chosen.items[k] for k in _direct(chosen)])
    model = fitted.model
    x = dict(zip(model.names, fitted.x, strict=True))
    moved = replace(
        base, x=np.array([x[name] for name in base.model.names]), residual=fitted.residual
    )
    fresh = scene_of(moved, list(scene.hypotheses), model, fitted.x)
    # Put back by the scene's own columns, which will have to explain it: those of the equilibrium
    # differ from them by a thousandth, and a large effect is a thousand deviations.
    back = np.zeros((*fitted.residual.reshape(-1, base.seen.size).shape, 1))
    for k in _direct(chosen):
        what = chosen.items[k].what
        assert isinstance(what, Hypothesis)
        # What an effect tries from several starts has no size about any of them.
        starts = what.effect.starts(what.where, model.chain, model.cell)
        open_keys = {key for start in starts for key in start}
        away = [
            0.0 if p.key in open_keys else x[f"{what.where}.{p.key}"] - p.nominal
            for p in what.parameters
        ]
        back[:, :, 0] += fresh.columns.observed(fresh.columns.of(what)) @ np.array(away)
    return replace(
        fresh,
        base=replace(moved, residual=fitted.residual + back.ravel()),
        other_play=scene.other_play,
        data=replace(
            fresh.data,
            r=fresh.data.r + fresh.blocks.pack(back)[:, :, 0],
            left_out=scene.data.left_out,
        ),
    )


def _direct(chosen: ModelSet) -> list[int]:
    return [
        k
        for k, item in enumerate(chosen.items)
        if isinstance(item.what, Hypothesis) and not is_driven(item.what)
    ]


def _rms(scene: Scene, chosen: ModelSet, k: int) -> float:
    signal = signal_of(scene, chosen, k)
    return float(np.sqrt((signal[~scene.data.left_out] ** 2).mean()))
