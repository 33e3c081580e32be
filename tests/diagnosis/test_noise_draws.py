"""Draws of the noise against its likelihood on a grid, and what no reading shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.diagnosis_data import random_blocks, random_data

from elastocal.diagnosis import (
    NoiseValues,
    NoisyData,
    fit_noise,
    likelihood,
    noise_draws,
)

N = 300


def data(seed: int = 4) -> NoisyData:
    """One joint, so that the posterior can be laid on a grid."""
    blocks = random_blocks(seed, sizes=(4,) * 12)
    made = random_data(seed, blocks, p=3, joints=1)
    rng = np.random.default_rng(seed)
    shaken = (made.G @ (1e-5 * rng.normal(size=(12, 1, 1))))[..., 0]
    return replace(made, r=made.r + shaken)


def on_a_grid(made: NoisyData, at: NoiseValues) -> tuple[float, float]:
    """Mean and deviation of the joint's logarithm, the others integrated out."""
    centre = at.logs()
    log = np.linspace(-5, 2, 41)
    coarse = np.linspace(-1.5, 1.5, 7)
    weight = np.zeros(len(log))
    values = np.array([
        [-0.5 * likelihood(made, NoiseValues.of_logs(centre + np.array([a, 2 * c, j])))[0]
         for a in coarse * 0.2 for c in coarse]
        for j in log
    ])  # fmt: skip
    weight = np.exp(values - values.max()).sum(axis=1)
    weight /= weight.sum()
    mean = float(weight @ log)
    return centre[2] + mean, float(np.sqrt(weight @ (log - mean) ** 2))


def test_draws_are_spread_as_the_likelihood_is() -> None:
    made = data()
    best = fit_noise(made)
    drawn = noise_draws(made, best, N, np.random.default_rng(0))
    logs = np.array([d.logs()[2] for d in drawn])
    mean, deviation = on_a_grid(made, best)
    assert logs.mean() == pytest.approx(mean, abs=0.35 * deviation)
    assert logs.std() == pytest.approx(deviation, rel=0.35)
