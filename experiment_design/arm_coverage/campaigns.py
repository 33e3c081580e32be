"""Simulated campaigns of a whole arm under nine kinds of noise, and an oracle that knows it."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, lru_cache
from importlib.resources import files
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from elastocal.cell import Cell
from elastocal.cell_tables import CartesianNoise, ModelSpec, Nominal, Robot, Tool, Tracker
from elastocal.identification.solve import reduce
from elastocal.measurements import Measurements, with_moves
from elastocal.model.chain import joint_limits
from elastocal.model.manipulator import Model
from elastocal.model.observations import polar_axes
from elastocal.model.urdf import read_urdf
from elastocal.simulation import expand_plan, simulate

EFFECTS = ("base_frame", "joint_offset", "link_geometry", "marker_position", "joint_compliance")
COMPLIANCE = (3.5e-7, 0.287e-6, 0.416e-6, 2.786e-6, 3.483e-6, 2.074e-6)  # rad/(N m)
MARKERS = {
    "M1": np.array([0.25, 0.0, 0.05]),
    "M2": np.array([-0.12, 0.22, 0.10]),
    "M3": np.array([-0.05, -0.10, 0.25]),
}
LOADS = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -2600.0]])
GEOMETRY, SPRINGS = 1e-3, 0.2  # m and rad; share of a compliance: how far arms differ from nominal
SIGMA = 20e-6  # m
EFFECT = 80e-6  # m, configuration effect in each direction
OUTLIERS = 0.05, 1e-3, 1e-2  # share of readings, least and largest error in m
SCATTER = 20e-6  # rad, of each joint at each visit
DRIFT, LASTING = 40e-6, 0.2  # m in each direction, correlation time as a share of the campaign
RANGE, TRANSVERSE = (10e-6, 0.3e-6), (15e-6, 6e-6)  # m, and m per m of distance
VISIT = 60.0  # s between visits
TEST_POSES = 200


POSES, FEW = 30, 12  # of a campaign, and of the scenario "few"
SCENARIOS = {
    "independent": "independent",
    "axes": "one size per axis",
    "effect": "80 µm configuration effect",
    "outliers": "5 % outliers of 1 to 10 mm",
    "tails": "heavy tails (t, 3 degrees)",
    "polar": "polar tracker, not declared",
    "joints": "joints settle anew at each visit, 20 µrad",
    "few": f"{FEW} configurations",
    "drift": "drift, correlated in time",
}  # kinds of noise, beside that of the tracker


@lru_cache(maxsize=1)
def arm() -> Model:
    """The KR 270 with all its geometry and joint compliances free, its base anywhere."""
    nominal = Nominal(joint_compliance=COMPLIANCE)
    spec = ModelSpec(observe="position", effects=EFFECTS, nominal=nominal)
    tracker = Tracker(noise=CartesianNoise(np.full(3, SIGMA)))
    tool = Tool(np.array([0.20, 0.0, 0.25]), dict(MARKERS))
    chain = read_urdf(
        Path(str(files("elastocal.demo") / "kr270_2.urdf")), base="base_link", flange="flange"
    )
    return Model.assembled(chain, Cell("arm", None, Robot(), tool, tracker, spec))


def true_arm(rng: np.random.Generator, errors: float = 1.0) -> np.ndarray:
    """Values (parameters,) of an arm at random, its geometry off by so many typical sizes."""
    model = arm()
    x = model.nominal.copy()
    for i, p in enumerate(model.parameters):
        if p.effect == "joint_compliance":
            x[i] *= 1 + SPRINGS * np.clip(rng.normal(), -2, 2)
        elif p.effect != "base_frame":
            x[i] += errors * GEOMETRY * rng.normal()
    base = [model.names.index(f"base.{k}") for k in ("x", "y", "z", "rx", "ry", "rz")]
    x[base[:3]] = rng.uniform(-3, 3, 3)
    x[base[3:]] = Rotation.random(random_state=rng).as_rotvec()
    return x


def rows_at(poses: int, rng: np.random.Generator) -> Measurements:
    """Random poses, each visited without and with the load, all markers read at each visit."""
    low, high = (np.clip(limits, -np.pi, np.pi) for limits in joint_limits(arm().cell, arm().chain))
    q = rng.uniform(low, high, (poses, len(low)))
    plan = Measurements.of_poses("simulated", q, LOADS[0])
    rows = expand_plan(plan, tuple(MARKERS), 1, LOADS[1])
    visit = np.arange(len(rows)) // len(MARKERS)
    return with_moves(replace(rows, time=VISIT * visit.astype(float)))


class Campaign:
    """One campaign: a `true` arm, its exact and noisy readings, and which of these are clean."""

    def __init__(self, scenario: str, number: int, errors: float = 1.0) -> None:
        self.scenario = scenario
        marks = [sum(scenario.encode()), number]
        self.rng = rng = np.random.default_rng(np.random.SeedSequence(marks))
        self.true = true_arm(rng, errors)
        self.exact = simulate(
            arm(), rows_at(FEW if scenario == "few" else POSES, rng), self.true, rng, False
        )
        self.noise, self.clean = self.drawn(self.exact)
        self.table = replace(self.exact, position=self.exact.position + self.noise)

    @property
    def sizes(self) -> np.ndarray:
        """σ (3,) m of single readings, where it is the same at all."""
        return SIGMA * np.array([0.5, 1.0, 2.0] if self.scenario == "axes" else [1.0] * 3)

    def drawn(self, exact: Measurements) -> tuple[np.ndarray, np.ndarray]:
        """Noise (n, 3) of readings at `exact` in m, and which of them (n,) are no outliers."""
        rng, key, n = self.rng, self.scenario, len(exact)
        size = self.sizes * np.ones((n, 1))
        noise = size * (rng.standard_t(3, (n, 3)) if key == "tails" else rng.normal(size=(n, 3)))
        clean = np.ones(n, dtype=bool)
        visit = np.arange(n) // len(MARKERS)
        if key == "effect":
            noise += EFFECT * rng.normal(size=(n, 3))[exact.configuration]
        if key == "outliers":
            share, least, largest = OUTLIERS
            clean = rng.random(n) >= share
            direction = rng.normal(size=(n, 3))
            direction *= (
                rng.uniform(least, largest, (n, 1)) / np.linalg.norm(direction, axis=1)[:, None]
            )
            noise += np.where(clean[:, None], 0.0, direction)
        if key == "polar":
            noise = np.einsum("nij,nj->ni", self.polar_root(exact), rng.normal(size=(n, 3)))
        if key == "joints":
            q = exact.q + SCATTER * rng.normal(size=(n, 6))[visit]
            moved = simulate(arm(), replace(exact, q=q), self.true, rng, False)
            noise += moved.position - exact.position
        if key == "drift":
            root = np.linalg.cholesky(self.drifting(exact) + 1e-12 * np.eye(n))
            noise += DRIFT * root @ rng.normal(size=(n, 3))
        return noise, clean

    def polar_root(self, exact: Measurements) -> np.ndarray:
        """Root (n, 3, 3) of the covariance of a polar tracker's readings."""
        reach = np.linalg.norm(exact.position, axis=1)
        along = RANGE[0] + RANGE[1] * reach
        across = TRANSVERSE[0] + TRANSVERSE[1] * reach
        scale = np.column_stack([along, across, across])
        return polar_axes(exact.position).transpose(0, 2, 1) * scale[:, None, :]

    def drifting(self, exact: Measurements) -> np.ndarray:
        """Correlation (n, n) in time."""
        apart = np.abs(exact.time[:, None] - exact.time)
        return np.exp(-apart / (LASTING * np.ptp(exact.time)))

    @cached_property
    def covariance(self) -> np.ndarray:
        """True covariance (3n, 3n) of the clean noise."""
        exact, key, n = self.exact, self.scenario, len(self.exact)
        V = np.diag(np.tile(self.sizes, n) ** 2) * (3.0 if key == "tails" else 1.0)
        if key == "polar":
            root = self.polar_root(exact)
            blocks = root @ root.transpose(0, 2, 1)
            V = np.einsum("nij,nm->nimj", blocks, np.eye(n)).reshape(3 * n, 3 * n)
        if key == "effect":
            same = exact.configuration[:, None] == exact.configuration
            V += EFFECT**2 * np.kron(same, np.eye(3))
        if key == "joints":
            G = self.joint_columns
            visit = np.repeat(np.arange(n) // len(MARKERS), 3)
            V += SCATTER**2 * (G @ G.T) * (visit[:, None] == visit)
        if key == "drift":
            V += DRIFT**2 * np.kron(self.drifting(exact), np.eye(3))
        return V

    @cached_property
    def joint_columns(self) -> np.ndarray:
        """∂(reading)/∂q (3n, 6) by central differences of the simulated arm."""

        def at(q: np.ndarray) -> np.ndarray:
            return simulate(arm(), replace(self.exact, q=q), self.true, 0, False).position.ravel()

        q, steps = self.exact.q, 1e-5 * np.eye(6)
        return np.column_stack([(at(q + h) - at(q - h)) / 2e-5 for h in steps])

    @cached_property
    def test(self) -> Measurements:
        """New poses and their exact readings."""
        rows = rows_at(TEST_POSES, self.rng)
        return simulate(arm(), rows, self.true, self.rng, False)

    def oracle_error(self) -> float:
        """Rms position error at the new poses of one who knows noise, outliers and linear model:
        generalised least squares in a complete set of parameters."""
        model = arm()
        rows = np.repeat(self.clean, 3)
        B = model.regressor(self.exact, self.true).B[rows]
        sizes = model.sizes(B)
        kept = reduce(B, sizes, model.parameters, SIGMA, 0.0).kept
        V = self.covariance[np.ix_(rows, rows)]
        L = np.linalg.cholesky(V)
        W = np.linalg.solve(
            L, np.column_stack([B[:, kept] * sizes[kept], self.noise.ravel()[rows]])
        )
        step = np.linalg.lstsq(W[:, :-1], W[:, -1], rcond=None)[0] * sizes[kept]
        error = model.regressor(self.test, self.true, kept).B @ step
        return float(np.sqrt((error.reshape(-1, 3) ** 2).sum(axis=1).mean()))
