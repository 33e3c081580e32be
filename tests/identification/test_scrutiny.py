"""A second look at a fit: influence, correlation in time, parameter sets, parts of its errors."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
from support.calibration import SPRINGS, cell_of, measured, random_chain, table_at, true_values
from support.cells import random_poses

from elastocal.cell.arm_description import CartesianNoise, Nominal, Tracker
from elastocal.identification import scrutiny
from elastocal.identification.findings import judged
from elastocal.identification.identify import identify
from elastocal.identification.options import Options
from elastocal.identification.residuals import rms_3d
from elastocal.identification.scrutiny import autocorrelation
from elastocal.model.manipulator import Model
from elastocal.report.identification_view import influence_table, sets_table, uncertainty_table

SIGMA = 1e-5
STIFF = tuple(np.array([1.0, 0.9, 1.2, 8.0, 10.0, 6.0]) * 1e-7)
MARKERS = {"M1": np.array([0.1, 0, 0.05]), "M2": np.array([-0.05, 0.1, 0.1])}


def campaign(effects=SPRINGS, poses=25, seed=0):
    tracker = Tracker(noise=CartesianNoise(np.full(3, SIGMA)))
    cell = cell_of(
        effects, markers=MARKERS, tracker=tracker, nominal=Nominal(joint_compliance=STIFF)
    )
    model = Model.assembled(random_chain(3), cell)
    plan = table_at(
        random_poses(model.chain, poses, 3), ((0, 0, 0), (0, 0, -2000.0)), tuple(MARKERS)
    )
    rng = np.random.default_rng(seed)
    x = true_values(model, rng, 5e-4, anywhere=False)
    return model, measured(model, plan, x, SIGMA, rng)


@pytest.fixture(scope="module")
def fitted():
    model, table = campaign()
    return model, table, identify(model, table, Options(method="wls"))


def test_influence_is_what_leaving_a_configuration_out_does(fitted):
    """Against fits without it by the normal equations, with the same linearisation."""
    _, _, result = fitted
    found = result.influence()
    assert sum(c.leverage for c in found) == pytest.approx(len(result.determined))
    B = result.B[:, [result.model.names.index(n) for n in result.determined]] / SIGMA
    e = result.residual / SIGMA
    labels = np.repeat(result.observations.configuration, 3)
    names = result.observations.table.configuration_labels
    H = np.linalg.inv(B.T @ B)
    s2 = e @ e / result.dof
    std = np.sqrt(s2 * np.diag(H))
    for c in found:
        stays = labels != names.index(c.configuration)
        move = np.linalg.lstsq(B[stays], e[stays], rcond=None)[0] - H @ B.T @ e
        assert c.cook == pytest.approx(move @ (B.T @ B) @ move / (B.shape[1] * s2), rel=1e-5)
        k = int(np.argmax(np.abs(move) / std))
        assert c.moved == result.determined[k]
        assert c.by == pytest.approx(abs(move[k]) / std[k], rel=1e-5)


def test_a_configuration_that_alone_determines_something_is_said_so():
    """The only one that is loaded."""
    model, table = campaign()
    first = table.configuration == 0
    result = identify(model, table.take(first | (table.force == 0).all(axis=1)))
    alone = [c for c in result.influence() if not np.isfinite(c.cook)]
    assert [c.configuration for c in alone] == [table.configuration_labels[0]]
    assert alone[0].moved.endswith(".compliance") and alone[0].to_json()["cook"] is None
    assert "undetermined" in {row[5] for row in influence_table(result).rows}


def test_residuals_alike_in_time_are_found_and_clean_ones_seldom(fitted):
    """False-alarm rate of 1 % by permutation; a drift as large as the noise is found."""
    _, _, result = fitted
    observed = result.observations
    n = len(observed.lead)
    rng = np.random.default_rng(1)
    clean = [autocorrelation(rng.standard_t(3, size=3 * n), observed).p for _ in range(150)]
    assert sum(p < 0.01 for p in clean) <= 6  # of 150, 1.5 expected
    walk = np.cumsum(rng.normal(size=(n, 3)), axis=0)
    drift = SIGMA * (walk / walk.std() + rng.normal(size=(n, 3)))
    course = autocorrelation(drift.ravel(), observed)
    assert course.p < 0.01 and course.correlations[0] > course.band
    for ratio, severity in ((2**0.5, "care"), (1.0, "note")):  # of what the noise explains, a part
        noise = replace(result.noise, ratio_to_stated=ratio)
        f = judged(replace(result, residual=drift.ravel(), noise=noise)).finding("autocorrelated")
        assert f.severity == severity and "random order" in f.remedy


@pytest.mark.parametrize("size", [1, 3])
def test_moments_over_permutations_are_those_of_all_orders(size):
    mean = np.random.default_rng(size).standard_t(3, (6, size))
    mean -= mean.mean(axis=0)
    all_orders = (mean[list(order)] for order in itertools.permutations(range(6)))
    sums = [float((m[:-1] * m[1:]).sum()) for m in all_orders]
    assert scrutiny.over_permutations(mean) == pytest.approx((np.mean(sums), np.std(sums)))


def test_many_visits_are_judged_by_the_moments(fitted, monkeypatch):
    """25 visits already: the p-values are those of permutations to a few hundredths."""
    observed = fitted[2].observations
    rng = np.random.default_rng(2)
    residuals = rng.normal(size=(20, 3 * len(observed.lead)))
    drawn = [autocorrelation(e, observed) for e in residuals]
    monkeypatch.setattr(scrutiny, "MOST_PERMUTED", 12)
    found = [autocorrelation(e, observed) for e in residuals]
    for one, other in zip(found, drawn, strict=True):
        assert one.correlations == other.correlations
        assert one.p == pytest.approx(other.p, abs=0.06)
        assert one.band == pytest.approx(other.band, rel=0.15)


def test_order_is_that_of_times_where_there_are_any(fitted):
    _, _, result = fitted
    observed = result.observations
    n = len(observed.lead)
    rows = np.argsort(np.random.default_rng(3).permutation(25)[observed.configuration])
    time = np.empty(n)
    time[rows] = np.arange(n)
    timed = replace(observed, table=replace(observed.table, time=time))
    drift = np.repeat(np.sin(3 * time / n), 3) + 0.01 * np.random.default_rng(0).normal(size=3 * n)
    assert autocorrelation(drift, timed).by == "times"
    assert autocorrelation(drift, timed).p < 0.01 < autocorrelation(drift, observed).p


def test_sets_of_parameters_side_by_side(fitted):
    """Held-out errors are those of fits of these sets; geometry and compliance are both needed."""
    model, table, result = fitted
    sets = {s.name: s for s in result.parameter_sets()}
    assert {"base and markers", "with geometry", "with compliance", "chosen"} <= set(sets)
    chosen = sets["chosen"]
    assert chosen.heldout_rms == pytest.approx(result.heldout_rms, rel=1e-3)
    assert chosen.log_likelihood == 0 and chosen.heldout_over_chosen == 0
    for name in ("base and markers", "with geometry", "with compliance"):
        assert sets[name].log_likelihood < -10
        assert sets[name].ci95[0] > 0 and sets[name].heldout_rms > chosen.heldout_rms
    others = tuple(n for n in result.model.names if n.endswith(".compliance"))
    rigid = identify(model, table, Options(method="wls", fixed=others, faulty="keep"))
    assert sets["with geometry"].heldout_rms == pytest.approx(rigid.heldout_rms, rel=0.3)
    assert len(sets_table(result).rows) == len(sets)


def test_the_budget_adds_up_to_the_held_out_error(fitted):
    _, table, result = fitted
    budget = result.uncertainty()
    assert budget.instrument == pytest.approx(SIGMA * np.sqrt(3), rel=0.1)
    assert budget.repeatability == 0 and budget.parameters > 0
    B = result.B[:, [result.model.names.index(n) for n in result.determined]]
    own = rms_3d(np.sqrt(np.einsum("rj,jk,rk->r", B, result.covariance, B)), 3)
    assert budget.parameters == pytest.approx(own)
    assert budget.total == pytest.approx(result.heldout_rms, rel=0.1)
    assert budget.lack_of_fit == pytest.approx(result.predicted.lacking)
    there = result.uncertainty(table.take(np.arange(6)))
    assert there.instrument == budget.instrument and there.parameters != budget.parameters
    assert uncertainty_table(result).rows[-1][2] == "100 %"


def test_what_the_stated_noise_does_not_explain_is_lack_of_fit(fitted):
    """As in the error expected at new poses, and no part of the instrument's."""
    _, _, result = fitted
    budget = replace(result, noise=replace(result.noise, ratio_to_stated=3.0)).uncertainty()
    assert budget.lack_of_fit == pytest.approx(SIGMA * np.sqrt(3 * 8 / 9), rel=0.1)
    assert budget.instrument == pytest.approx(SIGMA * np.sqrt(3 / 9), rel=0.3)


def test_scatter_of_a_configuration_counts_as_repeatability():
    model, table = campaign(seed=2)
    common = 4e-5 * np.random.default_rng(0).normal(size=(25, 3))
    result = identify(model, replace(table, position=table.position + common[table.configuration]))
    budget = result.uncertainty()
    assert budget.repeatability == pytest.approx(4e-5 * np.sqrt(3), rel=0.3)
    assert budget.instrument == pytest.approx(SIGMA * np.sqrt(3), rel=0.2)


def test_all_of_it_is_in_the_json(fitted):
    content = json.loads(json.dumps(fitted[2].to_json(), allow_nan=False))
    assert len(content["influence"]) == 25 and content["influence"][0]["leverage"] > 0
    assert {s["set"] for s in content["parameter_sets"]} >= {"chosen", "with geometry"}
    assert content["autocorrelation"]["visits"] == 25
    assert content["uncertainty"]["total_um"] > 0
