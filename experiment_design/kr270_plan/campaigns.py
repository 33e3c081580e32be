"""Simulated campaigns of a plan: measure, identify, compensate at the test poses, look."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from compared import DEMO, Study
from joblib import Parallel, delayed

from elastocal.demo.example import published_compliances
from elastocal.identification.identify import identify
from elastocal.identification.options import Options
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.planning.information import rows_of
from elastocal.simulation.simulate import simulate, values_from

STEP = 1e-6  # rad, differences of the tool's position
ROUNDS = 6
CLOSE = 1e-9  # m: how near the calibrated model is brought to the target


def realised(study: Study, q: np.ndarray, campaigns: int, jobs: int) -> np.ndarray:
    """Square mean over the test poses (campaigns,) in m² of the true arm's error after
    compensation with what each campaign identified."""
    seeds = np.random.SeedSequence(0).spawn(campaigns)
    chunks = [seeds[k::32] for k in range(32)]
    parts = Parallel(n_jobs=jobs)(delayed(_some)(study.name, q, chunk) for chunk in chunks)
    return np.concatenate(parts)


def _some(name: str, q: np.ndarray, seeds: list) -> np.ndarray:
    study, tool = _instruments(name)
    return np.array([_one(study, tool, q, seed) for seed in seeds])


@cache
def _instruments(name: str) -> tuple[Study, Tool]:
    """Each process has its own: symbolic models do not pickle."""
    study = Study.of(name, 0)
    return study, Tool(study)


def _one(study: Study, tool: Tool, q: np.ndarray, seed: np.random.SeedSequence) -> float:
    model, truth = study.model, tool.truth
    rows = rows_of(q, study.forces, tuple(study.cell.tool.markers))
    repeats = study.cell.design.repeats
    n = len(rows)
    table = rows.take(np.repeat(np.arange(n), repeats))
    table = replace(table, repeat=np.tile(np.arange(repeats), n), row=np.arange(n * repeats) + 2)
    data = simulate(model, table, truth, np.random.default_rng(seed))
    options = Options(method="wls", faulty="keep", fixed=("joint1.compliance",))
    return tool.remaining(identify(model, data, options).x)


class Tool:
    """The tool's load point at the test poses under load, for any parameter values."""

    def __init__(self, study: Study) -> None:
        cell, targets = study.cell, study.targets
        marker = {"load point": targets.point[0]}
        spec = replace(cell.model, observe="position")
        tool = replace(cell.tool, markers=marker)
        self.model = Model.assembled(study.model.chain, replace(cell, model=spec, tool=tool))
        T = len(targets.q)
        self.rows = Measurements(
            source="test poses",
            row=np.arange(T) + 1,
            q=targets.q,
            configuration=np.arange(T),
            configuration_labels=tuple(map(str, range(T))),
            repeat=np.zeros(T, dtype=np.int64),
            marker=np.zeros(T, dtype=np.int64),
            marker_names=("load point",),
            force=targets.force,
            position=np.zeros((T, 3)),
        )
        named, _ = published_compliances(DEMO)
        self.truth = values_from(study.model, named)
        rigid = np.zeros(len(self.truth))
        self.target = self.at(targets.q, rigid)
        self.inverse = np.linalg.pinv(self._slope(targets.q, rigid))

    def at(self, q: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Position (T, 3) at commanded joints q (T, n)."""
        return self.model.predict(replace(self.rows, q=q), x).reshape(-1, 3)

    def _slope(self, q: np.ndarray, x: np.ndarray) -> np.ndarray:
        """∂position/∂q (T, 3, n); joint 2 stays at its level, where its compliance is known."""
        J = np.zeros((len(q), 3, q.shape[1]))
        for j in (0, 2, 3, 4, 5):
            step = np.zeros(q.shape[1])
            step[j] = STEP
            J[:, :, j] = (self.at(q + step, x) - self.at(q - step, x)) / (2 * STEP)
        return J

    def commanded(self, x: np.ndarray) -> np.ndarray:
        """Joints (T, n) at which an arm with parameters x puts the tool at the targets."""
        q = self.rows.q.copy()
        for _ in range(ROUNDS):
            miss = self.target - self.at(q, x)
            if np.abs(miss).max() < CLOSE:
                break
            q += np.einsum("tij,tj->ti", self.inverse, miss)
        assert np.abs(miss).max() < 1e3 * CLOSE
        return q

    def remaining(self, x: np.ndarray) -> float:
        """Mean square error in m² of the true arm at the joints commanded with x."""
        error = self.at(self.commanded(x), self.truth) - self.target
        return float((error**2).sum(axis=1).mean())
