"""A pose that no move reaches does not cost the user the whole plan: the best other replaces it."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.cells import DOWN, kr270_chain, random_poses
from support.design_cells import plan_cell, setup_of

from elastocal.planning.feasibility import Feasibility, Unreachable
from elastocal.planning.plan import Certificate
from elastocal.planning.poses import joint_space
from elastocal.planning.relaxation import exact_plan, relax
from elastocal.planning.search import EFFORTS, Checkpoint, Search, Searches, ordered
from elastocal.planning.setup import FeasiblePool

CHAIN = kr270_chain()
CELL = plan_cell(("joint_compliance",), loads=DOWN[None])
SHARES = np.array([6])


class Walled(Feasibility):
    """No move passes joint1 = `wall`; counts how often each is checked."""

    wall, calls = np.inf, 0
    asked: Counter[Any]
    _paths: Any = property(lambda self: self)

    def free(self, q_from: Any, q_to: Any, loaded: Any) -> Any:
        ends = zip(q_from, q_to, loaded, strict=True)
        self.calls += 1
        self.asked.update((frozenset((a.tobytes(), b.tobytes())), hung) for a, b, hung in ends)
        return (q_from[:, 0] < self.wall) == (q_to[:, 0] < self.wall)


class Stepping(Walled):
    """No move turns joint1 by half a radian or more."""

    def free(self, q_from: Any, q_to: Any, loaded: Any) -> Any:
        return np.abs(q_from[:, 0] - q_to[:, 0]) < 0.5


def selection() -> tuple[Any, FeasiblePool, Any]:
    q = random_poses(CHAIN, 60, seed=2)
    setup = setup_of(CELL, q)
    pool = setup.pool(q, np.zeros(len(q), dtype=np.int64))
    chosen = np.argsort(q[:, 0])[[0, 10, 20, 30, 40, 59]]
    return setup, pool, chosen


def walled(wall: float, home: Any = None) -> Walled:
    motion = replace(CELL.design.motion, home=home)
    feasibility = Walled(replace(CELL, design=replace(CELL.design, motion=motion)), CHAIN)
    feasibility.wall, feasibility.asked = wall, Counter()
    return feasibility


def search(setup: Any, pool: FeasiblePool, chosen: Any, cell: Walled, effort: str) -> Search:
    searches = Searches(setup, joint_space(CELL, CHAIN), cell)
    quiet = Checkpoint(), lambda text: None
    found = Search(pool, searches, SHARES, EFFORTS[effort], 0, *quiet)
    value = found.value_of(chosen)
    found.certificate = Certificate(len(pool), value / 2, bound_continuum=value / 4)
    found.exchange(chosen)
    return found


@pytest.mark.parametrize(("effort", "at"), [("batch", 45), ("quick", 45), ("quick", 15)])
def test_unreachable_poses_are_replaced_and_the_bound_still_holds(effort, at, monkeypatch) -> None:
    monkeypatch.setattr("elastocal.planning.search.LIKELY", 5)
    setup, pool, chosen = selection()
    wall = np.sort(pool.q[:, 0])[at]
    cell = walled(wall, pool.q[chosen[0]] if at < 20 else None)  # where most are not with home
    after = search(setup, pool, chosen, cell, effort)
    bounds = after.certificate
    _, _, told = ordered(after)
    assert max(cell.asked.values()) == 1, "each move is checked once, however often plans change"
    most = 60 + (effort == "quick") * 4 * 5 * 6  # boxes, steps and poses tried of a polish
    assert cell.calls < most, "of the hundreds of moves past the wall many are checked at a time"
    there = after.problem.restricted(np.flatnonzero(pool.q[:, 0] < wall))
    assert after.value <= 1.01 * exact_plan(there, relax(there))[1]
    q = after.pool.q[after.chosen]
    assert (q[:, 0] < wall).all() and len(q) == 6
    assert after.value == pytest.approx(after.value_of(after.chosen))
    c = after.certificate
    assert c.bound_pool == bounds.bound_pool
    assert c.efficiency_pool == pytest.approx(min(c.bound_pool / after.value, 1.0))
    assert c.efficiency_continuum == pytest.approx(min(bounds.bound_continuum / after.value, 1.0))
    assert len(told) == 1 and "left out" in told[0]


def test_where_no_other_candidates_are_left_the_poses_are_named() -> None:
    setup, pool, chosen = selection()
    pool = pool.take(chosen)
    wall = np.sort(pool.q[:, 0])[4]
    with pytest.raises(Unreachable, match=r"pose \d+ \(joints .* cannot be reached"):
        ordered(search(setup, pool, np.arange(6), walled(wall), "quick"))


def test_few_poses_that_were_brought_are_joined_through_drawn_ones() -> None:
    setup, pool, chosen = selection()
    after = search(setup, pool.take(chosen), np.arange(6), Stepping(CELL, CHAIN), "batch")
    execution, _, told = ordered(after)
    assert told == [] and {stop.pose for stop in execution.stops} == set(range(6))
    assert 0 < sum(len(stop.via) for stop in execution.stops) == len(execution.between)
    assert np.array_equal(after.whole(after.chosen)[0].q, pool.q[chosen])
