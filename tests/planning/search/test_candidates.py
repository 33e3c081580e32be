"""Candidates cover the joint space evenly, keep the cell's rules, and are counted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import qmc

from elastocal.cell.workspace_rules import HalfSpace, Solid, Workspace
from elastocal.errors import InputError, InsufficientDataError
from elastocal.planning import candidates as module
from elastocal.planning import feasible, joint_space
from elastocal.planning.candidates import CHUNK

Build = Callable[..., Any]
FLOOR = HalfSpace("floor", np.zeros(3), np.array([0.0, 0.0, 1.0]))
POST = np.eye(4)
POST[:3, 3] = [0.9, 0.0, 0.5]
CLUTTER = Workspace(
    obstacles=(Solid("post", "cylinder", np.array([0.1, 1.0]), POST),),
    keep_out=(FLOOR,),
    link_radius=(0.05,) * 4,
)


def test_same_seed_same_candidates_whatever_the_jobs(case: Build) -> None:
    arm = case(CLUTTER)
    one, again, two = arm.draw(1500, 3), arm.draw(1500, 3), arm.draw(1500, 3, jobs=2)
    for name in ("q", "load", "group", "tried", "feasible", "removed_by"):
        np.testing.assert_array_equal(getattr(one, name), getattr(again, name))
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert not np.array_equal(one.q, arm.draw(1500, 4).q)


def test_every_joint_is_covered_evenly(case: Build) -> None:
    arm = case(Workspace(mounting_plane=False))
    q = arm.draw(CHUNK).q
    lower, upper = arm.space.bounds(0)
    unit = (q - lower) / (upper - lower)
    # A scrambled net of 2^k points has as many in each of 2^j equal slices of every joint.
    for column in unit.T:
        assert (np.bincount((column * 256).astype(int), minlength=256) == CHUNK // 256).all()
    random = np.random.default_rng(0).random(unit.shape)
    assert qmc.discrepancy(unit) < 0.1 * qmc.discrepancy(random)


def test_levels_are_held_and_equally_many(case: Build) -> None:
    levels = (-1.5, 0.1, -0.7)
    found = case(CLUTTER, {"levels": {"joint2": levels}}).draw(900)
    np.testing.assert_array_equal(np.bincount(found.group), [300, 300, 300])
    np.testing.assert_array_equal(found.q[:, 1], np.array(levels)[found.group])
    for group in range(3):
        assert np.ptp(found.q[found.group == group], axis=0)[[0, 2, 3]].min() > 1.0


def test_only_feasible_poses_and_all_tries_counted(case: Build) -> None:
    arm = case(CLUTTER)
    found = arm.draw(2000)
    assert len(found.q) == 2000
    assert arm.rules.check(found.q, arm.states.forces[-1]).ok.all()
    assert found.tried == found.feasible + sum(found.removed_by.values())
    assert found.removed_by["keep_out"] > 0 and found.removed_by["obstacle"] > 0
    assert found.tried % CHUNK == 0 and found.feasible >= 2000


LOADS = np.array([[0.0, 0.0, -20.0], [0.0, 0.0, -200.0]])
WEAK = Workspace(torque_limits=(1e3, 150.0, 150.0, 150.0), mounting_plane=False)


def test_a_chosen_load_is_one_that_the_pose_bears(case: Build) -> None:
    arm = case(WEAK, {"loads": LOADS, "load_choice": True}, observe="position")
    found = arm.draw(2000)
    light, heavy = (arm.rules.check(found.q, force).ok for force in LOADS)
    assert np.where(found.load == 0, light, heavy).all()
    only_light = found.q[~heavy]
    assert len(only_light) and (found.load[~heavy] == 0).all()
    # Poses that bear both states are there once for each.
    both = found.q[heavy & (found.load == 0)][:-1]
    assert all((found.q == q).all(axis=1).sum() == 2 for q in both[:50])


def test_a_pose_measured_in_all_loads_bears_each(case: Build) -> None:
    arm = case(WEAK, {"loads": LOADS}, observe="position")
    found = arm.draw(2000)
    assert (found.load == -1).all()
    assert all(arm.rules.check(found.q, force).ok.all() for force in LOADS)
    assert found.tried == found.feasible + found.removed_by["torque"] > found.feasible
    q = module.sobol(arm.space, 0, np.random.SeedSequence(1)).__next__()
    each = [arm.rules.check(q, force).ok for force in LOADS]
    np.testing.assert_array_equal(feasible(arm.rules, q, LOADS), each[0] & each[1])


def test_nothing_feasible_names_level_and_rule(case: Build) -> None:
    wall = HalfSpace("wall", np.array([0.0, 0.0, 1.5]), np.array([0.0, 0.0, 1.0]))
    arm = case(
        Workspace(keep_out=(wall,), link_radius=(0.05,) * 4), {"levels": {"joint2": (-1.4, 1.4)}}
    )
    with pytest.raises(
        InsufficientDataError,
        match=r"no feasible pose found with joint2 at -80\.2141°.*keep_out.*wall",
    ):
        arm.draw(100)


def test_few_feasible_poses_end_the_search(case: Build, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "TRIES", 1)
    monkeypatch.setattr(module, "GIVE_UP", CHUNK)
    arm = case(CLUTTER)
    found = arm.draw(3 * CHUNK)
    assert found.tried == 3 * CHUNK
    assert len(found.q) == found.feasible < 3 * CHUNK


def test_more_levels_than_candidates_are_refused(case: Build) -> None:
    arm = case(design={"levels": {"joint2": (0.0, 0.1, 0.2)}})
    with pytest.raises(InputError, match="2 candidates are too few for 3 levels"):
        arm.draw(2)


def test_a_joint_without_limits_turns_once(case: Build) -> None:
    model = case().model
    joints = list(model.chain.joints)
    joints[3] = replace(joints[3], lower=-np.inf, upper=np.inf)
    space = joint_space(model.cell, replace(model.chain, joints=tuple(joints)))
    np.testing.assert_allclose([space.lower[3], space.upper[3]], [-np.pi, np.pi])
    # The cell's limits narrow the robot's.
    np.testing.assert_allclose([space.lower[2], space.upper[2]], [-2.0, 1.2])
