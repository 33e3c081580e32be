"""Polished plans: better, within limits, levels and rules, and as good as brute force finds."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import pytest

from elastocal.cell.workspace_rules import HalfSpace, Solid, Workspace
from elastocal.planning.candidates import sobol
from elastocal.planning.polish import polish
from elastocal.units import Array

Build = Callable[..., Any]
POST = np.eye(4)
POST[:3, 3] = [0.8, 0.0, 0.5]
CLUTTER = Workspace(
    obstacles=(Solid("post", "cylinder", np.array([0.1, 1.0]), POST),),
    keep_out=(HalfSpace("floor", np.zeros(3), np.array([0.0, 0.0, 1.0])),),
    link_radius=(0.05,) * 4,
    clearance=0.01,
)
LEVELS = (-1.2, -0.4)


def grid(arm: Any, count: int) -> Array:
    """Every pose of a grid over joints 2 to 4; joint 1 only turns the picture."""
    lower, upper = arm.space.bounds(0)
    axes = [np.linspace(lower[i], upper[i], count) for i in (1, 2, 3)]
    q = np.array(list(product(*axes)))
    return np.hstack([np.zeros((len(q), 1)), q])


@pytest.mark.parametrize("name", ["test_pose", "D"])
def test_a_single_pose_reaches_the_best_of_a_dense_grid(case: Build, name: str) -> None:
    arm = case()
    pool = arm.draw(64)
    problem = arm.problem(pool, [1], arm.criterion(name))
    worst = int(problem.criterion.after_adding(problem.prior, problem.blocks).argmax())
    found = polish(problem, arm.searches, pool.q, pool.load, np.array([worst]), starts=6)
    q = grid(arm, 41)
    blocks = arm.information.blocks(q, np.full(len(q), -1))
    best = problem.criterion.after_adding(problem.prior, blocks).min()
    assert found.before > found.after
    assert best * 0.98 < found.after <= best


@pytest.mark.parametrize("name", ["test_pose", "D", "A", "E", "G", "O5"])
def test_no_criterion_gets_worse_and_no_rule_is_broken(case: Build, name: str) -> None:
    arm = case(CLUTTER, {"levels": {"joint2": LEVELS}}, deflection_model="equilibrium")
    pool = arm.draw(200, seed=1)
    problem = arm.problem(pool, [2, 1], arm.criterion(name))
    chosen = np.array([3, 40, 150])
    found = polish(problem, arm.searches, pool.q, pool.load, chosen, starts=1, sweeps=2)
    assert found.after < found.before
    assert found.before == pytest.approx(arm.value(problem, pool.q[chosen], pool.load[chosen]))
    assert found.after == pytest.approx(arm.value(problem, found.q, pool.load[chosen]), rel=1e-9)
    stayed = (found.q == pool.q[chosen]).all(axis=1)
    np.testing.assert_array_equal(found.moved, ~stayed)
    assert arm.rules.check(found.q, arm.states.forces[-1]).ok.all()
    np.testing.assert_array_equal(found.q[:, 1], [LEVELS[0], LEVELS[0], LEVELS[1]])
    lower, upper = arm.space.lower, arm.space.upper
    assert ((lower <= found.q) & (found.q <= upper)).all()


def test_floor_and_ceiling_at_the_best_poses_cost_something(case: Build) -> None:
    up = np.array([0.0, 0.0, 1.0])
    planes = (HalfSpace("ceiling", 0.7 * up, -up), HalfSpace("floor", 0.33 * up, up))
    free, blocked = case(), case(Workspace(keep_out=planes, link_radius=(0.05,) * 4))
    results = []
    for arm in (free, blocked):
        pool = arm.draw(128)
        problem = arm.problem(pool, [1], arm.criterion("test_pose"))
        found = polish(problem, arm.searches, pool.q, pool.load, np.array([0]), starts=4)
        results.append((found, problem))
    (loose, _), (tight, problem) = results
    assert 1.001 * loose.after < tight.after < tight.before
    assert blocked.rules.check(tight.q, blocked.states.forces[-1]).ok.all()
    q = next(sobol(blocked.space, 0, np.random.SeedSequence(2)))
    q = q[blocked.rules.check(q, blocked.states.forces[-1]).ok]
    blocks = blocked.information.blocks(q, np.full(len(q), -1))
    values = problem.criterion.after_adding(problem.prior, blocks)
    assert tight.after <= values.min()
