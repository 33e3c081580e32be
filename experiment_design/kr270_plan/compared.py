"""The plans that this study compares: what each is worth by prediction, and in simulated campaigns
that measure, identify, and compensate at the test poses."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed

from elastocal.cell import read_cell
from elastocal.identification.identify import identify
from elastocal.identification.start import Options
from elastocal.measurements import Measurements, read_measurements
from elastocal.model.manipulator import Model
from elastocal.planning.design import DesignOptions, design
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.information import Known, plan_forces
from elastocal.planning.plan import Plan
from elastocal.planning.poses import draw, shares_of, test_poses
from elastocal.planning.search import Checkpoint
from elastocal.planning.setup import set_up
from elastocal.simulation import published_compliances, simulate, values_from

HERE = Path(__file__).parent
DEMO = Path(str(files("elastocal.demo")))
SEED = 2013
RANDOM_PLANS = 1000
STEP = 1e-6  # rad, differences of the tool's position
ROUNDS = 6
CLOSE = 1e-9  # m: how near the calibrated model is brought to the target


class Study:
    """A cell, its model, and what evaluates any plan in it."""

    def __init__(self, name: str, candidates: int) -> None:
        self.name, cell = name, read_cell(HERE / f"{name}.toml")
        cell = self.cell = replace(cell, design=replace(cell.design, candidates=candidates))
        self.model = Model(cell)
        self.forces = plan_forces(cell)
        self.feasibility = Feasibility(cell, self.model.chain)
        self.targets = test_poses(cell, self.model.chain)
        drawn = draw(self.feasibility, self.forces, 2000, SEED)
        n = int(shares_of(cell).sum())
        self.setup = set_up(self.model, drawn.q, n, self.targets, Known())
        self.pool = self.setup.pool(drawn.q, drawn.group)

    def rho(self, q: np.ndarray) -> float:
        """Predicted ρ₀ in µm of the poses q (N, n)."""
        M = self.setup.gathered(self.setup.information.blocks(q))
        return self.setup.criterion.figure(float(self.setup.criterion.of_information(M)))

    def allowed(self, q: np.ndarray) -> np.ndarray:
        """(N,) poses that the cell allows in every load state."""
        return np.logical_and.reduce([self.feasibility.check(q, f).ok for f in self.forces])

    def planned(self, criterion: str, effort: str, jobs: int) -> Plan:
        """Our plan; what an interrupted run had finished is taken from runs/."""
        cell = replace(self.cell, design=replace(self.cell.design, criterion=criterion))
        options = DesignOptions(effort=effort, seed=SEED, jobs=jobs, fixed=("joint1.compliance",))
        (HERE / "runs").mkdir(exist_ok=True)
        done = Checkpoint.beside(HERE / "runs" / f"{self.name}-{criterion}-{effort}", f"{SEED}")
        return design(cell, options, done, lambda text: print(f"  {text}", flush=True))

    def random_plan(self, rng: np.random.Generator) -> np.ndarray:
        """Numbers of candidates, with our plan's shares of each level."""
        return np.concatenate([
            rng.choice(np.flatnonzero(self.pool.group == level), n, replace=False)
            for level, n in enumerate(shares_of(self.cell))
        ])  # fmt: skip

    def at_random(self) -> np.ndarray:
        """ρ₀ in µm of RANDOM_PLANS random plans."""
        rng = np.random.default_rng(SEED)
        return np.array([self.rho(self.pool.q[self.random_plan(rng)]) for _ in range(RANDOM_PLANS)])


def table_2(model: Model) -> np.ndarray:
    """The poses (15, 6) of Table 2 of Klimchik et al. 2013."""
    return read_measurements(DEMO / "plan.csv", joint_kinds=model.chain.kinds, observe="plan").q


def realised(study: Study, q: np.ndarray, campaigns: int, jobs: int) -> np.ndarray:
    """Square mean over the test poses (campaigns,) in m² of the true arm's error after
    compensation with what each campaign identified."""
    seeds = np.random.SeedSequence(0).spawn(campaigns)
    chunks = [seeds[k::32] for k in range(32)]
    parts = Parallel(n_jobs=jobs)(delayed(_some)(study.name, q, chunk) for chunk in chunks)
    return np.concatenate(parts)


@cache
def _instruments(name: str) -> tuple[Study, Tool]:
    """Each process has its own: symbolic models do not pickle."""
    study = Study(name, 1)
    return study, Tool(study)


def _some(name: str, q: np.ndarray, seeds: list) -> np.ndarray:
    study, tool = _instruments(name)
    repeats = study.cell.design.repeats
    rows = study.setup.information.rows(q)
    n = len(rows)
    table = rows.take(np.repeat(np.arange(n), repeats))
    table = replace(table, repeat=np.tile(np.arange(repeats), n), row=np.arange(n * repeats) + 2)
    options = Options(method="wls", faulty="keep", fixed=("joint1.compliance",))
    data = (simulate(study.model, table, tool.truth, np.random.default_rng(s)) for s in seeds)
    return np.array([tool.remaining(identify(study.model, d, options).x) for d in data])


class Tool:
    """The tool's load point at the test poses under load, for any parameter values."""

    def __init__(self, study: Study) -> None:
        cell, targets = study.cell, study.targets
        marker = {"load point": targets.point[0]}
        spec = replace(cell.model, observe="position")
        tool = replace(cell.tool, markers=marker)
        self.model = Model.assembled(study.model.chain, replace(cell, model=spec, tool=tool))
        q, zeros = targets.q, np.zeros((len(targets.q), 3))
        self.rows = Measurements.of_poses("test poses", q, targets.force, *marker, position=zeros)
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
