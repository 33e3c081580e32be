"""A problem like the arm's: configurations × markers × repeats, three components a reading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest


@dataclass(frozen=True)
class ArmLike:
    """y = B x + noise of unit variance; the first five columns are seen at one level each."""

    B: np.ndarray  # (810, 9)
    x: np.ndarray
    configuration: np.ndarray  # (270,)
    marker: np.ndarray
    size: int = 3

    @property
    def n(self) -> int:
        return len(self.configuration)

    def errors(self, rng, share=0.0, low=1.0, high=10.0):
        """Unit noise (n, 3); a share of the readings off by `low` to `high` in each component,
        in units where the noise is 1, and which ones."""
        noise = rng.normal(size=(self.n, 3))
        bad = rng.permutation(self.n)[: round(share * self.n)]
        sign = rng.choice([-1.0, 1.0], (len(bad), 3))
        noise[bad] += sign * rng.uniform(low, high, (len(bad), 3))
        return noise, bad

    def observed(self, noise):
        return self.B @ self.x + noise.ravel()


@pytest.fixture(scope="session")
def arm() -> ArmLike:
    """15 configurations at five levels, 3 markers, 6 repeats: 270 readings, 9 columns.

    Lengths are in units of the noise: 10 µm, so that 1 to 10 mm are 100 to 1000.
    """
    rng = np.random.default_rng(2013)
    configuration = np.repeat(np.arange(15), 18)
    marker = np.tile(np.repeat(np.arange(3), 6), 15)
    pose = rng.normal(size=(15, 1, 3, 9)) + 0.5 * rng.normal(size=(15, 3, 3, 9))
    B = pose[configuration, marker]
    level = configuration // 3
    B[:, :, :5] *= (level[:, None] == np.arange(5))[:, None, :]
    return ArmLike(B.reshape(-1, 9), rng.normal(size=9), configuration, marker)
