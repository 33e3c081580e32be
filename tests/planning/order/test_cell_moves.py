"""The order of execution in a real work cell, checked by dense samples of every move."""

from dataclasses import replace

import numpy as np
import pytest
from planning.feasibility.small_cells import breaking
from support.cells import kr270_cell, kr270_chain, random_poses

from elastocal.cell.plan_wishes import Motion
from elastocal.cell.work_cell import CarriedBody, HalfSpace, HangingLoad, Solid, Workspace
from elastocal.errors import InsufficientDataError
from elastocal.planning.execution import schedule
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.moves import blockers_of

LOADS = np.array([[0.0, 0, 0], [0, 0, -2600.0]])
HOME = np.radians([0.0, -90, 90, 0, 45, 0])


def at(x, y, z):
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


@pytest.fixture(scope="module")
def feasibility():
    workspace = Workspace(
        obstacles=(
            Solid("pillar", "cylinder", np.array([0.2, 3.0]), at(1.6, 1.3, 1.5)),
            Solid("table", "box", np.array([1.0, 1.0, 0.8]), at(-1.2, 1.6, 0.4)),
        ),
        bodies=(CarriedBody(Solid("tool", "box", np.array([0.2, 0.2, 0.25]), at(0, 0, 0.125))),),
        keep_out=(HalfSpace("floor", np.zeros(3), np.array([0.0, 0, 1])),),
        load=HangingLoad(Solid("weight", "sphere", np.array([0.2])), rope=0.3),
        link_radius=(0.25, 0.2, 0.2, 0.15, 0.12, 0.1),
        clearance=0.02,
    )
    return Feasibility(replace(kr270_cell(), workspace=workspace), kr270_chain())


def test_every_move_keeps_clear_with_and_without_the_load(feasibility):
    q = random_poses(feasibility.chain, 300, seed=2)
    q = q[feasibility.feasible(q, LOADS[1]) & feasibility.feasible(q, LOADS[0])]
    assert len(q) > 60
    via = q[8:60]
    motion = Motion(home=HOME, speed=np.radians([90.0]))
    execution = schedule(q[:8], motion, feasibility, loads=LOADS, via=via)
    assert execution.load_changes == 2
    here, force = HOME, LOADS[0]
    step = np.linspace(0, 1, 60)[:, None]
    collision = ("keep_out", "obstacle", "self_collision", "load_height")
    for stop in execution.stops:
        for done, goal in enumerate([*stop.via, stop.q]):
            force = LOADS[stop.load] if stop.change_after == done else force
            verdict = feasibility.check(here + step * (goal - here), force)
            assert not any(breaking(verdict).get(rule, 0) for rule in collision)
            here = goal
        force = LOADS[stop.load]


def test_the_bodies_in_the_way_are_named(feasibility):
    blockers = blockers_of(feasibility)
    q = np.radians([-39.0, -20, 60, 0, 0, 0])  # the arm stretched out through the pillar
    turn = np.array([1.2, 0, 0, 0, 0, 0])
    met = blockers(q - turn, q + turn, False)
    assert any("pillar" in pair for pair in met)
    assert not any("weight" in pair for pair in met)


def test_a_home_behind_the_pillar_is_told_with_the_pillar(feasibility):
    inside = np.radians([-39.0, -20, 20, 0, 0, 0])
    assert not feasibility.paths_free(inside, inside, False)
    q = random_poses(feasibility.chain, 60, seed=3)
    q = q[feasibility.feasible(q, LOADS[0])][:3]
    with pytest.raises(InsufficientDataError, match=r"home .*in the way: .*pillar"):
        schedule(q, Motion(home=inside), feasibility, blockers=blockers_of(feasibility))
