"""Methods, noise models and intervals by name: each does what its name says, on one arm."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.calibration import (
    PLACED,
    cell_of,
    measured,
    planar_chain,
    table_at,
    true_values,
)
from support.cells import random_poses

from elastocal.cell.arm_description import CartesianNoise, Tracker
from elastocal.identification import published
from elastocal.identification.identify import identify
from elastocal.identification.options import METHODS, ROBUST, Options
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.simulation import simulate

SIGMA = 5e-5
MARKERS = {"M1": np.array([0.1, 0, 0]), "M2": np.array([0, 0.1, 0.1])}
REPEATS = 4


@cache
def campaign(seed=0, effect=0.0, poses=14, stated=True):
    """Two markers, four repeats, and an error common to the readings of a configuration."""
    noise = CartesianNoise(np.full(3, SIGMA)) if stated else None
    tracker = Tracker(position=np.array([3.0, 1.0, 0.5]), noise=noise)
    model = Model.assembled(planar_chain(), cell_of(PLACED, MARKERS, tracker))
    rng = np.random.default_rng(seed)
    truth = true_values(model, rng)
    once = table_at(random_poses(model.chain, poses, seed), markers=("M1", "M2"))
    n = len(once)
    plan = once.take(np.repeat(np.arange(n), REPEATS))
    plan = replace(plan, row=np.arange(n * REPEATS) + 2, repeat=np.tile(np.arange(REPEATS), n))
    table = measured(model, plan, truth, SIGMA, rng)
    common = effect * rng.normal(size=(poses, 3))
    return model, replace(table, position=table.position + common[table.configuration]), truth


def with_errors(table, share, seed=0):
    """A share of the readings off by 1 to 10 mm in any direction."""
    rng = np.random.default_rng(seed)
    bad = rng.permutation(len(table))[: round(share * len(table))]
    off = rng.normal(size=(len(bad), 3))
    off *= (rng.uniform(1e-3, 1e-2, len(bad)) / np.linalg.norm(off, axis=1))[:, None]
    position = table.position.copy()
    position[bad] += off
    return replace(table, position=position)


def z(result, truth):
    kept = [result.model.names.index(name) for name in result.determined]
    return (result.x[kept] - truth[kept]) / np.sqrt(np.diag(result.covariance))


# --- methods --------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_every_method_finds_the_truth_and_says_its_name(method):
    model, table, truth = campaign()
    result = identify(model, table, Options(method=method))
    assert result.method == ("reml" if method == "auto" else method)
    assert result.converged and len(result.determined) == len(truth)
    error = np.abs(z(result, truth))
    if method == "eq14-residual":  # its stated intervals are known to be far too narrow
        assert error.max() > 5
    else:  # seven parameters beyond 4.5 of t on 80 or more: less than one draw in ten thousand
        assert error.max() < 4.5
    exact = model.predict(table, truth)
    assert np.sqrt(np.mean((model.predict(table, result.x) - exact) ** 2)) < SIGMA


def test_the_published_methods_are_those_of_the_paper():
    """On the linearised model at the result, a step of the published estimator moves nothing."""
    model, table, _ = campaign()
    observed = observe(table, "position")
    group = (observed.configuration[:, None] * 3 + np.arange(3)).ravel()
    for method in ("ols", "eq14"):
        result = identify(model, table, Options(method=method))
        columns = np.array([model.names.index(n) for n in result.determined])
        B = model.regressor(table, result.x, columns, observed).B
        history = published.eq14(B, result.residual, group)
        found = history[0 if method == "ols" else -1]
        std = np.sqrt(np.diag(result.covariance))
        assert (np.abs(found.x) < 1e-3 * std).all()
        if method == "ols":
            stated = published.ols(B, result.residual).covariance  # eq. (7)
        else:
            stated = found.covariance  # eq. (13)
        np.testing.assert_allclose(np.sqrt(np.diag(stated)), std, rtol=1e-3)


@pytest.mark.parametrize("method", [*ROBUST, "reml"])
def test_gross_errors_do_not_bend_a_robust_fit(method):
    """The prediction stays within a tenth of the errors' size, within the noise but for the
    losses without rejection at 30 %."""
    model, table, truth = campaign(1)
    wrong = with_errors(table, 0.3)
    faulty = "drop" if method == "reml" else "auto"
    result = identify(model, wrong, Options(method=method, faulty=faulty))
    error = model.predict(table, result.x) - model.predict(table, truth)
    plain = identify(model, wrong, Options(method="ols"))
    bent = model.predict(table, plain.x) - model.predict(table, truth)
    limit = SIGMA / 2 if method == "reml" else 4 * SIGMA
    assert np.sqrt(np.mean(error**2)) < limit
    assert np.sqrt(np.mean(bent**2)) > 2 * np.sqrt(np.mean(error**2))


@pytest.mark.parametrize("stated", [True, False])
def test_computed_readings_give_the_true_values_and_no_noise(stated):
    """Without noise there is nothing to estimate it from, nor a reading beyond it."""
    model, table, truth = campaign(stated=stated)
    exact = simulate(model, table, truth, 0, noise=False)
    result = identify(model, exact)
    assert not result.faulty
    assert result.faulty_report is None
    assert any("computed, not measured" in text for text in result.warnings)
    found = model.predict(exact, result.x)
    assert np.abs(found - observe(exact, model.observe).value).max() < 1e-9
