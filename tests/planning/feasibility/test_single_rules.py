"""Each rule by cases whose answer is known; together they do not depend on their order."""

import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from planning.feasibility.small_cells import (
    DOWN,
    KR270_CHAIN,
    NOTHING,
    box,
    breaking,
    broken,
    cell,
    freed_by,
    gantry_at,
    gantry_rules,
    kr270_poses,
    random_chain,
    sphere,
)
from planning.feasibility.test_margins_of_pairs import kr270_cell
from support.design_cells import plan_cell

from elastocal.cell import HalfSpace, HangingLoad, Visibility, Workspace
from elastocal.cell_tables import EffectChoice, Tool, Tracker
from elastocal.messages import InputError
from elastocal.planning.collision import Kinematics
from elastocal.planning.feasibility import Feasibility, static_torque

EYE = Tracker(position=np.array([3.0, 0.0, 0.0]))
MARKER = Tool(markers={"M1": np.zeros(3)})


def test_incidence_is_the_angle_between_the_reflectors_axis_and_the_beam():
    sight = Visibility({"M1": np.array([2.0, 0, 0])}, np.radians(30), line_of_sight=False)
    rules = gantry_rules(Workspace(visibility=sight), MARKER, EYE)
    q = gantry_at(*[(0, 0, 0)] * 6, (0, 3 * np.tan(np.radians(29)), 0), (0, 0, 3.0))
    q[:6, 3] = np.radians([0, 29.99, -29.99, 30.01, -30.01, 180])
    assert [bool(b) for b in broken(rules, q, NOTHING)] == [
        False, False, False, True, True, True, False, True,
    ]  # fmt: skip


def test_a_beam_passes_at_its_radius():
    """A ball of 0.2 m half way: the beam of 5 mm misses it at 0.205 m from its centre."""
    sight = Visibility(beam_radius=0.005)
    ball = sphere("ball", 0.2, (1.5, 0, 0))
    rules = gantry_rules(Workspace(obstacles=(ball,), visibility=sight), MARKER, EYE)
    # Half way from (3, 0, 0) to (0, y, 0) the beam is y/2 off the centre, foreshortened.
    y = np.array([0.2049, 0.2051]) * 2
    y /= np.sqrt(1 - (y / 3) ** 2)
    assert broken(rules, gantry_at((0, y[0], 0), (0, y[1], 0)), NOTHING) == [
        {"line_of_sight"}, set()
    ]  # fmt: skip


@pytest.mark.parametrize("x", [-2.9, 0.1, 2.4])
def test_the_beam_reaches_from_the_tracker_to_the_marker_and_no_further(x):
    """Whatever its length: walls behind tracker and marker do not hide, one between does."""
    sight = Visibility(beam_radius=0.005)
    for wall, hides in ((3.2, False), (x - 0.2, False), (2.9, True), (x + 0.1, True)):
        screen = box("wall", (0.02, 1, 1), (wall, 0, 0))
        rules = gantry_rules(Workspace(obstacles=(screen,), visibility=sight), MARKER, EYE)
        assert broken(rules, gantry_at((x, 0, 0)), NOTHING) == [
            {"line_of_sight"} if hides else set()
        ]


def test_the_rope_may_deviate_from_the_vertical_by_its_angle():
    """The KR 270 stretched out, its flange's z along +x turned by joint 5 downwards."""
    axis = np.array([0.0, 0.0, 3.0])
    load = HangingLoad(
        sphere("load", 0.1, (0, 0, 0)), 0.5, rope_axis=axis, max_angle=np.radians(40)
    )
    rules = Feasibility(cell(Workspace(load=load)), KR270_CHAIN)
    q = np.zeros((4, 6))
    q[:, 4] = np.radians([49.9, 50.1, 90, 125])
    assert broken(rules, q, DOWN) == [{"rope_angle"}, set(), set(), set()]
    assert broken(rules, q, NOTHING) == [set()] * 4


@pytest.mark.parametrize("seed", range(2))
def test_static_torque_is_pinocchios_gravity_and_the_transposed_jacobian(seed, tmp_path):
    chain = random_chain(seed, tmp_path)
    tool = Tool(np.array([0.2, 0.1, 0.3]))
    weighing = cell(Workspace(), tool)
    weighing = replace(weighing, model=replace(weighing.model, link_gravity=bool(chain.masses)))
    rng = np.random.default_rng(seed)
    q, force = rng.uniform(-2, 2, (20, chain.n_joints)), rng.normal(size=(20, 3)) * 500
    found = static_torque(weighing, chain)(Kinematics(weighing, chain).poses(q, force))
    assert np.allclose(found, reference_torque(chain, tool.load_point, q, force), atol=1e-8)
    assert np.abs(found).max() > 10


