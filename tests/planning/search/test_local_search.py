"""One pose's blocks as an expression, the slopes of what is minimised, and IPOPT's ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from elastocal.cell.arm_description import PolarNoise, Tracker
from elastocal.cell.workspace_rules import Workspace
from elastocal.planning import (
    LocalSearch,
    PlanValue,
    Sensitivity,
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
