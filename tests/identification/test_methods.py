"""Methods by name, what configurations share, and faulty readings, on one arm with repeats."""

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
    z_scores,
)
from support.cells import random_poses

from elastocal.cell_tables import CartesianNoise, Tracker
from elastocal.diagnosis.diagnose import diagnose
from elastocal.identification import published
from elastocal.identification.identify import identify
from elastocal.identification.noise_summary import lack_of_fit
from elastocal.identification.start import METHODS, ROBUST, Options
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
    model = Model.assembled(planar_chain(), cell_of(PLACED, MARKERS, Tracker(noise=noise)))
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


@pytest.mark.parametrize("method", METHODS)
def test_every_method_finds_the_truth_and_says_its_name(method):
    model, table, truth = campaign()
    result = identify(model, table, Options(method=method))
    assert result.method == ("reml" if method == "auto" else method)
    assert result.converged and len(result.determined) == len(truth)
    error = np.abs(z_scores(result, truth))
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
    steps = {"ols": published.ols, "eq14": lambda *a: published.eq14(*a, group)[-1]}
    for method, step in steps.items():
        result = identify(model, table, Options(method=method))
        columns = np.array([model.names.index(n) for n in result.determined])
        found = step(model.regressor(table, result.x, columns, observed).B, result.residual)
        std = np.sqrt(np.diag(result.covariance))
        assert (np.abs(found.x) < 1e-3 * std).all()
        np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), std, rtol=1e-3)


@pytest.mark.parametrize("method", [*ROBUST, "reml"])
def test_gross_errors_do_not_bend_a_robust_fit(method):
    """At 30 % the prediction stays within the noise, within four times it without rejection."""
    model, table, truth = campaign(1)
    wrong = with_errors(table, 0.3)
    faulty = "drop" if method == "reml" else "auto"
    result = identify(model, wrong, Options(method=method, faulty=faulty))
    error = model.predict(table, result.x) - model.predict(table, truth)
    assert np.sqrt(np.mean(error**2)) < (SIGMA / 2 if method == "reml" else 4 * SIGMA)


@pytest.mark.parametrize("stated", [True, False])
def test_computed_readings_give_the_true_values_and_no_noise(stated):
    """Without noise there is nothing to estimate it from, nor a reading beyond it."""
    model, table, truth = campaign(stated=stated)
    exact = simulate(model, table, truth, 0, noise=False)
    result = identify(model, exact)
    assert not result.faulty and result.faulty_report is None
    assert any("computed, not measured" in text for text in result.warnings)
    off = model.predict(exact, result.x) - observe(exact, model.observe).value
    assert np.abs(off).max() < 1e-9


SCATTER = "Configurations scatter more than their repeats"


def test_lack_of_fit_is_the_textbook_decomposition():
    """Against the sums written out for one mean fitted to groups of unequal size."""
    _, table, _ = campaign()
    table = table.take(np.arange(len(table)) % 7 != 3)
    e = np.random.default_rng(1).normal(size=(len(table), 3))
    e -= e.mean(axis=0)
    found = lack_of_fit(observe(table, "position"), e.ravel(), 3)
    key = table.configuration * 100 + table.marker
    groups = [e[key == k] for k in np.unique(key)]
    pure = sum(((g - g.mean(axis=0)) ** 2).sum() for g in groups)
    between = sum(len(g) * (g.mean(axis=0) ** 2).sum() for g in groups)
    dof_pure, dof_between = 3 * (len(e) - len(groups)), 3 * (len(groups) - 1)
    assert (found.dof_pure, found.dof_between) == (dof_pure, dof_between)
    np.testing.assert_allclose(found.F, between / dof_between / (pure / dof_pure), rtol=1e-12)


