"""Collision: margins to the tenth of a millimetre, and the pairs that are looked at."""

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from planning.feasibility.small_cells import (
    KR270_CHAIN,
    NOTHING,
    at,
    box,
    broken,
    cell,
    gantry_at,
    gantry_rules,
    sphere,
)

from elastocal.cell import CarriedBody, HalfSpace, HangingLoad, Solid, Workspace
from elastocal.cell_tables import Tool
from elastocal.messages import InputError
from elastocal.planning.feasibility import POSE_SLACK, Feasibility

RADII = (0.28, 0.2, 0.18, 0.15, 0.15, 0.11)
SIZES = {"box": [0.4, 0.2, 0.6], "sphere": [0.3], "cylinder": [0.2, 0.6], "capsule": [0.2, 0.2]}
# How far each of these reaches along x, y, z from its centre.
REACH = {
    "box": (0.2, 0.1, 0.3), "sphere": (0.3, 0.3, 0.3),
    "cylinder": (0.2, 0.2, 0.3), "capsule": (0.2, 0.2, 0.3),
}  # fmt: skip


def solid(shape, name, centre=(0, 0, 0)):
    return Solid(name, shape, np.array(SIZES[shape]), at(*centre))


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize("other", SIZES)
@pytest.mark.parametrize("axis", range(3))
def test_an_obstacle_is_kept_away_from_by_exactly_the_clearance(shape, other, axis):
    clearance = 0.05
    rules = gantry_rules(
        Workspace(
            bodies=(CarriedBody(solid(shape, "tool")),),
            obstacles=(solid(other, "rock"),),
            clearance=clearance,
        )
    )
    touch = REACH[shape][axis] + REACH[other][axis] + clearance + POSE_SLACK
    positions = np.zeros((2, 3))
    positions[:, axis] = touch - 1e-5, touch + 1e-5
    found = broken(rules, gantry_at(*positions), NOTHING)
    assert found == [{"obstacle"}, set()]


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize("axis", range(3))
def test_a_half_space_is_kept_out_of_without_a_margin(shape, axis):
    normal = -np.eye(3)[axis]
    rules = gantry_rules(
        Workspace(
            bodies=(CarriedBody(solid(shape, "tool")),),
            keep_out=(HalfSpace("people", -1.5 * normal, normal),),
            clearance=0.2,
        )
    )
    touch = 1.5 - REACH[shape][axis] - POSE_SLACK
    positions = np.zeros((2, 3))
    positions[:, axis] = touch + 1e-5, touch - 1e-5
    assert broken(rules, gantry_at(*positions), NOTHING) == [{"keep_out"}, set()]


def test_the_arm_keeps_the_self_clearance_and_no_more():
    """A post on the base against the tool: a pair of the arm's own bodies."""
    own = (
        CarriedBody(sphere("tool", 0.1, (0, 0, 0))),
        CarriedBody(sphere("post", 0.2, (0, 0, 0)), "base"),
    )
    rules = gantry_rules(Workspace(bodies=own, clearance=0.5, self_clearance=0.03))
    q = gantry_at((0.33 + POSE_SLACK - 1e-5, 0, 0), (0.33 + POSE_SLACK + 1e-5, 0, 0))
    assert broken(rules, q, NOTHING) == [{"self_collision"}, set()]
    rules = gantry_rules(Workspace(bodies=own, self_collision=False))
    assert broken(rules, q * 0, NOTHING) == [set(), set()]


def kr270_cell(**changes):
    workspace = Workspace(
        link_radius=RADII,
        bodies=(CarriedBody(box("tool", (0.3, 0.3, 0.2), (0, 0, 0.1))),),
        obstacles=(box("table", (1, 1, 0.8), (1.8, 0.8, 0.4)), sphere("lamp", 0.3, (0.5, -1, 2.2))),
        load=HangingLoad(Solid("load", "cylinder", np.array([0.2, 0.4])), 0.5),
        clearance=0.04,
        self_clearance=0.02,
    )
    return cell(replace(workspace, **changes), Tool(np.array([0.2, 0, 0.25])))


def pair_names(given_cell, chain=KR270_CHAIN):
    return {frozenset(pair.names) for pair in Feasibility(given_cell, chain).pairs}


def test_neighbours_and_a_spherical_wrist_are_not_paired():
    """Joints 4, 5 and 6 of the KR 270 meet in one point: links 3 to 6 always touch."""
    found = pair_names(kr270_cell())
    chain = ["base", "link1", "link2", "link3", "link4", "link5", "link6"]
    own = {pair for pair in found if pair <= set(chain)}
    joined = {frozenset(p) for p in combinations(chain, 2)} - own
    neighbours = {frozenset(p) for p in pairwise(chain)}
    wrist = {frozenset(p) for p in combinations(chain[3:], 2)}
    # The shoulder's 0.35 m are shorter than the radii of base and link 2.
    assert joined == neighbours | wrist | {frozenset(("base", "link2"))}
    for link in chain[1:]:
        assert {frozenset((link, "table")), frozenset((link, "lamp"))} <= found
    assert frozenset(("base", "table")) not in found
    assert frozenset(("tool", "link6")) not in found and frozenset(("tool", "link5")) in found


def test_ignored_pairs_may_touch_and_unknown_ones_are_named():
    ignored = kr270_cell(ignored_pairs=(("table", "link3"), ("tool", "base")))
    assert pair_names(kr270_cell()) - pair_names(ignored) == {
        frozenset(("table", "link3")), frozenset(("tool", "base"))
    }  # fmt: skip
    with pytest.raises(InputError, match=r"names 'tabel'.*did you mean 'table'"):
        Feasibility(kr270_cell(ignored_pairs=(("tabel", "link3"),)), KR270_CHAIN)
