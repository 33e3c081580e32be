"""Candidates cover the joint space evenly, keep the cell's rules, and are counted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from elastocal.cell.workspace_rules import HalfSpace, Solid, Workspace
from elastocal.errors import InsufficientDataError
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
    assert arm.rules.check(found.q, arm.information.forces[-1]).ok.all()
    assert found.tried == found.feasible + sum(found.removed_by.values())
    assert found.removed_by["keep_out"] > 0 and found.removed_by["obstacle"] > 0
    assert found.tried % CHUNK == 0 and found.feasible >= 2000


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
