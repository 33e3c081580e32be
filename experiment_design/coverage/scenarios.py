"""Simulated campaigns of the KR 270 at Table 2's poses, and what an oracle would know of them."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "kr270_reproduction"))

from campaign import campaign

from elastocal.identification.noise_structure import Readings
from elastocal.model.observations import polar_axes

EFFECT = 80e-6  # m, configuration effect in each direction
OUTLIERS = 0.05, 1e-3, 1e-2  # share of readings, least and largest error in m
TRACKER = np.array([4.0, -2.0, 1.0])  # m, where the polar tracker stands in the robot's frame
RANGE, TRANSVERSE = (10e-6, 0.3e-6), (15e-6, 6e-6)  # m, and m per m of distance


@dataclass(frozen=True)
class Scenario:
    """Noise "table 1" or "polar", a configuration effect or none, outliers or none, repeats."""

    noise: str
    effect: bool
    outliers: bool
    repeats: int

    @property
    def name(self) -> str:
        parts = [self.noise, f"{self.repeats} repeats"]
        parts += ["80 µm effect"] * self.effect + ["5 % outliers"] * self.outliers
        return ", ".join(parts)

    @property
    def key(self) -> str:
        """Name of its files."""
        marks = ("effect",) * self.effect + ("outliers",) * self.outliers
        return "_".join([self.noise.replace(" ", ""), str(self.repeats), *marks])


KINDS = (
    ("table 1", False, False), ("table 1", True, False), ("table 1", False, True),
    ("table 1", True, True), ("polar", False, False),
)  # fmt: skip
SCENARIOS = tuple(Scenario(*kind, repeats) for kind in KINDS for repeats in (6, 3))


class Setting:
    """A scenario's B, noise and labels; columns of B are in µrad/(N·m)."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        base = campaign()
        keep = (np.arange(270) // 3) % 6 < scenario.repeats
        rows = np.repeat(keep, 3)
        self.names, self.truth = base.names, base.truth * 1e6
        self.B = base.B[rows] * 1e-6
        self.configuration = base.configuration[rows][::3]
        self.group = base.group[rows]
        n = len(self.configuration)
        self.marker = np.tile(np.arange(3), n // 3)
        position = base.position[keep] - TRACKER
        self.sight, self.reach = polar_axes(position), np.linalg.norm(position, axis=1)
        if scenario.noise == "polar":
            along = RANGE[0] + RANGE[1] * self.reach
            across = TRANSVERSE[0] + TRANSVERSE[1] * self.reach
            scale = np.column_stack([along, across, across]) * np.sqrt(2)  # loaded minus unloaded
            self.root = self.sight.transpose(0, 2, 1) * scale[:, None, :]
        else:
            self.root = np.eye(3) * base.sigma[rows].reshape(-1, 3)[:, None, :]

    def draw(self, replicate: int) -> tuple[np.ndarray, np.ndarray]:
        """Deflections less B·truth (rows,) in m, and which readings (N,) are clean."""
        s = self.scenario
        marks = [sum(s.noise.encode()), s.repeats, int(s.effect), int(s.outliers), replicate]
        rng = np.random.default_rng(np.random.SeedSequence(marks))
        n = len(self.configuration)
        noise = (self.root @ rng.normal(size=(n, 3, 1)))[..., 0].ravel()
        if s.effect:
            noise += EFFECT * rng.normal(size=self.group.max() + 1)[self.group]
        share, least, largest = OUTLIERS
        wrong = rng.random(n) < (share if s.outliers else 0.0)
        direction = rng.normal(size=(n, 3))
        direction *= (rng.uniform(least, largest, n) / np.linalg.norm(direction, axis=1))[:, None]
        return noise + (direction * wrong[:, None]).ravel(), ~wrong

    def readings(self, e: np.ndarray) -> Readings:
        n = len(self.configuration)
        return Readings(
            self.B.reshape(n, 3, -1), e.reshape(n, 3), self.configuration,
            np.zeros(n, dtype=np.int64), self.marker, self.sight, self.reach,
        )  # fmt: skip

    @cached_property
    def covariance(self) -> np.ndarray:
        """True covariance (rows, rows) of the clean noise."""
        n = len(self.configuration)
        full = np.zeros((3 * n, 3 * n))
        for i, root in enumerate(self.root):
            full[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = root @ root.T
        if self.scenario.effect:
            full += EFFECT**2 * (self.group[:, None] == self.group)
        return full

    def oracle(self, e: np.ndarray, clean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Estimate and standard deviations of one who knows Σ and which readings are faulty."""
        rows = np.repeat(clean, 3)
        V = self.covariance[np.ix_(rows, rows)]
        weighted = np.linalg.solve(V, self.B[rows])
        Phi = np.linalg.inv(self.B[rows].T @ weighted)
        return Phi @ (weighted.T @ e[rows]), np.sqrt(np.diag(Phi))


setting = lru_cache(maxsize=2)(Setting)  # chunks of one scenario follow each other
