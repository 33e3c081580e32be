"""How the error at poses left out of the fit falls, step by step, and how sure that is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.noise_floor import NoiseValues, NoisyData, project
from elastocal.diagnosis.stated_floor import left_out_residual, squared_lengths
from elastocal.identification.scrutiny import BudgetStep, resampled_rms, stage_of
from elastocal.model.effects.placements import BaseFrame
from elastocal.units import Array

NEW_POSES = 100  # in the set that the intervals of a reduction are for


def rms_with_interval(
    data: NoisyData, packed: Array, rng: np.random.Generator
) -> tuple[float, tuple[float, float]]:
    """3-D rms in m of residuals (C, m) and its 95 % interval by resampling configurations."""
    return resampled_rms(*squared_lengths(data, packed), rng)


def first_steps(
    dataset: DiagnosisData, noise: NoiseValues, rng: np.random.Generator
) -> list[BudgetStep]:
    """The nominal arm, base and markers placed as the baseline left it, and the fitted effects.

    By the weights of an ordinary calibration: the scatter of joints that is fitted beside a missing
    effect is that effect, and weights by it would spare it.
    """
    placed = dataset.blocks.pack(dataset.base.nominal.reshape(-1, dataset.blocks.size, 1))[:, :, 0]
    steps = [BudgetStep(BaseFrame.name, *rms_with_interval(dataset.data, placed, rng))]
    for name, data in _fitted_steps(dataset):
        left = left_out_residual(project(data, noise.of_instrument()))
        steps.append(BudgetStep(name, *rms_with_interval(data, left, rng)))
    return steps


def _fitted_steps(dataset: DiagnosisData) -> Iterator[tuple[str, NoisyData]]:
    """The model's own effects, stage by stage, those of the later step held at nominal."""
    data, effects = dataset.data, {p.name: p.effect for p in dataset.base.model.parameters}
    stage = np.array([stage_of(effects.get(name, name)) for name in dataset.fitted])
    for k, name in ((1, "geometry"), (2, "compliance")):
        if (stage == k).any():
            free = stage <= k
            yield name, replace(data, X=data.X[:, :, free], precision=data.precision[free])


class Shrinkage(NamedTuple):
    """Fraction by which the error at new poses falls: best value, `ci90` and `ci95`."""

    reduction: float
    ci90: tuple[float, float]
    ci95: tuple[float, float]

    @classmethod
    def of(cls, drawn: Array) -> Shrinkage:
        """The median and the intervals of draws (n,)."""
        low95, low90, middle, high90, high95 = np.quantile(
            drawn, [0.025, 0.05, 0.5, 0.95, 0.975]
        ).tolist()
        return cls(middle, (low90, high90), (low95, high95))
