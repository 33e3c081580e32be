"""The few distributions that worlds are drawn from."""

from __future__ import annotations

import numpy as np

Values = dict[str, float]


def log_uniform(bounds: tuple[float, float], rng: np.random.Generator) -> float:
    """A number whose logarithm is uniform between those of the bounds."""
    low, high = np.log(bounds)
    return float(np.exp(rng.uniform(low, high)))


def sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def spread(keys: tuple[str, ...], size: float, rng: np.random.Generator) -> Values:
    """Components of a random direction, their rms `size`."""
    v = rng.normal(size=len(keys))
    v *= size * np.sqrt(len(keys)) / np.linalg.norm(v)
    return dict(zip(keys, v.tolist(), strict=True))


def positive(keys: tuple[str, ...], size: float, rng: np.random.Generator) -> Values:
    """Compliances about `size`, none of them the same."""
    return {key: float(size * rng.uniform(0.7, 1.3)) for key in keys}
