"""Test poses and the rest of the joint ranges in one criterion, with its certificate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cells import DOWN, kr270_chain, random_poses
from support.design_cells import plan_cell

from elastocal.cell.plan_wishes import TargetPose
from elastocal.model.manipulator import Model
from elastocal.planning import test_poses as target_poses
from elastocal.planning.information import Known
from elastocal.planning.plan import Everywhere
from elastocal.planning.relaxation import balanced, exact_plan, relax
from elastocal.planning.setup import Setup, set_up, share_within
from elastocal.planning.test_poses import ELSEWHERE, everywhere

CHAIN = kr270_chain()
Q = random_poses(CHAIN, 60, seed=5)
ONE = (TargetPose(np.radians([0.0, -90, 90, 0, 30, 0])),)


def made(share: float | None) -> Setup:
    cell = plan_cell(loads=DOWN[None], elsewhere=share, test_poses=ONE)
    region = everywhere(cell, CHAIN)
    assert region is not None and len(region.q) == ELSEWHERE
    targets = target_poses.test_poses(cell, CHAIN)
    model = Model.assembled(CHAIN, cell)
    return set_up(model, Q, 10**9, targets, Known(), region)


def errors(setup: Setup, chosen: np.ndarray) -> Everywhere:
    assert setup.target_rows is not None and setup.elsewhere_rows is not None
    M = setup.gathered(setup.information.blocks(Q)[chosen])
    return Everywhere.of(setup.target_rows, setup.elsewhere_rows, M, M[None], M)


def test_the_criterion_is_the_weighted_mean_of_both_errors() -> None:
    setup, chosen = made(0.25), np.arange(8)
    e = errors(setup, chosen)
    M = setup.gathered(setup.information.blocks(Q)[chosen])
    mean = 0.75 * e.test_poses**2 + 0.25 * e.elsewhere**2
    assert float(setup.criterion.of_information(M)) == pytest.approx(mean, rel=1e-9)
    assert (e.random_test_poses, e.random_elsewhere) == (e.test_poses, e.elsewhere)


def test_the_share_is_the_largest_that_the_cap_allows_and_no_plan_beats_the_bound() -> None:
    setup, six = made(None), np.array([6])
    pool = setup.pool(Q, np.zeros(60, dtype=np.int64))
    share = share_within(setup, pool, six, 0.05, lambda message: None)
    assert 0.02 < share < 0.9
    own, least = setup.criterion, relax(balanced(setup.problem(pool, six))[0]).value

    def price(share: float) -> float:
        """How much more error at the test poses the relaxed optimum leaves."""
        problem = replace(setup, share=share).problem(pool, six)
        turned, _ = balanced(problem)
        relaxed = relax(turned)
        assert relaxed.bound <= exact_plan(turned, relaxed)[1]
        return float(np.sqrt(own.of_information(problem.at(relaxed.weights)) / least) - 1)

    assert 0.045 < price(share) < 0.0505
    assert price(1.3 * share) > 0.05
