"""Robust fits of the arm itself: settled, unmoved by blunders, with intervals that hold."""

from dataclasses import replace

import numpy as np
import pytest
from support.calibration import PLACED, cell_of, measured, planar_chain, table_at, true_values
from support.cells import random_poses

from elastocal.errors import InputError
from elastocal.identification.least_squares import FitProblem, fit
from elastocal.identification.robust import asymptotic_covariance, clustered_covariance, robust_fit
from elastocal.identification.weighted_problem import weights_for
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe

SIGMA = 5e-5
NAMES = ("huber", "tukey", "l1", "student-t")


def arm_problem(seed, share=0.0, sigma=SIGMA, poses=40):
    """Base and marker of an arm, from a start that is 5 mm or mrad off in every parameter."""
    model = Model.assembled(planar_chain(), cell_of(PLACED))
    rng = np.random.default_rng(seed)
    truth = true_values(model, rng)
    plan = table_at(random_poses(model.chain, poses, seed))
    table = measured(model, plan, truth, sigma, rng)
    bad = rng.permutation(poses)[: round(share * poses)]
    position = table.position.copy()
    position[bad] += rng.choice([-1.0, 1.0], (len(bad), 3)) * rng.uniform(1e-3, 1e-2, (len(bad), 3))
    observed = observe(replace(table, position=position), model.observe)
    columns = np.arange(len(truth))
    start = truth + 5e-3 * rng.choice([-1.0, 1.0], len(truth))
    weights = weights_for(observed, model.cell.tracker, "none")
    problem = FitProblem(model, observed, weights, start, columns, np.full(len(truth), 1e-2))
    # Base and marker share a direction with the first joint: those are held at the truth.
    B = model.regressor(observed.table, truth, columns, observed).B
    _, sizes, directions = np.linalg.svd(B, full_matrices=False)
    if sizes[-1] < 1e-9 * sizes[0]:
        held = int(np.argmax(np.abs(directions[-1])))
        columns = np.delete(columns, held)
        start[held] = truth[held]
        problem = replace(problem, columns=columns, x=start)
    return problem, truth, bad


@pytest.mark.parametrize("name", NAMES)
def test_settles_where_the_estimating_equation_holds(name):
    problem, _, _ = arm_problem(1, 0.1)
    found = robust_fit(problem, name)
    assert found.converged and found.steps < 15
    design = found.linear.design
    step = design.Q.T @ (design.y - found.linear.residual)
    assert np.abs(step / found.linear.scale).max() < 1e-5
    observed = problem.observations
    residual = observed.value - problem.model.predict(observed.table, found.x, observed)
    np.testing.assert_allclose(found.residual, residual, atol=1e-14)
    assert found.linear.weights.shape == (40,)


@pytest.mark.parametrize("name", NAMES)
def test_blunders_hardly_move_it(name):
    """10 % by 1 to 10 mm at 50 µm: within 6 clean standard deviations; least squares is far."""
    problem, truth, _ = arm_problem(2, 0.1)
    found = robust_fit(problem, name)
    at = problem.model.regressor(
        problem.observations.table, truth, problem.columns, problem.observations
    )
    std = SIGMA * np.sqrt(np.diag(np.linalg.inv(at.B.T @ at.B)))
    assert (np.abs(found.x - truth)[problem.columns] < 6 * std).all()
    assert (np.abs(fit(problem).x - truth)[problem.columns] > 6 * std).any()


@pytest.mark.parametrize("seed", range(3))
def test_tukey_withstands_thirty_per_cent(seed):
    problem, truth, bad = arm_problem(seed, 0.3)
    found = robust_fit(problem)
    std = asymptotic_covariance(found.linear).std
    assert (np.abs(found.x - truth)[problem.columns] < 6 * std).all()
    assert (found.linear.weights[bad] < 1e-3).all()


def test_without_blunders_it_is_near_least_squares():
    """The robust and the clean fit differ by about √(1/0.95 − 1) = 0.23 standard deviations."""
    problem, _, _ = arm_problem(3)
    robust, clean = robust_fit(problem, "huber"), fit(problem)
    std = asymptotic_covariance(robust.linear).std
    assert (np.abs(robust.x - clean.x)[problem.columns] < 4 * 0.23 * std).all()
    assert robust.linear.scale == pytest.approx(SIGMA, rel=0.4)


def test_exact_readings_give_the_truth():
    problem, truth, _ = arm_problem(4, 0.2, sigma=0.0)
    np.testing.assert_allclose(robust_fit(problem).x, truth, atol=1e-9)


def test_covariances_are_of_the_fitted_columns():
    problem, _, _ = arm_problem(5)
    found = robust_fit(problem)
    k = len(problem.columns)
    assert asymptotic_covariance(found.linear).matrix.shape == (k, k)
    clustered = clustered_covariance(found.linear, np.arange(40) % 20)
    assert clustered.matrix.shape == (k, k) and (clustered.dof < 20).all()


def test_what_it_cannot_fit_is_refused():
    problem, _, _ = arm_problem(6)
    with pytest.raises(InputError, match="neither ties nor bounds"):
        robust_fit(replace(problem, bounded=True))
    with pytest.raises(InputError, match="neither ties nor bounds"):
        robust_fit(replace(problem, tie=np.ones(len(problem.columns))))
