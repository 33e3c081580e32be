"""The KR 270 of design_peers.py: cell, pool, and differential evolution on the same criterion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution

from elastocal.cell.work_cell import read_cell
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import Model
from elastocal.planning.candidates import draw, joint_space
from elastocal.planning.criteria import TraceCriterion
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.information import plan_forces
from elastocal.planning.polish import Searches
from elastocal.planning.relaxation import DesignProblem
from elastocal.planning.setup import FeasiblePool, Known, Setup, set_up
from elastocal.planning.test_poses import test_poses

Array = NDArray[np.float64]

POOL, POSES = 5000, 15
# Base, joint offsets, links and compliances from three known markers under load; joint limits are
# the only rule, since neither pyDOE3 nor scipy knows another.
CELL = f"""
[robot]
urdf = "{files("elastocal.demo") / "kr270_2.urdf"}"
base = "base_link"
flange = "flange"
[tool]
load_point_m = [0.20, 0.0, 0.25]
[tool.markers_m]
M1 = [0.25, 0.0, 0.05]
M2 = [-0.12, 0.22, 0.10]
M3 = [-0.05, -0.10, 0.25]
[tracker]
sigma_um = 10
[model]
observe = "position"
effects = ["base_frame", "joint_offset", "link_geometry", "joint_compliance"]
[design]
poses = {POSES}
loads_N = [[0, 0, -2600]]
candidates = {POOL}
"""


@dataclass(frozen=True)
class Arm:
    """The problem of `poses` poses, and ρ₀ of any others."""

    setup: Setup
    pool: FeasiblePool
    searches: Searches
    n_targets: int

    @property
    def poses(self) -> int:
        return POSES

    @cached_property
    def problem(self) -> DesignProblem:
        return self.setup.problem(self.pool, np.array([POSES]))

    @property
    def C(self) -> Array:
        """C (p, p) of ρ₀² = tr(C M⁻¹)."""
        assert isinstance(self.setup.criterion, TraceCriterion)
        return self.setup.criterion.C

    def rho(self, q: Array) -> float:
        """ρ₀ in µm of the plan q (n_poses, 6)."""
        return float(self.rhos(q[None])[0])

    def rhos(self, q: Array) -> Array:
        """ρ₀ (K,) in µm of plans q (K, n_poses, 6), by the batch evaluator."""
        flat = q.reshape(-1, q.shape[2])
        B = self.setup.information.blocks(flat)
        B = B.reshape(len(q), -1, B.shape[2])
        M = self.setup.prior + B.transpose(0, 2, 1) @ B
        return 1e6 * np.sqrt(self.setup.criterion.of_information(M))


def prepared(folder: Path, seed: int) -> Arm:
    """From the cell to the blocks of the pool, by the steps of `elastocal design`."""
    path = folder / "cell.toml"
    path.write_text(CELL)
    model = Model(read_cell(path, known_effects=tuple(CATALOGUE)))
    rules, forces = Feasibility(model.cell, model.chain), plan_forces(model.cell)
    drawn = draw(model.cell, model.chain, forces, rules, POOL, seed)
    assert drawn.tried == drawn.feasible, "joint limits alone remove nothing"
    targets = test_poses(model.cell, model.chain, rules, seed)
    setup = set_up(model, drawn.q, POSES, targets, Known())
    space = joint_space(model.cell, model.chain)
    searches = Searches(setup.information, space, rules)
    return Arm(setup, setup.pool(drawn.q, drawn.group), searches, len(targets.q))


def evolved(arm: Arm, generations: int, seed: int) -> tuple[Array, int]:
    """The plan (n_poses, 6) of scipy's differential evolution, and how many plans it evaluated.

    15 × 6 joint angles within the joint limits, scipy's defaults (15 members per variable,
    best1bin, polished by L-BFGS-B at the end) but for a whole generation evaluated at a time, which
    is quicker, and for the number of generations.
    """
    space, evaluated = arm.searches.space, 0

    def rhos(x: Array) -> Array:
        nonlocal evaluated
        plans = x.reshape(POSES * len(space.lower), -1).T
        evaluated += len(plans)
        found = arm.rhos(plans.reshape(len(plans), POSES, -1))
        return found if x.ndim == 2 else found[0]

    limits = list(zip(space.lower, space.upper, strict=True)) * POSES
    found = differential_evolution(
        rhos, limits, rng=seed, vectorized=True, updating="deferred", maxiter=generations
    )
    return found.x.reshape(POSES, -1), evaluated
