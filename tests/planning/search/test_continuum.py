"""The search of the continuum: never below the pool, up to a dense grid, and it closes the gap."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import pytest

from elastocal.cell.workspace_rules import HalfSpace, Workspace
from elastocal.planning.candidates import CHUNK
from elastocal.planning.polish import estimate
from elastocal.planning.selection import DesignProblem, tangent_bound
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