def test_a_configuration_effect_is_told_and_the_default_counts_with_it():
    """There the effect is in the noise model, so intervals are wider and nobody warns."""
    model, table, _ = campaign(3, effect=1e-4)
    plain, result = identify(model, table, Options(method="ols")), identify(model, table)
    # The effect's variance is 4 times a reading's; means of 4 readings carry it whole.
    assert plain.noise.lack_of_fit.p < 1e-6 and 5 < plain.noise.lack_of_fit.F < 50
    assert any(w.startswith(SCATTER) for w in plain.warnings)
    assert result.noise.kind.endswith("+configuration") and result.noise.lack_of_fit.p < 1e-6
    assert not any(w.startswith(SCATTER) for w in result.warnings)
    assert np.trace(result.covariance) > 2 * np.trace(plain.covariance)
    (common,) = (s for s in result.noise.sizes if s.name == "common to each configuration")
    assert 50e-6 < common.sigma < 200e-6  # 100 µm, from a handful of configurations


def shifted(table, rows, by):
    position = table.position.copy()
    position[rows] += by
    return replace(table, position=position)


def test_a_block_of_lines_is_one_finding():
    """Eight lines off by 3 mm, under noise of 50 µm and a shared deviation."""
    model, table, _ = campaign(1, effect=1e-4)
    order = np.argsort(table.configuration, kind="stable")
    table = replace(table.take(order), row=np.arange(len(table)) + 2)
    rows = np.arange(36, 44)
    result = identify(model, shifted(table, rows, [0.0, 3e-3, 0.0]), Options(noise="auto"))
    lines = sorted(line for f in result.faulty_report.findings for line in f.lines)
    assert lines == [int(r) + 2 for r in rows] == [o.line for o in result.excluded]
    largest = result.faulty_report.findings[0]
    assert largest.level in ("block", "configuration") and largest.pattern == "common"
    # 3 mm over 50 µm is 60; where deviations are shared, the best guess of this one is taken off.
    assert largest.influence > 1 and largest.p_value < 0.01 and 5 < largest.sigmas < 100


def test_a_marker_that_is_read_aside_is_one_finding():
    """Though none of its readings is beyond the noise; not the configurations that it was in."""
    markers = MARKERS | {"M3": np.array([-0.1, 0.05, 0.1]), "M4": np.array([0.0, -0.1, 0.05])}
    tracker = Tracker(noise=CartesianNoise(np.full(3, SIGMA)))
    model = Model.assembled(planar_chain(), cell_of(("base_frame",), markers, tracker))
    rng = np.random.default_rng(0)
    plan = table_at(random_poses(model.chain, 60, 0), markers=tuple(markers))
    table = measured(model, plan, true_values(model, rng), SIGMA, rng)
    aside = shifted(table, table.marker == 1, [0.0, 1.2 * SIGMA, 0.0])
    (found,) = identify(model, aside, Options(faulty="keep", noise="axis")).faulty_report.findings
    assert (found.level, found.name, len(found.lines)) == ("marker", "M2", 60)


def test_a_third_of_the_table_that_one_shift_explains_is_set_apart_by_all_but_a_jump():
    """Unlike errors of as many would be kept; kept readings are reported alike.  Of a jump, after
    which no reading is sound, `diagnose` seeks the cause."""
    model, table, _ = campaign(3, poses=24)
    for first, last, jump in ((8, 14, False), (16, 24, True)):
        rows = (table.configuration >= first) & (table.configuration < last)
        wrong, lines = shifted(table, rows, [0.0, 0.0, 4e-3]), set(table.row[rows].tolist())
        for faulty in ("auto", "keep"):
            result = identify(model, wrong, Options(faulty=faulty))
            told = result.excluded if faulty == "auto" else result.outliers
            assert {o.line for o in told} == lines and len(result.faulty) == len(told)
            assert lines == {line for f in result.faulty_report.findings for line in f.lines}
        found = diagnose(model, wrong)
        assert found.n_readings == len(table) - len(lines) * (not jump)
        assert any("one common shift" in text for text in found.warnings) != jump
