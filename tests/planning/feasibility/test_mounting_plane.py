"""Where the cell states nothing around the arm, links and tool stay above its mounting plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cells import kr270_chain
from support.design_cells import plan_cell

from elastocal.cell.work_cell import HalfSpace, Workspace
from elastocal.planning.feasibility import Feasibility

CHAIN, CELL = kr270_chain(), plan_cell()
ZERO = np.zeros(3)
FLOOR = HalfSpace("floor", ZERO, np.array([0.0, 0, 1]))


def heights(q: np.ndarray) -> np.ndarray:
    """z (N, points) of the joints from the second on, flange, load point and markers."""
    frames = Feasibility(CELL, CHAIN).kinematics.poses(q, ZERO)
    tool = np.array([ZERO, CELL.tool.load_point, *CELL.tool.markers.values()])
    joints = frames.frames[:, 1:6, 2, 3]
    flange = frames.flange[:, 2, :3] @ tool.T + frames.flange[:, 2, 3:]
    return np.hstack([joints, flange])


def test_what_reaches_below_it_is_left_out_and_nothing_else() -> None:
    rules = Feasibility(CELL, CHAIN)
    lower, upper = (
        np.array(v) for v in zip(*((j.lower, j.upper) for j in CHAIN.joints), strict=True)
    )
    q = np.random.default_rng(0).uniform(lower, upper, (3000, 6))
    broken = rules.check(q, ZERO)
    low = heights(q).min(axis=1)
    assert broken.removed_by["mounting_plane"] == (~broken.ok).sum() > 100
    assert (low[broken.ok] > 0).all()
    assert (low[~broken.ok] < 0.002).all()


def test_moves_are_checked_against_it() -> None:
    """Joint 2 swings over the plane's edge between two poses above it."""
    rules = Feasibility(CELL, CHAIN)
    up, down = np.radians([[0.0, -90, 90, 0, 0, 0], [0.0, -90, -60, 0, 0, 0]])
    ends = np.array([up, down, np.radians([180.0, -90, 90, 0, 0, 0])])
    assert rules.check(ends[[0, 2]], ZERO).ok.all()
    way = up + np.linspace(0, 1, 50)[:, None] * (np.radians([0.0, 0, 90, 0, 0, 0]) - up)
    dips = heights(way).min() < 0
    assert rules.paths_free(up[None], way[-1:], False)[0] == (not dips)
    assert rules.paths_free(ends[:1], ends[2:], False)[0]


@pytest.mark.parametrize(
    ("space", "stands"),
    [
        (Workspace(), True),
        (Workspace(link_radius=(0.1,) * 6), True),
        (Workspace(keep_out=(FLOOR,)), False),
        (Workspace(keep_out=(FLOOR,), mounting_plane=True), True),
        (Workspace(mounting_plane=False), False),
    ],
)
def test_it_stands_where_nothing_else_is_stated(space: Workspace, stands: bool) -> None:
    rules = Feasibility(replace(CELL, workspace=space), CHAIN)
    assert ("mounting_plane" in [rule.name for rule in rules.rules]) == stands
