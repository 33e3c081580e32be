"""From a cell to a plan: what is asked for is what comes, feasible, and worth what it says."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from planning.order.test_schedule import driven
from support.calibration import placement
from support.cells import DOWN, kr270_chain
from support.design_cells import any_cell, plan_cell, scara, value_of

from elastocal.cell import CarriedBody, Cell, HalfSpace, HangingLoad, Solid, Workspace
from elastocal.cell_tables import Motion
from elastocal.model.chain import Chain, joint_limits
from elastocal.planning import design as design_module
from elastocal.planning.design import DesignOptions, design
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.plan import Plan
from elastocal.planning.setup import Setup, set_up

BOTH = np.array([[0.0, 0, 0], DOWN])
LIGHT = np.array([[0.0, 0, 0], [0.0, 0, -60.0]])
GEOMETRY = ("base_frame", "joint_offset", "link_geometry", "marker_position")
FEW = ("base_frame", "joint_offset", "joint_compliance", "marker_position")


def at(x: float, y: float, z: float) -> NDArray:
    return placement([x, y, z])


def work_cell(**design_: Any) -> Cell:
    """The KR 270-2 between a pillar and a table, a weight hanging from it by a rope."""
    workspace = Workspace(
        obstacles=(
            Solid("pillar", "cylinder", np.array([0.2, 3.0]), at(1.6, 1.3, 1.5)),
            Solid("table", "box", np.array([1.0, 1.0, 0.8]), at(-1.2, 1.6, 0.4)),
        ),
        bodies=(CarriedBody(Solid("tool", "box", np.array([0.2, 0.2, 0.25]), at(0, 0, 0.125))),),
        keep_out=(HalfSpace("floor", np.zeros(3), np.array([0.0, 0, 1])),),
        load=HangingLoad(Solid("weight", "sphere", np.array([0.2])), rope=0.3, min_height=0.1),
        link_radius=(0.25, 0.2, 0.2, 0.15, 0.12, 0.1),
        clearance=0.02,
    )
    return replace(plan_cell(**design_), workspace=workspace)


HOME = np.radians([0.0, -90, 90, 0, 45, 0])
ARMS: dict[str, tuple[Chain, Cell]] = {
    "work cell": (
        kr270_chain(),
        work_cell(
            loads=DOWN[None], candidates=60, levels={"joint2": (-0.5, -1.2, -2.0)},
            per_level=(1, 2, 1),
            motion=Motion(home=HOME, speed=np.radians([60.0] * 6), both_directions=True,
                          overshoot=0.05),
        ),
    ),
    "scara, E": (
        scara(), any_cell(scara(), FEW, loads=LIGHT, poses=9, candidates=100, criterion="E")
    ),
}  # fmt: skip


def planned(name: str) -> tuple[Plan, Setup, Feasibility]:
    """The plan of a cell, what was known before it was chosen, and the cell's rules."""
    observed: list[Setup] = []

    def watched(*args: Any) -> Setup:
        observed.append(set_up(*args))
        return observed[-1]

    chain, cell = ARMS[name]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(design_module, "set_up", watched)
        patch.setattr("elastocal.model.manipulator.load_chain", lambda cell: chain)
        plan = design(cell, DesignOptions("quick"))
    setup, e = observed[0], plan.everywhere
    if e is not None and e.share:
        setup = replace(setup, share=e.share)
    return plan, setup, Feasibility(plan.model.cell, plan.model.chain)


def every_pose_is_allowed_in_every_state(plan: Plan, _: Setup, rules: Feasibility) -> None:
    assert list(np.bincount(plan.group)) == list(plan.model.cell.design.per_level or [9])
    lower, upper = joint_limits(plan.model.cell, plan.model.chain)
    assert ((lower - 1e-12 <= plan.q) & (plan.q <= upper + 1e-12)).all()
    for k in range(len(plan.q)):
        for force in plan.forces:
            verdict = rules.check(plan.q[k], force)
            assert verdict.ok.all(), verdict.counts


