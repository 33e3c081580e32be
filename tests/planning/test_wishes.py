"""The weight of the joint ranges; effects of time and order; what is told before the search."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from support.cells import DOWN, kr270_chain, random_poses
from support.design_cells import plan_cell, setup_of

import elastocal as ec
from elastocal.cell import Solid, Workspace
from elastocal.cell_tables import Motion, TargetPose
from elastocal.messages import InputError
from elastocal.model.manipulator import Model
from elastocal.planning import poses as target_poses
from elastocal.planning.design import DesignOptions, _Design
from elastocal.planning.information import Known
from elastocal.planning.plan import Plan
from elastocal.planning.poses import ELSEWHERE, everywhere
from elastocal.planning.relaxation import exact_plan, relax
from elastocal.planning.search import Checkpoint
from elastocal.planning.setup import Setup, clocked, set_up, share_within

CHAIN = kr270_chain()
Q = random_poses(CHAIN, 60, seed=5)


def made(share: float | None) -> Setup:
    cell = plan_cell(loads=DOWN[None], elsewhere=share, test_poses=ONE)
    region, targets = everywhere(cell, CHAIN), target_poses.test_poses(cell, CHAIN)
    assert region is not None and len(region.q) == ELSEWHERE
    return set_up(Model.assembled(CHAIN, cell), Q, 10**9, targets, Known(), region)


def test_the_criterion_is_the_weighted_mean_of_both_errors() -> None:
    setup = made(0.25)
    M = setup.gathered(setup.information.blocks(Q)[:8])
    e = setup.everywhere(M, M[None], M)
    assert e is not None
    mean = 0.75 * e.test_poses**2 + 0.25 * e.elsewhere**2
    assert float(setup.criterion.of_information(M)) == pytest.approx(mean, rel=1e-9)
    assert (e.random_test_poses, e.random_elsewhere) == (e.test_poses, e.elsewhere)


def test_the_share_is_the_largest_that_the_cap_allows_and_no_plan_beats_the_bound() -> None:
    setup, six = made(None), np.array([6])
    pool = setup.pool(Q, np.zeros(60, dtype=np.int64))
    share = share_within(setup, pool, six, 0.05, lambda message: None)
    assert 0.02 < share < 0.9
    own, least = setup.criterion, relax(setup.problem(pool, six).balanced()).value

    def price(share: float) -> float:
        """How much more error at the test poses the relaxed optimum leaves."""
        problem = replace(setup, share=share).problem(pool, six)
        turned = problem.balanced()
        relaxed = relax(turned)
        assert relaxed.bound <= exact_plan(turned, relaxed)[1]
        return float(np.sqrt(own.of_information(problem.at(relaxed.weights)) / least) - 1)

    assert 0.045 < price(share) < 0.0505
    assert price(1.3 * share) > 0.05


HOME = np.radians([0.0, -90, 90, 0, 45, 0])
MOTION = Motion(home=HOME, speed=np.full(6, 0.2), dwell=20.0, load_change=300.0, extra_time=0.0)
ONE = (TargetPose(np.radians([0.0, -90, 90, 0, 30, 0])),)
LATE = ("base_frame", "joint_compliance", "joint_drift:joint2", "hysteresis:joint3")


@lru_cache
def planned() -> Plan:
    cell = plan_cell(
        LATE, "position", loads=np.array([[0.0, 0, 0], DOWN]), poses=8, candidates=60, repeats=2,
        test_poses=ONE, motion=MOTION,
    )  # fmt: skip
    return ec.design(cell, effort="quick")


def test_the_clock_runs_as_the_order_takes() -> None:
    plan = planned()
    stops = plan.execution.stops
    times = [stop.time for stop in stops]
    assert times[0] == pytest.approx(stops[0].travel + 10.0)
    for before, after in pairwise(stops):
        change = 0.0 if after.change_after is None else 300.0
        assert after.time - before.time == pytest.approx(20.0 + after.travel + change)
    last = HOME
    for stop in stops:
        way = np.diff([last, *stop.via, stop.q], axis=0)
        for joint in range(6):
            moved = way[np.abs(way[:, joint]) > 1e-4, joint]
            if len(moved):
                assert stop.approach[joint] == np.sign(moved[-1])
        last = stop.q
    once_more = replace(stops[0], part=1, time=9999.0)  # a visit has a row of its own
    twice = replace(plan, execution=replace(plan.execution, stops=(*stops, once_more))).table()
    assert sorted(twice.time) == pytest.approx([*times, 9999.0], abs=1e-3)
    assert twice.repeat.sum() == 1
    later = clocked(plan.execution, replace(twice, approach=None)).stops  # behind what was measured
    assert [stop.time for stop in later] == pytest.approx([9999.0 + time for time in times])


def test_to_find_them_too_costs_something_and_the_certificate_stays() -> None:
    plan = planned()
    s = plan.scheduled
    assert s is not None and set(s.effects) == {"joint_drift", "hysteresis"}
    assert s.test_poses is not None and s.without is not None
    assert s.without < s.test_poses
    # What was chosen by is the error without them, and its bound holds for both.
    assert s.without * 1e6 == pytest.approx(plan.reported, rel=0.02)
    assert plan.bound_reported is not None and plan.bound_reported <= s.without * 1e6 * 1.001
    assert any(
        "time and order alone show joint_drift, hysteresis" in text for text in plan.warnings
    )


def begun(cell: Any, **options: Any) -> _Design:
    return _Design(cell, DesignOptions(**options), Checkpoint(), lambda text: None)


def test_a_home_in_collision_is_named_at_once() -> None:
    everywhere = Solid("pillar", "box", np.full(3, 6.0), np.eye(4))
    space = Workspace(obstacles=(everywhere,), link_radius=(0.1,) * 6, self_collision=False)
    cell = replace(plan_cell(loads=DOWN[None], motion=Motion(home=HOME)), workspace=space)
    with pytest.raises(InputError, match=r"\[design.motion\] home brings .*pillar.* too close"):
        begun(cell)


def test_a_cell_with_a_drift_can_be_planned_for_and_what_is_held_is_said() -> None:
    cell = plan_cell(("joint_compliance", "base_drift"), loads=DOWN[None])
    found = begun(cell, fixed=("base_drift", "joint1"))
    assert [choice.name for choice in found.model.cell.model.effects] == ["joint_compliance"]
    assert found.options.fixed == ("joint1",)
    (told,) = found.warnings
    assert "time and order alone show base_drift" in told
    assert found.conditions is not None and found.conditions[1] == ("base_drift", "joint1")
    warm = plan_cell(
        ("joint_compliance", "thermal_expansion"), model={"thermal_driver": "temperature"},
        loads=DOWN[None],
    )  # fmt: skip
    (told,) = begun(warm).warnings
    assert "holds thermal_expansion at nominal" in told and "reference poses" in told


def test_parameters_that_no_load_shows_are_told_of_once() -> None:
    cell = plan_cell(("base_frame", "joint_offset", "joint_compliance"), "position")
    (told,) = setup_of(cell, random_poses(kr270_chain(), 40, seed=1)).warnings
    assert "joint1.compliance" in told and "state a load" in told
