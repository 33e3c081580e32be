"""Test poses and the rest of the joint ranges in one criterion, with its certificate."""

from __future__ import annotations

import numpy as np
import pytest
from support.cells import DOWN, kr270_chain, random_poses
from support.design_cells import all_loads, plan_cell

from elastocal.cell.plan_wishes import TargetPose
from elastocal.model import Model
from elastocal.planning import Known, Setup, load_states, relax, set_up
from elastocal.planning import test_poses as target_poses
from elastocal.planning.exact_plan import exact_plan
from elastocal.planning.plan import Everywhere
from elastocal.planning.test_poses import ELSEWHERE, everywhere

CHAIN = kr270_chain()
Q = random_poses(CHAIN, 60, seed=5)
ONE = (TargetPose(np.radians([0.0, -90, 90, 0, 30, 0])),)


def made(share: float) -> Setup:
    cell = plan_cell(loads=DOWN[None], elsewhere=share, test_poses=ONE)
    region = everywhere(cell, CHAIN)
    assert region is not None and len(region.q) == ELSEWHERE
    targets = target_poses.test_poses(cell, CHAIN)
    model = Model.assembled(CHAIN, cell)
    return set_up(
        model, load_states(cell), Q, all_loads(Q), 10**9, targets, Known(), 0, region
    )  # fmt: skip


def errors(setup: Setup, chosen: np.ndarray) -> Everywhere:
    assert setup.target_rows is not None and setup.elsewhere_rows is not None
    M = setup.gathered(setup.information.blocks(Q, all_loads(Q))[:, chosen])[0]
    return Everywhere.of(setup.target_rows, setup.elsewhere_rows, M, M[None], M)


def best(setup: Setup) -> np.ndarray:
    """The best plan found of six poses, checked against its bound."""
    problem = setup.problem(
        setup.pool(Q, all_loads(Q), np.zeros(60, dtype=np.int64)), np.array([6])
    )
    found = exact_plan(problem, starts=4)
    bound = relax(problem).bound
    assert 0.8 * found.value <= bound <= found.value
    return found.chosen


def test_the_criterion_is_the_weighted_mean_of_both_errors() -> None:
    setup, chosen = made(0.25), np.arange(8)
    e = errors(setup, chosen)
    M = setup.gathered(setup.information.blocks(Q, all_loads(Q))[:, chosen])
    mean = 0.75 * e.test_poses**2 + 0.25 * e.elsewhere**2
    assert float(setup.criterion.value(M)) == pytest.approx(mean, rel=1e-9)
    assert (e.random_test_poses, e.random_elsewhere) == (e.test_poses, e.elsewhere)


def test_a_share_elsewhere_costs_little_at_the_test_poses_and_buys_the_rest() -> None:
    alone, shared = made(0.0), made(0.3)
    narrow, wide = errors(alone, best(alone)), errors(shared, best(shared))
    assert wide.elsewhere < narrow.elsewhere
    assert narrow.test_poses <= wide.test_poses < 1.5 * narrow.test_poses
