"""Where the arm will be: covariance at any pose, error at new poses, what no pose shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.calibration import GEOMETRY, campaign, cell_of, measured, planar_chain, table_at
from support.cells import random_poses

from elastocal.cell_tables import CartesianNoise, Tracker
from elastocal.identification.identify import identify
from elastocal.identification.least_squares import rms_3d
from elastocal.identification.prediction import NewPoses
from elastocal.model.calibrated import CalibratedTool, tool_point
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe

SIGMA, POSES = 5e-5, 40
TRACKER = Tracker(noise=CartesianNoise(np.full(3, SIGMA)))


@pytest.fixture(scope="module")
def fits():
    campaigns = (campaign(GEOMETRY, POSES, seed, tracker=TRACKER) for seed in range(5))
    return [(identify(model, table), x) for model, table, x in campaigns]


def test_regions_hold_the_tool_as_often_as_they_say(fits):
    held = []
    for fit, x in fits:
        marker = next(iter(fit.model.cell.tool.markers))
        q = random_poses(fit.model.chain, 30, 99)
        at = fit.position(q, point=marker)
        tool = CalibratedTool(replace(fit.arm, x=x), tool_point(fit.model.cell, marker))
        held.append(at.holds(tool.poses(tool.rows(fit.model.table(q)), q)[0]).mean())
        assert (at.half_axes() >= at.half_axes(0.5)).all() and at.holds(at.position).all()
        twice = replace(at, visit=at.covariance)
        np.testing.assert_allclose(twice.half_axes(visit=True), np.sqrt(2) * at.half_axes())
        axes = at.half_axes()
        for size, inside in (1.4 * axes[:, 2:], True), (1.5 * axes[:, :1], False):
            assert (twice.holds(at.position + size * [1, 0, 0], visit=True) == inside).all()
    assert 0.85 < np.mean(held) <= 1.0


def error_of(fit, model, x):
    """Of the fit at poses that nobody measured, where the arm is `model` at x."""
    new = table_at(random_poses(model.chain, 300, 7), [[0, 0, 0]])
    exact = measured(model, new, x, 0.0, np.random.default_rng(0))
    o = observe(exact, "position")
    return rms_3d(fit.model.predict(exact, fit.x, o) - o.value, 3)


def test_predicted_error_is_that_at_new_poses(fits):
    """In the mean over campaigns, and inside its interval nearly always."""
    errors = np.array([error_of(fit, fit.model, x) for fit, x in fits])
    found = [fit.predicted for fit, _ in fits]
    assert all(f.ci95[0] < f.rms < f.ci95[1] for f in found)
    assert all(f.predicted.rms < f.heldout_rms for f, _ in fits)  # which has a reading's noise
    assert 0.3 < np.mean((errors / [f.rms for f in found]) ** 2) < 1.5
    assert sum(errors <= [f.ci95[1] for f in found]) >= 4


def test_what_a_model_lacks_is_what_poses_left_out_show_of_it():
    """Gears out of round: a fit follows them at its own poses."""
    held, effects = [], (*GEOMETRY, "gear_eccentricity")
    forces = [[0, 0, -k] for k in range(4)]  # readings of a configuration, and no repeats
    for seed in range(6):
        true, table, x = campaign(effects, 14, seed, forces=forces, tracker=TRACKER)
        rng, gears = np.random.default_rng(seed), [p.effect[:4] == "gear" for p in true.parameters]
        x[gears] = 3e-4 * rng.normal(size=sum(gears))
        model = Model.assembled(true.chain, cell_of(GEOMETRY, tracker=TRACKER))
        fit = identify(model, measured(true, table, x, SIGMA, rng))
        held.append(error_of(fit, true, x) <= fit.predicted.ci95[1])
    assert sum(held) >= 5


def test_springs_that_no_load_has_shown_count_where_the_arm_works_under_one():
    model, table, _ = campaign((*GEOMETRY, "joint_compliance"), POSES, 1, tracker=TRACKER)
    q, weight = random_poses(model.chain, 100, 5), np.full(100, 0.01)
    for load in 0.0, -100.0:
        poses = NewPoses(q, np.tile([0.0, 0.0, load], (100, 1)), weight, "here")
        fit = identify(model, table, new_poses=poses)
        not_shown = "new_poses_not_shown" in {f.kind for f in fit.findings}
        assert bool(load) == not_shown == bool(fit.arm.untried(poses.force)) != fit.verdict.trusted


@pytest.mark.parametrize("sideways", [0.0, 300.0])
def test_a_pose_that_alone_shows_a_parameter_counts_by_its_share_of_the_error(sideways):
    """Only one pose's load pulls aside, which shows joint 1; under a weight it does not matter."""
    springs = cell_of(("joint_compliance",), observe="deflection", tracker=TRACKER)
    model = Model.assembled(planar_chain(), springs)
    q = random_poses(model.chain, 30, 3)
    force = np.tile([[0.0, 0, 0], [0, 0, -300]], (30, 1, 1))
    force[-1, 1, 1] = 30.0
    x = np.full(len(model.names), 1e-5)
    table = measured(model, table_at(q, force), x, SIGMA, np.random.default_rng(1))
    where, load = random_poses(model.chain, 100, 5), np.tile([0.0, sideways, -300], (100, 1))
    poses = NewPoses(where, load, np.full(100, 0.01), "here")
    fit = identify(model, table, new_poses=poses)
    assert 0.5 * SIGMA < fit.heldout_rms < 3 * SIGMA and np.isinf(fit.held_out).sum() == 3
    assert (fit.finding("not_held_out").severity == "note") == fit.verdict.trusted == (not sideways)
    assert (fit.predicted.unchecked**2 > fit.predicted.rms**2 / 2) == bool(sideways)
