"""The plans that this study compares, and what each is worth by prediction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

import numpy as np

from elastocal.cell.work_cell import Cell, read_cell
from elastocal.measurements import read_plan
from elastocal.model.manipulator import Model
from elastocal.planning.candidates import draw, shares_of
from elastocal.planning.checkpoint import Checkpoint
from elastocal.planning.design import DesignOptions, design
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.information import plan_forces
from elastocal.planning.plan import Plan
from elastocal.planning.setup import FeasiblePool, Known, Setup, set_up
from elastocal.planning.test_poses import TargetPoses, test_poses

HERE = Path(__file__).parent
DEMO = Path(str(files("elastocal.demo")))
SEED = 2013
RANDOM_PLANS = 1000


@dataclass(frozen=True)
class Study:
    """A cell, its model, and what evaluates any plan in it."""

    name: str
    cell: Cell
    model: Model
    forces: np.ndarray
    feasibility: Feasibility
    targets: TargetPoses
    setup: Setup
    pool: FeasiblePool

    @classmethod
    def of(cls, name: str, candidates: int) -> Study:
        model = Model(read_cell(HERE / f"{name}.toml"))
        cell, chain = model.cell, model.chain
        cell = replace(cell, design=replace(cell.design, candidates=candidates))
        model = Model.assembled(chain, cell)
        forces, feasibility = plan_forces(cell), Feasibility(cell, chain)
        targets = test_poses(cell, chain)
        drawn = draw(cell, chain, forces, feasibility, 2000, SEED)
        n = int(shares_of(cell).sum())
        setup = set_up(model, drawn.q, n, targets, Known())
        pool = setup.pool(drawn.q, drawn.group)
        return cls(name, cell, model, forces, feasibility, targets, setup, pool)

    def rho(self, q: np.ndarray) -> float:
        """Predicted ρ₀ in µm of the poses q (N, n)."""
        value = self.setup.value(q)
        return self.setup.criterion.reported(value)[0]

    def allowed(self, q: np.ndarray) -> np.ndarray:
        """(N,) poses that the cell allows in every load state."""
        return np.logical_and.reduce([self.feasibility.check(q, f).ok for f in self.forces])

    def planned(self, criterion: str, effort: str, jobs: int) -> Plan:
        """Our plan; what an interrupted run had finished is taken from runs/."""
        cell = replace(self.cell, design=replace(self.cell.design, criterion=criterion))
        options = DesignOptions(effort=effort, seed=SEED, jobs=jobs, fixed=("joint1.compliance",))
        done = Checkpoint(HERE / "runs" / f"{self.name}-{criterion}-{effort}")
        return design(cell, options, done, lambda text: print(f"  {text}", flush=True))

    def at_random(self) -> np.ndarray:
        """ρ₀ in µm of RANDOM_PLANS plans of the same shares, drawn from feasible candidates."""
        rng = np.random.default_rng(SEED)
        shares = shares_of(self.cell)
        found = np.empty(RANDOM_PLANS)
        for k in range(RANDOM_PLANS):
            chosen = np.concatenate(
                [
                    rng.choice(np.flatnonzero(self.pool.group == level), n, replace=False)
                    for level, n in enumerate(shares)
                ]
            )
            M = self.setup.gathered(self.pool.blocks[:, chosen])
            found[k] = self.setup.criterion.reported(float(self.setup.criterion.value(M)))[0]
        return found


def table_2(model: Model) -> np.ndarray:
    """The poses (15, 6) of Table 2 of Klimchik et al. 2013."""
    return read_plan(DEMO / "plan.csv", joint_kinds=model.chain.kinds).q
