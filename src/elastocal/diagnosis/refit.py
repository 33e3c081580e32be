"""The nonlinear fit of the model with the found effects in it, weighted by the fitted noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.estimate import fit_extended
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import ModelSet
from elastocal.diagnosis.noise import project
from elastocal.diagnosis.result import FittedParameter
from elastocal.diagnosis.scene import Scene, away, widths

Array = NDArray[np.float64]


def refit(scene: Scene, chosen: ModelSet) -> dict[tuple[str, str], tuple[FittedParameter, ...]]:
    """Parameters of the known items with standard deviations, by effect and place.

    Levenberg–Marquardt on the exact model from the linear estimate, then one step with the full
    covariance of the noise at its end.
    """
    known = [item for item in chosen.items if item.known]
    base = fit_extended(scene, chosen, known)
    model = base.model
    seen, width = base.seen, widths(base)
    at = model.regressor(seen.table, base.x, observations=seen)
    B = at.B.reshape(len(seen.lead), seen.size, -1) * width
    data = scene.data
    residual = at.residual.reshape(-1, seen.size) + B @ (away(base) / width)
    data = replace(
        data, r=scene.blocks.pack(residual[:, :, None])[:, :, 0],
        X=scene.blocks.pack(B), precision=np.ones(B.shape[2]),
    )  # fmt: skip
    fit = project(data, chosen.noise)
    x = base.x - away(base) + width * fit.beta
    std = width * np.linalg.norm(fit.beta_deviation, axis=0)
    out: dict[tuple[str, str], list[FittedParameter]] = {}
    for k, p in enumerate(model.parameters):
        found = FittedParameter(p.name, float(x[k]), p.unit, float(std[k]))
        out.setdefault((p.effect, p.where), []).append(found)
    keys = [(i.what.name, i.what.where) for i in known if isinstance(i.what, Hypothesis)]
    return {key: tuple(out[key]) for key in keys}
