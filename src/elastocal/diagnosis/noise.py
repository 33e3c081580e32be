"""The noise floor: tracker noise, repeatability of each joint, scatter common to a configuration.

    V = a² Σ_stated + Σ_j s_j² g_j g_jᵀ ∘ (same visit + c² · same configuration)

with g_j = ∂(reading)/∂q_j.  a, s_j and c maximise the marginal likelihood of the residuals
(projection.py) times priors that keep what the data do not show near its usual size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.blocks import Blocks

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Logarithms' prior standard deviations.  Stated tracker noise is rarely wrong by more than 1.6
# times; a joint repeats to some 5 µrad on a heavy arm and to 50 on a light one; the joints of an
# arm differ by a factor of two.
STATED_SPREAD, UNSTATED_SPREAD = 0.5, 3.0
REPEATABILITY, REPEATABILITY_SPREAD = 8e-6, 1.5
JOINT_SPREAD = 0.7
SHARED, SHARED_SPREAD = 0.2, 1.2
SMALLEST, LARGEST = 1e-9, 2e-2  # rad or m: a joint that is exact


@dataclass(frozen=True)
class NoiseValues:
    """`factor` a of the stated noise, `joint` s (joints,) in rad or m, `shared` c."""

    factor: float
    joint: Array
    shared: float

    @classmethod
    def usual(cls, joints: int) -> NoiseValues:
        """What one expects before any reading: noise as stated, joints as good as usual."""
        return cls(1.0, np.full(joints, REPEATABILITY), SHARED)

    def of_instrument(self) -> NoiseValues:
        """The instrument's part alone: joints that repeat exactly."""
        return NoiseValues(self.factor, np.full(len(self.joint), SMALLEST), SHARED)

    def logs(self) -> Array:
        return np.log(np.concatenate([[self.factor, self.shared], self.joint]))

    @classmethod
    def of_logs(cls, theta: Array) -> NoiseValues:
        v = np.exp(theta)
        return cls(float(v[0]), v[2:], float(v[1]))


@dataclass(frozen=True)
class NoisyData:
    """Packed residual r (C, m), nuisance X (C, m, p) with prior precision Λ (p,), and what noise
    is made of: stated covariance (C, m, m), joint columns G (C, m, joints).

    `stated` says whether the covariance is stated or only a shape; `left_out` (C, m) rows do not
    count (padding, faulty readings).
    """

    blocks: Blocks
    r: Array
    X: Array
    precision: Array
    covariance: Array
    G: Array
    same_visit: Array
    left_out: Mask
    stated: bool

    def with_columns(self, extra: Array, precision: Array) -> NoisyData:
        """The same with further columns (C, m, k) and their prior precisions (k,)."""
        X = np.concatenate([self.X, extra], axis=2)
        return replace(self, X=X, precision=np.concatenate([self.precision, precision]))

    def without(self, faulty: Mask) -> NoisyData:
        """The same with the observations where `faulty` (N,) holds left out."""
        padded = np.concatenate([faulty, [True]])[self.blocks.member]
        return replace(self, left_out=np.repeat(padded, self.blocks.size, axis=1))

    def every(self, step: int) -> NoisyData:
        """The data of every `step`-th configuration alone."""
        per_row = ("r", "X", "covariance", "G", "same_visit", "left_out")
        blocks = replace(self.blocks, member=self.blocks.member[::step])
        return replace(self, blocks=blocks, **{k: getattr(self, k)[::step] for k in per_row})

    @property
    def faulty(self) -> Mask:
        """Observations (N,) that are left out."""
        return self.blocks.unpack(self.left_out[..., None].astype(float))[:, 0, 0] > 0

    @property
    def n_rows(self) -> int:
        return int((~self.left_out).sum())

    def masked(self, packed: Array) -> Array:
        """Rows that do not count set to zero (C, m, …)."""
        if not self.left_out.any():
            return packed
        keep = ~self.left_out
        return packed * keep.reshape(keep.shape + (1,) * (packed.ndim - 2))

    @cached_property
    def counting(self) -> Counting:
        """What is evaluated at many noises, rows that do not count set to zero once."""
        G, keep = self.masked(self.G), ~self.left_out
        both = keep[:, :, None] & keep[:, None, :]
        visit = self.blocks.places.one_hot
        by_visit = (visit[..., None] * G[:, :, None, :]).reshape(*G.shape[:2], -1)
        by_visit = np.ascontiguousarray(by_visit.transpose(0, 2, 1))
        return Counting(
            self.masked(self.r), self.masked(self.X), G, by_visit,
            self.covariance if keep.all() else self.covariance * both,
        )  # fmt: skip


@dataclass(frozen=True)
class Counting:
    """Residual, columns, joint columns, those of each visit by itself (C, visits·joints, m), and
    stated covariance, with zeros where nothing counts."""

    r: Array
    X: Array
    G: Array
    by_visit: Array
    covariance: Array


def covariance(data: NoisyData, noise: NoiseValues) -> Array:
    """V (C, m, m); rows left out have unit variance of their own."""
    of = data.counting
    V = (of.G * noise.joint**2) @ of.G.transpose(0, 2, 1)
    V *= data.same_visit + noise.shared**2
    V += noise.factor**2 * of.covariance
    m = np.arange(V.shape[1])
    V[:, m, m] += data.left_out
    return V


def log_prior(stated: bool, noise: NoiseValues) -> tuple[float, Array]:
    """−2 log prior of the logarithms and its slope.

    The joints' logarithms have a common mean that is itself uncertain.
    """
    theta = noise.logs()
    spread = STATED_SPREAD if stated else UNSTATED_SPREAD
    z = np.array([theta[0] / spread, (theta[1] - np.log(SHARED)) / SHARED_SPREAD])
    slope = np.zeros_like(theta)
    slope[:2] = 2 * z / np.array([spread, SHARED_SPREAD])
    joints = theta[2:]
    n = len(joints)
    inverse = np.linalg.inv(JOINT_SPREAD**2 * np.eye(n) + REPEATABILITY_SPREAD**2)
    away = joints - np.log(REPEATABILITY)
    slope[2:] = 2 * inverse @ away
    return float(z @ z + away @ inverse @ away), slope
