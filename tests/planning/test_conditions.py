"""Effects of time and of the approach in a plan: at the times of its order, from its sides."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest
from support.cells import DOWN
from support.design_cells import plan_cell

import elastocal as ec
from elastocal.cell.plan_wishes import Motion, TargetPose
from elastocal.planning.plan import Plan

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
