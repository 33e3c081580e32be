"""The order of execution: shortest, free of collision, grouped by load."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support.discs import Discs, best_time

from elastocal.cell_tables import Motion
from elastocal.messages import InputError, InsufficientDataError
from elastocal.planning.execution import schedule
from elastocal.planning.feasibility import Unreachable

BOTH = np.array([[0.0, 0, 0], [0, 0, -100.0]])
LIMITS = (np.full(2, -3.0), np.full(2, 3.0))
CORNERS = np.array([[-2.5, -2.5], [-2.5, 2.5], [2.5, -2.5], [2.5, 2.5]])
DISCS = [(0.0, 0.0, 0.5), (1.2, 0.9, 0.35), (-1.0, 1.1, 0.4)]


def poses(seed, n, checker):
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < n:
        q = rng.uniform(-2, 2, 2)
        if checker.free(q, q, True):
            found.append(q)
    return np.array(found)


def driven(execution, q, forces):
    """Every straight move that is driven, with whether the load hangs, by replaying the stops."""
    home = execution.motion.home
    here, loaded, moves = home, False, []
    for stop in execution.stops:
        path = [*stop.via, stop.q]
        for done in range(len(path) + 1):
            if stop.change_after == done:
                assert loaded or forces[stop.load].any()
                loaded = bool(forces[stop.load].any())
            if done < len(path):
                if here is not None:
                    moves.append((here, path[done], loaded))
                here = path[done]
        assert np.array_equal(stop.q, q[stop.pose])
        assert loaded == bool(forces[stop.load].any())
    assert execution.take_off == loaded
    if home is not None:
        for point in [*execution.home_via, home]:
            moves.append((here, point, False))
            here = point
    return moves


def travelled(moves, speed=1.0):
    return sum(np.abs((b - a) / speed).max() for a, b, _ in moves)


@pytest.mark.parametrize("home", [None, np.array([-2.0, -2.0])])
@pytest.mark.parametrize("seed", range(4))
def test_small_plans_take_the_time_of_the_best_order(seed, home):
    checker = Discs(DISCS)
    q = poses(seed, 6, checker)
    execution = schedule(q, Motion(home=home), checker, via=CORNERS)
    best = best_time(q, checker, home, via=CORNERS)
    assert execution.travel == pytest.approx(best, abs=1e-9)
    assert sorted(stop.pose for stop in execution.stops) == list(range(6))


@settings(max_examples=10, deadline=None)
@given(
    st.integers(0, 10_000),
    st.booleans(),
    st.sampled_from([BOTH[:1], BOTH[1:], BOTH]),
    st.booleans(),
)
def test_every_move_driven_is_free_and_every_reading_is_made_once(seed, at_home, forces, both):
    checker = Discs(DISCS, grow=0.1)
    q = poses(seed, 7, checker)
    home = np.array([-2.0, -2.0]) if at_home else None
    motion = Motion(home=home, both_directions=both, overshoot=0.03, speed=np.array([0.5, 2.0]))
    try:
        execution = schedule(q, motion, checker, loads=forces, limits=LIMITS, via=CORNERS)
    except Unreachable:
        assume(False)  # discs all around a pose: rare, or hypothesis complains
    moves = driven(execution, q, forces)
    assert all(checker.free(a, b, loaded) for a, b, loaded in moves)
    assert execution.travel == pytest.approx(travelled(moves, motion.speed), abs=1e-9)
    read = [(stop.pose, stop.load, stop.side) for stop in execution.stops]
    assert len(set(read)) == len(read)
    assert {key[:2] for key in read} == {(i, s) for i in range(7) for s in range(len(forces))}
    assert {key for key in read if key[2] == 1} or not both
    changes = sum(a.load != b.load for a, b in pairwise(execution.stops))
    assert changes == len(forces) - 1


def test_a_wall_is_passed_through_the_points_offered_and_nothing_is_measured_there():
    wall = Discs([(0.0, y, 0.3) for y in np.arange(-3, 3.01, 0.4)])
    q = np.array([[-1.0, 0.0], [1.0, 0.2], [-1.2, 0.5], [1.3, -0.4]])
    with pytest.raises(InsufficientDataError, match="cannot be reached"):
        schedule(q, Motion(), wall)
    around = np.array([[-0.5, 4.0], [0.5, 4.0]])
    execution = schedule(q, Motion(), wall, via=around)
    assert sum(len(stop.via) for stop in execution.stops) == 2
    assert all(wall.free(a, b, False) for a, b, _ in driven(execution, q, BOTH))
    assert execution.travel == pytest.approx(best_time(q, wall, via=around), abs=1e-9)


def test_from_both_sides_each_joint_arrives_upwards_and_downwards():
    q = poses(5, 6, Discs())
    motion = Motion(both_directions=True, overshoot=0.05)
    execution = schedule(q, motion, Discs(), limits=LIMITS)
    assert len(execution.stops) == 12 and not execution.one_sided
    for stop in execution.stops:
        last = stop.q - stop.via[-1]
        assert np.allclose(last, 0.05 * stop.approach)
        assert (stop.approach == (-1 if stop.side else 1)).all()


def test_a_side_that_is_blocked_is_left_out_and_told():
    near = Discs([(0.0, 0.0, 0.5)])
    q = np.array([[0.36, 0.36], [2.0, 2.0], [-2.0, 1.0]])
    execution = schedule(q, Motion(both_directions=True), near, limits=LIMITS)
    assert execution.one_sided == (0,)
    assert [s.side for s in execution.stops if s.pose == 0] == [1]
    boxed = Discs([(0.0, 0.0, 0.5), (0.72, 0.72, 0.5)], named=["the post"])
    with pytest.raises(InsufficientDataError, match=r"pose 1 .*neither from below .*post"):
        schedule(q, Motion(both_directions=True), boxed, limits=LIMITS)


def test_an_unreachable_pose_is_named_with_what_is_in_the_way():
    circle = [(np.cos(a), np.sin(a), 0.3) for a in np.arange(0, 2 * np.pi, 0.3)]
    ring = Discs(circle, named=["link3 and fence"])
    q = np.array([[2.0, 0.0], [0.05, 0.1], [0.0, 2.0], [-2.0, 0.0]])
    with pytest.raises(InsufficientDataError, match=r"pose 2 .*2\.86479°.*link3 and fence"):
        schedule(q, Motion(), ring)
    with pytest.raises(InsufficientDataError, match="pose 2"):
        schedule(q[:2], Motion(home=np.array([2.0, 2.0])), ring)
    with pytest.raises(InsufficientDataError, match=r"home .*cannot be reached"):
        schedule(q[[0, 2]] + [0.1, 0.0], Motion(home=np.array([0.05, 0.1])), ring, via=CORNERS)


def test_a_joint_without_room_for_an_approach_is_told():
    motion = Motion(both_directions=True, overshoot=4.0)
    with pytest.raises(InputError, match="no room"):
        schedule(np.zeros((2, 2)), motion, Discs(), loads=BOTH, limits=LIMITS)
