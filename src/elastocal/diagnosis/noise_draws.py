"""What the noise may be instead: draws about its most probable values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.noise import LARGEST, SMALLEST, NoiseValues, NoisyData
from elastocal.diagnosis.projection import likelihood, posterior

Array = NDArray[np.float64]

STEP = 0.05  # of the logarithms, for a difference quotient of the likelihood's slope
FLATTEST = 0.5  # smallest curvature of −2ℓ: where the prior is all that holds a logarithm
TRIED = 6  # draws from the Gaussian for each that is kept


def noise_draws(
    data: NoisyData, noise: NoiseValues, n: int, rng: np.random.Generator
) -> list[NoiseValues]:
    """n draws of the noise values from likelihood times prior.

    Of draws from the Gaussian about the maximum, logarithms with covariance 2 (∂²(−2ℓ))⁻¹, some
    are kept, each with the probability that it has beside what the Gaussian gives it (sampling
    importance resampling, Rubin 1988): a joint's scatter may be anything below what shows.
    """
    theta = noise.logs()
    k = len(theta)

    def slope(at: Array) -> Array:
        return likelihood(data, NoiseValues.of_logs(at))[1]

    H = np.empty((k, k))
    for i, e in enumerate(STEP * np.eye(k)):
        H[i] = (slope(theta + e) - slope(theta - e)) / (2 * STEP)
    values, vectors = np.linalg.eigh((H + H.T) / 2)
    root = vectors * np.sqrt(2 / np.maximum(values, FLATTEST))
    z = rng.normal(size=(TRIED * n, k))
    drawn = theta + z @ root.T
    drawn[:, 2:] = np.clip(drawn[:, 2:], np.log(SMALLEST), np.log(LARGEST))
    minus_two = np.array([posterior(data, NoiseValues.of_logs(t)) for t in drawn])
    log_weight = -0.5 * minus_two + 0.5 * (z**2).sum(axis=1)
    weight = np.exp(log_weight - log_weight.max())
    kept = rng.choice(len(drawn), n, p=weight / weight.sum())
    return [NoiseValues.of_logs(drawn[i]) for i in kept]
