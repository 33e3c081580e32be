"""The evidence of everything that could be added to a model, under one noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.columns import is_driven
from elastocal.diagnosis.evidence import log_sum
from elastocal.diagnosis.generic import Generic
from elastocal.diagnosis.gram import Grams, scales_of
from elastocal.diagnosis.noise import NoiseValues, NoisyData
from elastocal.diagnosis.prior import Prior
from elastocal.diagnosis.projection import Projection, project
from elastocal.diagnosis.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scored:
    """Evidence of one hypothesis or block over the model without it (nats).

    `settings` are its best ones, `best` the evidence at them without the prior of the search;
    `distance` is d of its typical size there, in standard deviations.
    """

    evidence: float
    best: float
    settings: Array
    distance: float


@dataclass(frozen=True)
class Scan:
    """Everything scored under one noise: hypotheses, blocks, and the odds of all together.

    `odds` is the log of the mean evidence over catalogue and blocks, weighted by prior,
    `flipped` (F,) the same for residuals whose configurations had their signs flipped;
    `driver_odds` the largest evidence among the blocks of a driver, and its flips.
    """

    scored: tuple[Scored, ...]
    blocks: tuple[Scored, ...]
    odds: float
    flipped: Array
    driver_odds: dict[str, float]
    driver_flips: dict[str, Array]
    at: Projection
    noise: NoiseValues


def scan(
    scene: Scene, generic: list[Generic], prior: Prior, data: NoisyData, noise: NoiseValues,
    signs: Array,
) -> Scan:  # fmt: skip
    """Score all hypotheses and blocks beside the columns already in `data`.

    `signs` (F, C) of ±1 are the flips.
    """
    at = project(data, noise)
    grams = Grams(scene, data, at, signs)
    scored, blocks = [], []
    total, flips = [], []
    for h, weight in zip(scene.hypotheses, prior.hypotheses, strict=True):
        found = grams.of_hypothesis(h)
        grid = scene.grids[h.name, h.where] if is_driven(h) else None
        log_prior = np.zeros(1) if grid is None else grid.log_prior
        scales = scales_of(h)
        each = found.evidence(scales)
        evidence = float(log_sum(each + log_prior))
        k = int(np.argmax(each + log_prior))
        settings = np.zeros(0) if grid is None else grid.values[k]
        scored.append(Scored(evidence, float(each[k]), settings, float(found.distance[k])))
        total.append(weight + evidence)
        if len(signs):
            flips.append(weight + log_sum(found.flipped(scales) + log_prior))
    drivers: dict[str, list[float]] = {}
    driver_flips: dict[str, list[Array]] = {}
    for g, weight in zip(generic, prior.blocks, strict=True):
        found = grams.of_block(g)
        evidence = float(found.evidence()[0])
        blocks.append(Scored(evidence, evidence, np.zeros(0), float(found.distance[0])))
        total.append(weight + evidence)
        drivers.setdefault(g.driver, []).append(evidence)
        if len(signs):
            flipped = found.flipped()[:, 0]
            flips.append(weight + flipped)
            driver_flips.setdefault(g.driver, []).append(flipped)
    return Scan(
        tuple(scored), tuple(blocks), float(log_sum(np.array(total))) - prior.total,
        log_sum(np.array(flips), axis=0) - prior.total if flips else np.zeros(0),
        {d: max(v) for d, v in drivers.items()},
        {d: np.max(v, axis=0) for d, v in driver_flips.items()}, at, noise,
    )  # fmt: skip