def reference_torque(chain, load_point, q, force):
    model, parent = pin.Model(), 0
    for i, joint in enumerate(chain.joints):
        kind = (
            pin.JointModelRevoluteUnaligned
            if joint.kind == "revolute"
            else pin.JointModelPrismaticUnaligned
        )
        parent = model.addJoint(parent, kind(joint.axis), pin.SE3(joint.placement), f"j{i}")
        if chain.masses:
            mass = chain.masses[i]
            inertia = pin.Inertia(mass.mass, mass.com, np.zeros((3, 3)))
            model.appendBodyToJoint(parent, inertia, pin.SE3.Identity())
    model.gravity.linear = np.array([0, 0, -9.80665])
    data, torque = model.createData(), []
    hook = pin.SE3(np.eye(3), (chain.flange_placement @ [*load_point, 1.0])[:3])
    frame = model.addFrame(pin.Frame("hook", parent, 0, hook, pin.FrameType.OP_FRAME))
    data = model.createData()
    for qi, f in zip(q, force, strict=True):
        gravity = pin.computeGeneralizedGravity(model, data, qi)
        J = pin.computeFrameJacobian(model, data, qi, frame, pin.LOCAL_WORLD_ALIGNED)[:3]
        torque.append(gravity - J.T @ f)
    return np.array(torque)


def test_torque_limits_hold_in_both_directions_and_the_compensator_counts():
    """A KR 270 stretched out by 2.68 m: a weight of 1000 N asks joint 2 for 2330 N m."""
    tool = Tool(np.zeros(3))
    limits = Workspace(torque_limits=(1e5, 2331.0, 1e5, 1e5, 1e5, 1e5))
    rules = Feasibility(cell(limits, tool), KR270_CHAIN)
    q = np.zeros((1, 6))
    lever = 1.25 + 1.1 + 0.23
    assert broken(rules, q, np.array([0, 0, -2330.0 / lever])) == [set()]
    assert broken(rules, q, np.array([0, 0, -2332.0 / lever])) == [{"torque"}]
    assert broken(rules, q, np.array([0, 0, 2332.0 / lever])) == [{"torque"}]
    spring = {
        "joint": "joint2", "stiffness_N_per_m": 1e5, "anchor_m": (0.0, 0.7), "arm_m": 0.2,
        "free_length_m": 0.3,
    }  # fmt: skip
    plain = cell(limits, tool)
    nominal = replace(plain.model.nominal, gravity_compensator=spring)
    helped = replace(plain.model, effects=(EffectChoice("gravity_compensator"),), nominal=nominal)
    torque = static_torque(replace(plain, model=helped), KR270_CHAIN)
    kinematics = Kinematics(plain, KR270_CHAIN)
    force = np.array([0, 0, -1000.0])
    unhelped = static_torque(plain, KR270_CHAIN)(kinematics.poses(q, force))[0, 1]
    s = np.hypot(0.7, 0.2)  # at q₂ = 0 the arm is square to the line of the anchors
    moment = 1e5 * (1 - 0.3 / s) * 0.7 * 0.2
    assert torque(kinematics.poses(q, force))[0, 1] - unhelped == pytest.approx(moment)


def full_cell():
    given = kr270_cell(
        keep_out=(HalfSpace("walkway", np.array([-1.5, 0, 0]), np.array([1.0, 0, 0])),),
        visibility=Visibility({"M1": np.array([0, 0, 1.0])}, 1.4, (1.0, 5.0)),
        torque_limits=(1e4, 5e3, 4e3, 1e3, 1e3, 1e3),
    )
    load = replace(
        given.workspace.load, rope_axis=np.array([0, 0, 1.0]), max_angle=1.8, min_height=0.1
    )
    return replace(
        given,
        workspace=replace(given.workspace, load=load),
        tool=replace(given.tool, markers={"M1": np.array([0.2, 0.1, 0.2])}),
        tracker=Tracker(position=np.array([3.5, 0.5, 1.5])),
        limits={"joint1": (-2.0, 2.0)},
    )