def every_reading_has_a_stop_and_every_move_is_free(
    plan: Plan, _: Setup, rules: Feasibility
) -> None:
    execution, motion = plan.execution, plan.model.cell.design.motion
    moves = driven(execution, plan.q, plan.forces)
    start, end, hanging = (np.array(v) for v in zip(*moves, strict=True))
    assert rules.paths_free(start, end, hanging).all()
    visits = {(s.pose, s.load) for s in execution.stops}
    assert visits == {(k, s) for k in range(len(plan)) for s in range(len(plan.forces))}
    assert len({(s.pose, s.load, s.side, s.part) for s in execution.stops}) == len(execution.stops)
    most = 2 if motion.both_directions else 1
    times = Counter((s.pose, s.load, s.part) for s in execution.stops)
    assert set(times.values()) <= {1, most}
    assert {pose for (pose, *_), n in times.items() if n < most} == set(execution.one_sided)


def the_value_is_that_of_the_poses_and_no_less_than_its_bound(
    plan: Plan, setup: Setup, _: Feasibility
) -> None:
    value = value_of(setup, plan.q)
    assert plan.value == pytest.approx(value, rel=1e-9)
    assert plan.reported == setup.criterion.figure(plan.value)
    c = plan.certificate
    assert c.bound_pool is not None and c.efficiency_pool is not None
    assert 0 < c.bound_pool <= value * (1 + 1e-9)
    assert 0 < c.efficiency_pool <= 1
    assert c.efficiency_pool == pytest.approx(min(c.bound_pool / value, 1.0), rel=1e-9)
    assert 0 < c.efficiency_continuum <= c.efficiency_pool * (1 + 1e-9)
    assert plan.bound_reported == setup.criterion.figure(c.bound_pool)
    assert c.pool >= plan.model.cell.design.candidates  # with what polish found


def what_is_predicted_is_the_inverse_of_the_information(
    plan: Plan, setup: Setup, _: Feasibility
) -> None:
    M = setup.gathered(setup.information.blocks(plan.q))
    scale = np.sqrt(np.diag(M))
    V = np.linalg.inv(M / np.outer(scale, scale)) / np.outer(scale, scale)
    assert tuple(p.name for p in plan.predicted) == setup.information.names
    std = np.sqrt(np.diag(V)) * setup.information.sizes
    assert np.allclose([p.std for p in plan.predicted], std, rtol=1e-5)
    assert all(r.loss >= 1 - 1e-9 for r in plan.reasons)
    for k, (q, reason) in enumerate(zip(plan.q, plan.reasons, strict=True)):
        loss = value_of(setup, np.delete(plan.q, k, axis=0)) / plan.value
        assert reason.loss == pytest.approx(loss, rel=1e-6)
        B = setup.information.blocks(q[None])[0]
        less = np.linalg.inv((M - B.T @ B) / np.outer(scale, scale)) / np.outer(scale, scale)
        growth = dict(
            zip(setup.information.names, np.sqrt(np.diag(less) / np.diag(V)), strict=True)
        )
        for name, factor in reason.serves:
            assert factor == pytest.approx(growth[name], rel=1e-3) or np.isinf(factor)
        assert all(f >= 1.005 for _, f in reason.serves)


@pytest.mark.parametrize("name", ARMS)
def test_a_plan_is_allowed_free_and_worth_what_it_says(name: str, tmp_path: Path) -> None:
    found = planned(name)
    every_pose_is_allowed_in_every_state(*found)
    every_reading_has_a_stop_and_every_move_is_free(*found)
    the_value_is_that_of_the_poses_and_no_less_than_its_bound(*found)
    what_is_predicted_is_the_inverse_of_the_information(*found)
    plan = found[0]
    plan.save(tmp_path / "plan.csv")
    read, table = plan.model.read_plan(tmp_path / "plan.csv"), plan.table()
    assert np.allclose(read.q, table.q, rtol=0, atol=1e-9)
    for column in ("force", "approach", "configuration_labels"):
        assert np.array_equal(getattr(read, column), getattr(table, column)), column
    assert (read.approach is not None) == plan.model.cell.design.motion.both_directions
