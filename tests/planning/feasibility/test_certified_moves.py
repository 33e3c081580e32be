"""Moves: what is called free is free at every point, and little that is free is refused."""

from dataclasses import replace

import coal
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning.feasibility.small_cells import (
    DOWN,
    KR270_CHAIN,
    NOTHING,
    at,
    box,
    cell,
    gantry_at,
    gantry_rules,
    kr270_poses,
    random_chain,
    sphere,
)
from planning.feasibility.test_margins_of_pairs import kr270_cell

from elastocal.cell import CarriedBody, HalfSpace, HangingLoad, Solid, Workspace
from elastocal.cell_tables import Tool
from elastocal.planning.collision import Body, Collisions, MotionBound, coal_shape
from elastocal.planning.feasibility import Feasibility

BALL = Workspace(bodies=(CarriedBody(sphere("tool", 0.1, (0, 0, 0))),), clearance=0.05)


def dense(rules, start, end, n=250):
    return start + np.linspace(0, 1, n)[:, None] * (end - start)


@pytest.mark.parametrize("seed", range(2))
def test_no_pair_changes_its_distance_by_more_than_the_bound(seed, tmp_path):
    """Random chains with slides, loaded: measured distances against MotionBound's."""
    chain = random_chain(seed, tmp_path)
    rng = np.random.default_rng(seed)
    workspace = Workspace(
        link_radius=(0.02,),
        bodies=(
            CarriedBody(box("tool", (0.2, 0.1, 0.3), (0.1, 0, 0.2))),
            CarriedBody(Solid("disc", "cylinder", np.array([0.6, 0.02]), at(0, 0, 0.1))),
            CarriedBody(sphere("ball", 0.3, (0, 0, -0.2)), "link3"),
        ),
        obstacles=(box("rock", (0.3, 0.3, 0.3), (0.5, 0.5, 0.5)),),
        keep_out=(HalfSpace("wall", np.array([-3.0, 0, 0]), np.array([1.0, 0, 0])),),
        load=HangingLoad(box("load", (0.2, 0.2, 0.2), (0, 0, 0)), 0.3),
    )
    rules = Feasibility(cell(workspace, Tool(np.array([0.1, 0, 0.2]))), chain)
    bound = MotionBound(rules.kinematics, rules.pairs)
    tightest = 0.0
    for _ in range(15):
        middle = rng.uniform(-1, 1, chain.n_joints)
        half = rng.uniform(0, 0.3, chain.n_joints) * (rng.random(chain.n_joints) < 0.5)
        largest = bound(rules.kinematics.poses(middle, DOWN), half[None])[0]
        for q in middle + half * rng.choice([-1.0, 1.0, 0.3], (4, chain.n_joints)):
            change = np.abs(distances(rules, q) - distances(rules, middle))
            assert (change <= largest + 1e-6).all()
            known = largest > 1e-3
            tightest = max(tightest, (change[known] / largest[known]).max(initial=0.0))
    assert tightest > 0.5  # a bound, and not a far one


def distances(rules, q):
    """Distance of every pair whose members are bodies; of a half-space that of its plane."""
    frames = rules.kinematics.poses(q, DOWN).frames[0]
    found = []
    for pair in rules.pairs:
        T = frames[pair.body.carrier] @ pair.body.solid.placement
        if isinstance(pair.other, Body):
            shape, U = coal_shape(pair.other.solid), frames[pair.other.carrier]
            U = U @ pair.other.solid.placement
        else:
            offset = float(pair.other.normal @ pair.other.point)
            shape, U = coal.Halfspace(pair.other.normal, offset), np.eye(4)
        value = coal.distance(
            coal_shape(pair.body.solid), coal.Transform3s(T[:3, :3].copy(), T[:3, 3].copy()),
            shape, coal.Transform3s(U[:3, :3].copy(), U[:3, 3].copy()),
            coal.DistanceRequest(), coal.DistanceResult(),
        )  # fmt: skip
        found.append(max(value, 0.0))
    return np.array(found)


@pytest.mark.parametrize("loaded", [pytest.param(False, marks=pytest.mark.long), True])
def test_free_moves_are_free_wherever_one_looks(loaded):
    rules = Feasibility(kr270_cell(), KR270_CHAIN)
    force = DOWN if loaded else NOTHING
    q = kr270_poses(250)
    q = q[rules.under(q, force[None]).ok]
    # Short and long moves: to the next pose, and a tenth of the way to it.
    start, end = q[:-1], q[1:]
    start, end = np.vstack([start, start]), np.vstack([end, start + 0.1 * (end - start)])
    free = rules.paths_free(start, end, loaded)
    collisions = Collisions(rules.kinematics, rules.pairs)
    for a, b, said in zip(start, end, free, strict=True):
        poses = rules.kinematics.poses(dense(rules, a, b), force)
        # Refused ones do come nearer than the margin and the resolution.
        assert collisions.hits(poses, 0.0 if said else 5e-4).any() == (not said)
    assert 10 < free.sum() < len(free) - 10


@settings(deadline=None, max_examples=30)
@given(st.floats(-2.5, 2.5), st.floats(1e-4, 0.1))
def test_nothing_is_too_thin_to_be_met(x, thickness):
    """A sheet across the way of a slide, wherever it stands and however thin it is."""
    sheet = box("sheet", (thickness, 2, 2), (x, 0, 0))
    rules = gantry_rules(replace(BALL, obstacles=(sheet,), clearance=0.0))
    start, end = gantry_at((-2.9, 0, 0), (2.9, 0, 0))
    assert not rules.paths_free(start, end, False)
    above = gantry_at((-2.9, 0, 1.2), (2.9, 0, 1.2))
    assert rules.paths_free(*above, False)


def test_the_bodies_in_the_way_are_named():
    rules = Feasibility(kr270_cell(), KR270_CHAIN)
    q, turn = np.radians([-24.0, -20, 60, 0, 0, 0]), np.array([1.2, 0, 0, 0, 0, 0])
    met = rules.blockers(q - turn, q + turn, False)
    assert any("table" in pair for pair in met), met
    assert not any("load" in pair for pair in met)
