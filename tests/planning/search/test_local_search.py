"""One pose's blocks as an expression, the slopes of what is minimised, and IPOPT's ends."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from elastocal.cell.arm_description import PolarNoise, Tracker
from elastocal.cell.workspace_rules import Workspace
from elastocal.planning import (
    Goal,
    LocalSearch,
    PlanValue,
    Sensitivity,
    search_all,
    sobol,
    symbolic_blocks,
)
from elastocal.units import Array

Build = Callable[..., Any]
SEEN = Tracker(position=np.array([3.0, -1.0, 0.5]), noise=PolarNoise(1e-5, 3e-7, 1.5e-5, 6e-6))


def some_poses(arm: Any, n: int) -> Array:
    return next(sobol(arm.space, 0, np.random.SeedSequence(8)))[:n]


@pytest.mark.parametrize("tracker", [None, SEEN], ids=["cartesian", "polar"])
def test_expression_is_the_exact_block(case: Build, tracker: Tracker | None) -> None:
    arm = case(tracker=tracker)
    for q in some_poses(arm, 5):
        found = symbolic_blocks(arm.information, q, -1).at(q)
        exact = arm.information.blocks(q[None], np.array([-1]))[:, 0]
        np.testing.assert_allclose(found, exact, atol=1e-10 * np.abs(exact).max())


def test_expression_is_close_where_the_equilibrium_counts(case: Build) -> None:
    arm = case(deflection_model="equilibrium")
    for q in some_poses(arm, 5):
        found = symbolic_blocks(arm.information, q, -1).at(q)
        exact = arm.information.blocks(q[None], np.array([-1]))[:, 0]
        assert np.abs(found - exact).max() < 1e-4 * np.abs(exact).max()


def test_one_expression_serves_every_scenario(case: Build) -> None:
    arm = case()
    x = arm.model.nominal
    information = replace(arm.information, scenarios=np.stack([x, 2 * x, 0.5 * x]))
    q = some_poses(arm, 1)
    found = symbolic_blocks(information, q[0], -1)
    exact = information.blocks(q, np.array([-1]))[:, 0]
    np.testing.assert_allclose(found.at(q[0]), exact, atol=1e-10 * np.abs(exact).max())
    W = np.random.default_rng(0).normal(size=exact.shape)
    h = 1e-6
    numeric = [
        np.sum(W * (found.at(q[0] + step) - found.at(q[0] - step))) / (2 * h)
        for step in h * np.eye(4)
    ]
    np.testing.assert_allclose(
        found.slope(q[0], W), numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max()
    )


@pytest.mark.parametrize("name", ["test_pose", "D", "A", "E", "G", "O5"])
def test_goals_have_exact_slopes(case: Build, name: str) -> None:
    arm = case()
    criterion = arm.criterion(name).softened(20.0)
    q = some_poses(arm, 6)
    B = arm.information.blocks(q, np.full(6, -1))
    M = 1e-2 * np.eye(3)[None] + np.einsum("snri,snrj->sij", B[:, 1:], B[:, 1:])
    G = criterion.gradient(M).G
    for goal in (PlanValue(criterion, M, 1e-3), Sensitivity(G, 0.5)):
        slope = goal.slope(B[:, 0])
        h = 1e-6 * np.abs(B[:, 0]).max()
        for index in np.ndindex(slope.shape):
            step = np.zeros(slope.shape)
            step[index] = h
            numeric = (goal.value(B[:, 0] + step) - goal.value(B[:, 0] - step)) / (2 * h)
            assert numeric == pytest.approx(slope[index], rel=1e-5, abs=1e-5 * np.abs(slope).max())


@dataclass(frozen=True)
class Coupling:
    """f = −(sum of squares of B): the pose that moves most under load."""

    broken: bool = False

    def value(self, B: Array) -> float:
        return np.nan if self.broken else -float(np.sum(B**2))

    def slope(self, B: Array) -> Array:
        return np.full_like(B, np.nan) if self.broken else -2 * B


def search_at(arm: Any, q: Array, **changes: Any) -> LocalSearch:
    return replace(arm.searches.at(q, -1, 0), **changes)


def test_ends_are_stationary_within_the_limits(case: Build) -> None:
    arm = case(Workspace(mounting_plane=False))
    starts = some_poses(arm, 6)
    search, goal = search_at(arm, starts[0]), Coupling()
    lower, upper = arm.space.bounds(0)
    for start, end in zip(starts, search.ends(goal, starts), strict=True):
        assert ((lower <= end) & (end <= upper)).all()
        B = search.blocks.at(end)
        assert goal.value(B) <= goal.value(search.blocks.at(start))
        slope = search.blocks.slope(end, goal.slope(B)) / abs(goal.value(B))
        # No way down but over a limit.
        slope[(end - lower < 1e-5) & (slope > 0)] = 0
        slope[(upper - end < 1e-5) & (slope < 0)] = 0
        assert np.abs(slope).max() < 1e-3


def test_margins_are_kept_unless_the_start_lacks_them(case: Build) -> None:
    arm = case()
    q = ca.SX.sym("q", 4)
    margins = ca.Function("m", [q], [0.5 - q[1] ** 2])
    starts = np.array([[0.0, 0.2, -0.5, 0.3], [0.0, 1.0, -0.5, 0.3]])
    ends = search_at(arm, starts[0], margins=margins).ends(Coupling(), starts)
    assert 0.5 - ends[0, 1] ** 2 > -1e-6
    assert 0.5 - ends[1, 1] ** 2 > -0.5 - 1e-6


def test_a_failed_search_ends_where_it_began(case: Build) -> None:
    arm = case()
    starts = some_poses(arm, 2)
    ends = search_at(arm, starts[0]).ends(Coupling(broken=True), starts)
    np.testing.assert_array_equal(ends, starts)


def test_the_same_ends_in_one_process_and_in_two(case: Build) -> None:
    arm = case()
    starts = some_poses(arm, 3)
    search = search_at(arm, starts[0])
    goal: Goal = Coupling()
    tasks = [(search, goal, starts[:2]), (search, goal, starts[2:])]
    np.testing.assert_array_equal(search_all(tasks, 1), search_all(tasks, 2))
    again = pickle.loads(pickle.dumps(search))
    np.testing.assert_array_equal(again.ends(goal, starts), search.ends(goal, starts))
