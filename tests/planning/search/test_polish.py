"""Poses off the pool: slopes are exact, no rule or limit is broken, and Φ never rises."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pytest
from support.calibration import cell_of, planar_chain

from elastocal.cell import HalfSpace, Solid, Workspace
from elastocal.cell_tables import CartesianNoise, DesignSpec, Nominal, Tracker
from elastocal.model.manipulator import Model
from elastocal.planning.criteria import CRITERIA, CriterionInputs, ScenarioCriterion
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.information import PoseInformation
from elastocal.planning.poses import Candidates, JointSpace, draw, joint_space
from elastocal.planning.relaxation import DesignProblem, relax
from elastocal.planning.search import JointSearch, Searches, estimate, polish
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

    def draw(self, n: int) -> Candidates:
        return draw(self.rules, self.information.forces, n, 0)

    def criterion(self, name: str) -> ScenarioCriterion:
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


def build(
    workspace: Workspace | None = None,
    design: dict[str, Any] | None = None,
    tracker: Tracker | None = None,
    effects: Sequence[str] = EFFECTS,
    **model: Any,
) -> Case:
    """The arm; `design` and `workspace` as of the cell, other keywords for the model."""
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


FLOOR = HalfSpace("floor", np.zeros(3), np.array([0.0, 0.0, 1.0]))
POST = np.eye(4)
POST[:3, 3] = [0.9, 0.0, 0.5]
CLUTTER = Workspace(
    obstacles=(Solid("post", "cylinder", np.array([0.1, 1.0]), POST),),
    keep_out=(FLOOR,),
    link_radius=(0.05,) * 4,
)
LOADS = np.array([[0.0, 0.0, -200.0], [50.0, 0.0, -100.0]])
CASES = {
    "free": {},
    "clutter": {"workspace": CLUTTER},
    "levels": {"workspace": CLUTTER, "design": {"levels": {"joint2": (-1.0, 0.3)}}},
    "loads": {"design": {"loads": LOADS}, "observe": "position"},
    "geometry": {
        "effects": ("base_frame", "joint_offset", "link_geometry", "joint_compliance"),
        "observe": "position",
    },
}


def posed(name: str, criterion: str = "test_pose", n: int = 5, seed: int = 0) -> Any:
    arm = build(**CASES[name])
    pool = arm.draw(200)
    groups = int(pool.group.max()) + 1
    shares = np.array([n // groups + (g < n % groups) for g in range(groups)])
    whole = arm.problem(pool, shares, arm.criterion(criterion))
    T = whole.balancing()
    problem = whole.balanced(T)
    chosen = problem.random(np.random.default_rng(seed))
    return arm, pool, whole, problem, T, chosen


def value_of(arm: Any, whole: Any, q: Any) -> float:
    B = arm.information.blocks(q)
    M = whole.prior + np.einsum("nri,nrj->ij", B, B)
    return float(whole.criterion.of_information(M))


@pytest.mark.parametrize("name", CASES)
def test_slopes_are_those_of_the_blocks(name: str) -> None:
    arm, pool, _, _, T, chosen = posed(name)
    q, group = pool.q[chosen], pool.group[chosen]
    search = JointSearch(arm.searches, T, arm.pool(q, group))
    exact = arm.information.blocks(q) @ T
    np.testing.assert_allclose(search.blocks(q), exact, rtol=1e-9, atol=1e-9 * np.abs(exact).max())
    rng = np.random.default_rng(1)
    W, step = rng.normal(size=exact.shape), rng.normal(size=q.shape)
    h = 1e-6
    ahead, behind = (np.sum(W * search.blocks(q + s * h * step)) for s in (1, -1))
    assert np.sum(search.slope(q, W) * step) == pytest.approx((ahead - behind) / (2 * h), rel=1e-5)


@pytest.mark.parametrize(
    ("name", "criterion"),
    [*((name, "test_pose") for name in CASES if name != "geometry"), ("clutter", "E")],
)
def test_a_polished_plan_is_better_and_keeps_limits_levels_and_rules(
    name: str, criterion: str
) -> None:
    arm, pool, whole, problem, T, chosen = posed(name, criterion)
    q, group = pool.q[chosen], pool.group[chosen]
    before = whole.value(chosen)
    end = polish(problem, arm.searches, T, arm.pool(q, group))
    after = value_of(arm, whole, end)
    assert after < 0.9 * before
    assert arm.searches.feasible(end).all()
    lower, upper = (np.array(side) for side in zip(*map(arm.space.bounds, group), strict=True))
    assert (end >= lower - 1e-12).all() and (end <= upper + 1e-12).all()


def test_the_bound_on_the_continuum_is_below_that_on_the_pool() -> None:
    arm, pool, whole, problem, T, _ = posed("clutter")
    relaxed = relax(problem)
    found = estimate(problem, relaxed.tangent, arm.searches, T, arm.pool(pool.q, pool.group))
    assert 0 < found["bound"] <= relaxed.bound * (1 + 1e-9)
    assert len(found["q"]) and arm.searches.feasible(found["q"]).all()
    B = arm.pool(found["q"], found["group"]).blocks @ T
    d = np.einsum("nri,ij,nrj->n", B, relaxed.tangent.G, B)
    assert (d > problem.prices(relaxed.tangent.G).max()).all()
    # Their tangent bounds plans of poses anywhere, as those of a polish.
    for seed in range(2):
        plan = problem.random(np.random.default_rng(seed))
        q = pool.q[plan]
        end = polish(problem, arm.searches, T, arm.pool(q, pool.group[plan]))
        assert value_of(arm, whole, end) >= found["bound"] * (1 - 1e-3)


def test_a_plan_of_local_optimum_stays() -> None:
    arm, pool, whole, problem, T, chosen = posed("free")
    group = pool.group[chosen]
    q = polish(problem, arm.searches, T, arm.pool(pool.q[chosen], group), fine=True)
    again = polish(problem, arm.searches, T, arm.pool(q, group), fine=True)
    phi, same = (value_of(arm, whole, at) for at in (q, again))
    assert same == pytest.approx(phi, rel=1e-4) and same <= phi
