"""The nonlinear fit of the model with the found effects in it, weighted by the fitted noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import Item
from elastocal.diagnosis.noise import NoiseValues, NoisyData
from elastocal.diagnosis.projection import project
from elastocal.diagnosis.result import FittedParameter
from elastocal.diagnosis.scene import Scene, away, widths
from elastocal.manipulator.model import Regression

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Posterior:
    """Values x (parameters,) of a model, and `spread` (parameters, k): x + spread·z with standard
    normal z (k,) is a draw from what the data leave possible."""

    base: Baseline
    x: Array
    spread: Array

    @property
    def std(self) -> Array:
        return np.asarray(np.linalg.norm(self.spread, axis=1))


@dataclass(frozen=True)
class Linear:
    """A model about the fit `base`: readings as a scene's, scaled columns, and where x = 0 is.

    `further` (rows, k) columns of constants that are not among the model's parameters, scaled to
    their prior deviations, stand last: at zero in x.
    """

    base: Baseline
    data: NoisyData
    width: Array
    centre: Array

    @classmethod
    def of(
        cls,
        scene: Scene,
        base: Baseline,
        further: Array | None = None,
        prior: Mapping[str, float] | None = None,
        at: Regression | None = None,
    ) -> Linear:
        """`prior` holds standard deviations of parameters by name, where they are not wide; `at`
        spares evaluating the model at the fit."""
        seen = base.seen
        known = prior or {}
        names = base.model.names
        width = np.array([known.get(n, w) for n, w in zip(names, widths(base), strict=True)])
        at = at or base.model.regressor(seen.table, base.x, observations=seen)
        B = at.B * width
        residual = at.residual + B @ (away(base) / width)
        centre = base.x - away(base)
        if further is not None:
            k = further.shape[1]
            B, width = np.hstack([B, further]), np.append(width, np.ones(k))
            centre = np.append(centre, np.zeros(k))
        pack, size = scene.blocks.pack, seen.size
        data = replace(
            scene.data, r=pack(residual.reshape(-1, size, 1))[:, :, 0],
            X=pack(B.reshape(-1, size, B.shape[1])), precision=np.ones(B.shape[1]),
        )  # fmt: skip
        return cls(base, data, width, centre)

    def posterior(self, noise: NoiseValues) -> Posterior:
        """One step from the fit to the readings, under `noise`."""
        fit = project(self.data, noise)
        spread = linalg.solve_triangular(fit.factor, np.diag(self.width), lower=True).T
        return Posterior(self.base, self.centre + self.width * fit.beta, spread)


def refit(fitted: Posterior, items: list[Item]) -> dict[
    tuple[str, str], tuple[FittedParameter, ...]
]:  # fmt: skip
    """Parameters of the known `items` with standard deviations, by effect and place."""
    std = fitted.std
    out: dict[tuple[str, str], list[FittedParameter]] = {}
    for k, p in enumerate(fitted.base.model.parameters):
        found = FittedParameter(p.name, float(fitted.x[k]), p.unit, float(std[k]))
        out.setdefault((p.effect, p.where), []).append(found)
    keys = [(i.what.name, i.what.where) for i in items if isinstance(i.what, Hypothesis)]
    return {key: tuple(out[key]) for key in keys}