def test_the_order_of_rules_changes_who_removes_but_not_what_remains():
    rules = Feasibility(full_cell(), KR270_CHAIN)
    q = kr270_poses(4000)
    verdict = rules.check(q, DOWN)
    assert verdict.ok.any() and all(breaking(verdict).values())
    shuffled = Feasibility(full_cell(), KR270_CHAIN)
    for order in np.random.default_rng(0).permuted([range(len(rules.rules))] * 5, axis=1):
        shuffled.rules = tuple(rules.rules[k] for k in order)
        other = shuffled.check(q, DOWN)
        assert (other.ok == verdict.ok).all() and breaking(other) == breaking(verdict)
        assert (shuffled.under(q, DOWN[None]).ok == verdict.ok).all()


@pytest.mark.parametrize(
    ("workspace", "message"),
    [
        (Workspace(torque_limits=(1.0, 2.0)), "torque_limits_Nm has 2 values.*6 joints"),
        (Workspace(visibility=Visibility()), "needs the markers"),
    ],
)
def test_workspaces_that_do_not_fit_are_refused(workspace, message):
    with pytest.raises(InputError, match=message):
        Feasibility(cell(workspace), KR270_CHAIN)


# Advice


def advised(given, q, force=NOTHING):
    rules = Feasibility(given, KR270_CHAIN)
    verdict = rules.check(q, force)
    return rules, verdict, rules.advice(verdict)


def test_dropping_the_advised_rule_frees_as_many_as_it_says():
    q = kr270_poses(3000)
    rules, verdict, text = advised(full_cell(), q, DOWN)
    name, count = re.search(r"relax '(\w+)', which alone stops (\d+)", text).groups()
    assert int(count) == max(freed_by(verdict).values()) == freed_by(verdict)[name]
    rules.rules = tuple(rule for rule in rules.rules if rule.name != name)
    assert rules.check(q, DOWN).ok.sum() - verdict.ok.sum() == int(count)
    assert f"{verdict.ok.sum()} of 3000" in text


def test_an_obstacle_that_swallows_the_robot_is_named():
    swallowed = kr270_cell(
        obstacles=(box("pallet", (4, 4, 4), (0, 0, 1)), sphere("x", 0.1, (3, 0, 0)))
    )
    _, verdict, text = advised(swallowed, kr270_poses(500))
    assert not verdict.ok.any()
    assert "'obstacle'" in text and "link1 and pallet" in text
    assert '["link1", "pallet"]' in text and "[workspace] ignored_pairs" in text


# Where the cell states nothing around the arm, it stays above its mounting plane

CELL = plan_cell()
FLOOR = HalfSpace("floor", NOTHING, np.array([0.0, 0, 1]))


def heights(q: np.ndarray) -> np.ndarray:
    """z (N, points) of the joints from the second on, flange, load point and markers."""
    frames = Feasibility(CELL, KR270_CHAIN).kinematics.poses(q, NOTHING)
    tool = np.array([NOTHING, CELL.tool.load_point, *CELL.tool.markers.values()])
    joints = frames.frames[:, 1:6, 2, 3]
    flange = frames.flange[:, 2, :3] @ tool.T + frames.flange[:, 2, 3:]
    return np.hstack([joints, flange])


def test_what_reaches_below_it_is_left_out_and_nothing_else() -> None:
    rules = Feasibility(CELL, KR270_CHAIN)
    q = kr270_poses(3000)
    broken = rules.check(q, NOTHING)
    low = heights(q).min(axis=1)
    assert broken.counts.removed_by["mounting_plane"] == (~broken.ok).sum() > 100
    assert (low[broken.ok] > 0).all()
    assert (low[~broken.ok] < 0.002).all()


def test_moves_are_checked_against_it() -> None:
    """Joint 2 swings over the plane's edge between two poses above it."""
    rules = Feasibility(CELL, KR270_CHAIN)
    up, down = np.radians([[0.0, -90, 90, 0, 0, 0], [0.0, -90, -60, 0, 0, 0]])
    ends = np.array([up, down, np.radians([180.0, -90, 90, 0, 0, 0])])
    assert rules.check(ends[[0, 2]], NOTHING).ok.all()
    way = up + np.linspace(0, 1, 50)[:, None] * (np.radians([0.0, 0, 90, 0, 0, 0]) - up)
    assert rules.paths_free(up[None], way[-1:], False)[0] == (heights(way).min() >= 0)
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
    rules = Feasibility(replace(CELL, workspace=space), KR270_CHAIN)
    assert ("mounting_plane" in [rule.name for rule in rules.rules]) == stands
