"""A planar arm that lifts a load: 4 joints, of which the first only turns the picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pytest
from support.calibration import cell_of, planar_chain

from elastocal.cell.arm_description import CartesianNoise, Nominal, Tracker
from elastocal.cell.plan_wishes import DesignSpec
from elastocal.cell.work_cell import Workspace
from elastocal.model.manipulator import Model
from elastocal.planning.candidates import Candidates, JointSpace, draw, joint_space
from elastocal.planning.criteria import CRITERIA, CriterionInputs, ScenarioCriterion
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.information import PoseInformation
from elastocal.planning.polish import Searches
from elastocal.planning.relaxation import DesignProblem
from elastocal.planning.setup import FeasiblePool, Setup

EFFECTS = tuple(f"joint_compliance:joint{i}" for i in (2, 3, 4))
LOAD = np.array([[0.0, 0.0, -200.0]])
SIGMA = 1e-5
TYPICAL = 1e-6  # rad/(N m)


@dataclass(frozen=True)
class Case:
    """An arm in a cell, and everything a search over its poses needs."""

    model: Model

    @cached_property
    def rules(self) -> Feasibility:
        return Feasibility(self.model.cell, self.model.chain)

    @cached_property
    def space(self) -> JointSpace:
        return joint_space(self.model.cell, self.model.chain)

    @cached_property
    def information(self) -> PoseInformation:
        columns = np.arange(len(self.model.names))
        typical = np.full(len(columns), TYPICAL)
        return PoseInformation(self.model, self.model.nominal, columns, typical)

    @cached_property
    def searches(self) -> Searches:
        return Searches(self.setup, self.space, self.rules)

    @cached_property
    def setup(self) -> Setup:
        """What polish asks of one: how poses are read."""
        nothing: Any = None
        ways = self.information.everything
        return Setup(self.information, nothing, nothing, None, np.zeros(0), (), ways)

    def pool(self, q: Any, group: Any) -> FeasiblePool:
        return self.setup.pool(q, group)

    def draw(self, n: int, seed: int = 0, jobs: int = 1) -> Candidates:
        model = self.model
        return draw(model.cell, model.chain, self.information.forces, self.rules, n, seed, jobs)

    def criterion(self, name: str) -> ScenarioCriterion:
        """`name` on three test poses."""
        p = len(self.information.columns)
        q = np.array([[0.0, 0.3, -0.5, 0.4], [0.5, -0.4, 1.0, 0.2], [0.0, -1.2, 1.5, -1.0]])
        A = self.information.blocks(q)[:, -3:] * SIGMA
        inputs = CriterionInputs(name, p, np.arange(p), A, np.ones(3), n_poses=3)
        return CRITERIA[name].of(inputs)

    def problem(
        self, pool: Candidates, shares: Sequence[int], criterion: ScenarioCriterion
    ) -> DesignProblem:
        p = len(self.information.columns)
        blocks = self.information.blocks(pool.q)
        return DesignProblem(blocks, 1e-2 * np.eye(p), pool.group, np.array(shares), criterion)


@pytest.fixture(scope="session")
def case() -> Callable[..., Case]:
    """Builds the arm; `design` and `workspace` as of the cell, other keywords for the model."""

    def build(
        workspace: Workspace | None = None,
        design: dict[str, Any] | None = None,
        tracker: Tracker | None = None,
        effects: Sequence[str] = EFFECTS,
        **model: Any,
    ) -> Case:
        chain = planar_chain(4)
        spec: dict[str, Any] = {"observe": "deflection", "deflection_model": "linear"} | model
        cell = cell_of(
            effects,
            tracker=tracker or Tracker(noise=CartesianNoise(np.full(3, SIGMA))),
            nominal=Nominal(joint_compliance=(1e-5,) * chain.n_joints),
            **spec,
        )
        cell = replace(
            cell,
            limits={"joint1": (-1.0, 1.0), "joint3": (-2.0, 1.2)},
            workspace=workspace or Workspace(),
            design=DesignSpec(**{"loads": LOAD} | (design or {})),
        )
        return Case(Model.assembled(chain, cell))

    return build
