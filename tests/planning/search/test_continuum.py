"""The search of the continuum: never below the pool, up to a dense grid, and it closes the gap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from elastocal.cell.workspace_rules import HalfSpace, Workspace
from elastocal.errors import InputError
from elastocal.planning import DesignProblem, estimate, tangent_bound
from elastocal.planning.candidates import CHUNK
from elastocal.units import Array

Build = Callable[..., Any]
RULES = Workspace(
    keep_out=(HalfSpace("floor", np.zeros(3), np.array([0.0, 0.0, 1.0])),),
    link_radius=(0.05,) * 4,
)


def weights(problem: DesignProblem, rounds: int = 1500) -> Array:
    """The relaxation's optimum by multiplication (Titterington 1976; Yu 2010)."""
    w = (problem.shares / np.bincount(problem.group))[problem.group]
    for _ in range(rounds):
        w = w * np.sqrt(problem.sensitivity(problem.criterion.gradient(problem.information(w)).G))
        w = w * (problem.shares / np.bincount(problem.group, w))[problem.group]
    return np.asarray(w)


def sensitivity(arm: Any, G: Array, q: Array) -> Array:
    B = arm.information.blocks(q, np.full(len(q), -1))
    return np.asarray(np.einsum("snri,sij,snrj->n", B, G, B, optimize=True))


def grid(arm: Any, group: int, count: int) -> Array:
    lower, upper = arm.space.bounds(group)
    axes = [[0.0], *(np.unique(np.linspace(lower[i], upper[i], count)) for i in (1, 2, 3))]
    return np.array(list(product(*axes)))


@pytest.mark.parametrize("levels", [{}, {"joint2": (-1.0, 0.2)}], ids=["free", "levels"])
def test_the_largest_sensitivity_of_a_dense_grid_is_found(
    case: Build, levels: dict[str, Any]
) -> None:
    arm = case(RULES, {"levels": levels})
    pool = arm.draw(200)
    shares = [2] * arm.space.n_groups
    problem = arm.problem(pool, shares, arm.criterion("test_pose"))
    tangent = problem.criterion.gradient(problem.information(weights(problem, 50)))
    found = estimate(problem, tangent, arm.searches, pool.q, pool.load, points=CHUNK)
    d = problem.sensitivity(tangent.G)
    for group in range(len(shares)):
        own = problem.group == group
        assert found.largest[group] >= d[own].max()
        q = grid(arm, group, 101 if levels else 33)
        best = np.sort(sensitivity(arm, tangent.G, q))[::-1]
        ranked = q[np.argsort(-sensitivity(arm, tangent.G, q))]
        first = int(arm.rules.check(ranked[:4000], arm.states.forces[-1]).ok.argmax())
        assert best[first] <= found.largest[group] < 1.05 * best[first]
    reach = np.sum(tangent.G * problem.prior) + problem.shares @ found.largest
    assert found.bound == pytest.approx(tangent.value**2 / reach)
    assert found.bound <= tangent_bound(problem, tangent)


def test_new_poses_are_feasible_and_better_than_the_pool(case: Build) -> None:
    arm = case(RULES, {"levels": {"joint2": (-1.0, 0.2)}}, deflection_model="equilibrium")
    pool = arm.draw(100)
    problem = arm.problem(pool, [2, 2], arm.criterion("D"))
    tangent = problem.criterion.gradient(problem.information(weights(problem, 50)))
    found = estimate(problem, tangent, arm.searches, pool.q, pool.load, points=CHUNK, starts=3)
    assert len(found.q) == len(found.load) == len(found.group) > 0
    assert arm.rules.check(found.q, arm.states.forces[-1]).ok.all()
    np.testing.assert_array_equal(found.q[:, 1], np.array([-1.0, 0.2])[found.group])
    d = sensitivity(arm, tangent.G, found.q)
    pool_d = problem.sensitivity(tangent.G)
    for group in (0, 1):
        assert (d[found.group == group] > pool_d[problem.group == group].max()).all()
        assert found.largest[group] == pytest.approx(d[found.group == group].max(), rel=1e-12)
    assert (found.searched, found.ascents) == (2 * CHUNK, 6)
    assert 0 < found.checked <= found.searched


def test_adding_what_is_found_closes_the_gap(case: Build) -> None:
    arm = case(RULES)
    pool = arm.draw(60)
    criterion = arm.criterion("test_pose")
    gaps = []
    for turn in range(6):
        problem = arm.problem(pool, [3], criterion)
        w = weights(problem)
        tangent = criterion.gradient(problem.information(w))
        found = estimate(
            problem, tangent, arm.searches, pool.q, pool.load, points=1, starts=4, seed=turn
        )
        gaps.append(1 - found.bound / tangent.value)
        pool = replace(
            pool,
            q=np.vstack([pool.q, found.q]),
            load=np.append(pool.load, found.load),
            group=np.append(pool.group, found.group),
        )
    assert gaps[0] > 0.01 > 0.001 > gaps[-1]


def test_the_result_depends_on_the_seed_alone(case: Build) -> None:
    arm = case(RULES)
    pool = arm.draw(64)
    problem = arm.problem(pool, [2], arm.criterion("D"))
    tangent = problem.criterion.gradient(problem.information(np.full(64, 2 / 64)))

    def run(seed: int, jobs: int) -> Any:
        return estimate(
            problem, tangent, arm.searches, pool.q, pool.load,
            points=1, starts=2, seed=seed, jobs=jobs,
        )  # fmt: skip

    first, again, two, other = run(1, 1), run(1, 1), run(1, 2), run(2, 1)
    for result in (again, two):
        np.testing.assert_array_equal(result.q, first.q)
        np.testing.assert_array_equal(result.largest, first.largest)
    assert not np.array_equal(other.q, first.q)


def test_a_search_without_points_is_refused(case: Build) -> None:
    arm = case()
    pool = arm.draw(64)
    problem = arm.problem(pool, [1], arm.criterion("D"))
    tangent = problem.criterion.gradient(problem.information(np.full(64, 1 / 64)))
    with pytest.raises(InputError, match="needs points and starts"):
        estimate(problem, tangent, arm.searches, pool.q, pool.load, points=0)
