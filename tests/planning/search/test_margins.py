"""Smooth margins say what the cell's own rules say, and where they differ err on the safe side."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from elastocal.cell.arm_description import Tracker
from elastocal.cell.workspace_rules import (
    CarriedBody,
    HalfSpace,
    HangingLoad,
    Solid,
    Visibility,
    Workspace,
)
from elastocal.planning import margins, sobol
from elastocal.units import Array

Build = Callable[..., Any]
DOWN = np.array([0.0, 0.0, -200.0])
TABLE = np.eye(4)
TABLE[:3, 3] = [0.9, 0.3, 0.1]
LAMP, PIPE = np.eye(4), np.eye(4)
LAMP[:3, 3] = [0.5, -0.6, 1.3]
PIPE[:3, 3] = [-0.7, 0.2, 0.6]


def judged(arm: Any, force: Array) -> tuple[Array, Array]:
    """Smooth margins (N, m) of poses, and whether the cell allows them."""
    q = next(sobol(arm.space, 0, np.random.SeedSequence(5)))
    model = arm.model
    f = margins(model.cell, model.chain, arm.rules.pairs, force[None])
    assert f is not None
    return f.map(len(q))(q.T).full().T, arm.rules.check(q, force).ok


@pytest.mark.parametrize("force", [DOWN, 0 * DOWN], ids=["loaded", "unloaded"])
def test_bodies_that_keep_their_margins_do_not_collide(case: Build, force: Array) -> None:
    hook = np.eye(4)
    hook[:3, 3] = [0.05, 0.0, 0.1]
    workspace = Workspace(
        obstacles=(
            Solid("table", "box", np.array([0.4, 0.6, 0.2]), TABLE),
            Solid("lamp", "sphere", np.array([0.2]), LAMP),
            Solid("pipe", "cylinder", np.array([0.08, 1.2]), PIPE),
        ),
        bodies=(CarriedBody(Solid("gripper", "box", np.array([0.1, 0.1, 0.15]), hook)),),
        keep_out=(HalfSpace("floor", np.zeros(3), np.array([0.0, 0.0, 1.0])),),
        load=HangingLoad(Solid("weight", "cylinder", np.array([0.06, 0.2])), 0.2, min_height=0.1),
        link_radius=(0.05,) * 4,
        clearance=0.02,
        self_clearance=0.01,
    )
    found, ok = judged(case(workspace), force)
    kept = (found >= 0).all(axis=1)
    assert (ok | ~kept).all()
    # And not so cautious that nothing is left.
    assert kept.sum() > 0.6 * ok.sum() > 30
    assert np.isfinite(found).all()


def test_bounds_on_the_pose_are_the_rules_themselves(case: Build) -> None:
    workspace = Workspace(
        load=HangingLoad(
            Solid("weight", "sphere", np.array([0.05])),
            rope_axis=np.array([1.0, 0.0, -1.0]),
            max_angle=1.0,
        ),
        visibility=Visibility(
            normals={"M1": np.array([0.0, 2.0, 1.0])},
            max_incidence=1.1,
            range=(1.2, 2.6),
            line_of_sight=False,
        ),
        torque_limits=(50.0, 180.0, 120.0, 60.0),
        self_collision=False,
        mounting_plane=False,
    )
    tracker = Tracker(position=np.array([0.5, 2.0, 0.6]))
    arm = case(workspace, tracker=tracker, observe="position")
    force = np.array([30.0, 0.0, -150.0])
    found, ok = judged(arm, force)
    assert found.shape[1] == 1 + 3 + 4
    np.testing.assert_array_equal((found >= 0).all(axis=1), ok)
    assert 20 < ok.sum() < len(ok) - 20
    # Each rule alone decides some pose.
    broken = found < 0
    assert all((broken[:, k] & (broken.sum(axis=1) == 1)).any() for k in (0, 1, 2, 3))


def test_margins_have_slopes(case: Build) -> None:
    arm = case(
        Workspace(
            obstacles=(Solid("table", "box", np.array([0.4, 0.6, 0.2]), TABLE),),
            link_radius=(0.05,) * 4,
        )
    )
    f = margins(arm.model.cell, arm.model.chain, arm.rules.pairs, DOWN[None])
    assert f is not None
    slope = f.factory("slope", ["i0"], ["jac:o0:i0"])
    q = next(sobol(arm.space, 0, np.random.SeedSequence(6)))[:20]
    h = 1e-6
    for pose in q:
        numeric = [
            (f(pose + step) - f(pose - step)).full()[:, 0] / (2 * h) for step in h * np.eye(4)
        ]
        exact = slope(pose).full()
        close = np.isclose(exact, np.array(numeric).T, atol=1e-4)
        assert close.mean() > 0.9
