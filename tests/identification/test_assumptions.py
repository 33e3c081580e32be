"""What an attack on `identify` found: copies, other units, numbers that the data cannot support; a
second look at a fit: influence, correlation in time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.calibration import SPRINGS, cell_of, measured, random_chain, table_at, true_values
from support.cells import random_poses

from elastocal.cell_tables import CartesianNoise, Nominal, Tracker, Unsteadiness
from elastocal.identification.findings import judged
from elastocal.identification.identify import identify
from elastocal.identification.scrutiny import autocorrelation
from elastocal.identification.start import Options, copied
from elastocal.messages import InputError
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.report.identification_view import undetermined_lines
from elastocal.report.judgement_view import judgement

SIGMA = 1e-5
MARKERS = {"M1": np.array([0.1, 0, 0.05]), "M2": np.array([-0.05, 0.1, 0.1])}
STIFF = tuple(np.array([1.0, 0.9, 1.2, 8.0, 10.0, 6.0]) * 1e-7)
LOADS = ((0, 0, 0), (0, 0, -2000.0))


def arm(poses=20, stated=None, nominal=STIFF, effects=SPRINGS):
    tracker = Tracker(noise=CartesianNoise(np.full(3, stated))) if stated else None
    model = {} if nominal is None else {"nominal": Nominal(joint_compliance=nominal)}
    cell = cell_of(effects, markers=MARKERS, tracker=tracker, **model)
    chosen = Model.assembled(random_chain(3), cell)
    return chosen, table_at(random_poses(chosen.chain, poses, 3), LOADS, tuple(MARKERS))


def compliances(model):
    return [i for i, name in enumerate(model.names) if name.endswith(".compliance")]


def campaign(model, plan, seed=0, stiffness=STIFF):
    rng = np.random.default_rng(seed)
    x = true_values(model, rng, 5e-4, anywhere=False)
    x[compliances(model)] = stiffness
    return measured(model, plan, x, SIGMA, rng), x


@pytest.fixture(scope="module")
def clean():
    model, plan = arm(stated=SIGMA)
    table, x = campaign(model, plan)
    return model, table, x, identify(model, table)


def doubled(table, lines, labels=0):
    """The table with rows twice, as repeats or, with so many `labels`, as other configurations."""
    both = table.take(np.r_[np.arange(len(table)), lines])
    both = replace(both, row=np.arange(len(both)) + 2)
    if not labels:
        return replace(both, repeat=np.r_[table.repeat, table.repeat[lines] + 1])
    again = np.r_[table.configuration, table.configuration[lines] + labels]
    names = tuple(map(str, range(2 * labels)))
    return replace(both, configuration=again, configuration_labels=names)


def test_copies_under_new_labels_are_counted_once(clean):
    model, table, _, alone = clean
    twice = doubled(table, np.arange(len(table)), len(table.configuration_labels))
    result = identify(model, twice)
    assert result.copies == tuple(range(len(table) + 2, 2 * len(table) + 2))
    assert np.allclose(result.covariance, alone.covariance, rtol=1e-3, atol=0)
    assert result.finding("copied_readings").numbers["copies"] == len(table)
    assert any("the last digit were excluded (lines" in w for w in result.warnings)
    assert result.to_json()["copies"] == list(result.copies)
    with pytest.raises(InputError, match="the covariance is"):
        identify(model, twice, Options(covariance=np.eye(6 * len(twice))))


def test_repeats_that_rounding_makes_equal_are_no_copies():
    """Hardly any clean table loses a reading; nearly every one does of which a third is copied."""
    _, plan = arm(poses=8, nominal=None, effects=("base_frame",))
    found, caught = [], []
    for seed in range(60):
        table = of_repeats(plan, np.random.default_rng(seed))
        third = np.arange(len(table) // 3)
        found.append(copied(observe(table, "position")).any())
        caught.append(copied(observe(doubled(table, third), "position")).sum() >= len(third))
    assert sum(found) <= 3 and sum(caught) >= 54


def of_repeats(plan, rng):
    """Six repeats, rounded to 1.5 times their noise."""
    rows, step = np.repeat(np.arange(len(plan)), 6), 1.5 * SIGMA
    position = rng.normal(size=(len(plan), 3))[rows] + SIGMA * rng.normal(size=(len(rows), 3))
    repeat = np.tile(np.arange(6), len(plan))
    return replace(plan.take(rows), repeat=repeat, position=np.round(position / step) * step)


def test_a_compliance_that_hardly_shows_has_no_value():
    """Light loads, which hardly show the compliance of the last joint."""
    model, plan = arm(nominal=None)
    table, _ = campaign(model, plan, 1, np.array([*STIFF[:5], 0.0]))
    result = identify(model, table)
    e = result["joint6.compliance"]
    assert e.value is None and e.std is None and e.ci95 is None
    low, high = e.limits
    assert low <= 0 <= high and e.held >= 0
    text = "\n".join(undetermined_lines(result))
    assert "hardly shown" in text and "joint6.compliance (at most" in text
    assert "joint6.compliance" in result.finding("hardly_shown").numbers["parameters"]
    entry = next(p for p in result.to_json()["parameters"] if p["name"] == e.name)
    assert entry["value"] is None and entry["limits95"] == [low, high]


def test_noise_stated_far_too_large_is_no_noise_that_explains_the_residual(clean):
    _, table, _, _ = clean
    model, _ = arm(stated=10 * SIGMA)
    result = identify(model, table)
    f = result.finding("residual_below_stated_noise")
    assert f.severity == "care" and f.number("ratio") == pytest.approx(0.1, rel=0.15)
    assert "stated noise is too large" in judgement(result).sentence
    slightly = judged(replace(result, noise=replace(result.noise, ratio_to_stated=0.8)))
    assert slightly.finding("residual_below_stated_noise").severity == "note"
    shared = replace(arm(stated=SIGMA)[0].cell, noise=Unsteadiness(configuration=20 * SIGMA))
    result = identify(Model.assembled(model.chain, shared), table)
    assert result.finding("common_noise_too_large").severity == "care"
    assert "common to a configuration is too large" in judgement(result).sentence


# A second look at a fit


@pytest.fixture(scope="module")
def fitted(clean):
    model, table, *_ = clean
    return identify(model, table, Options(method="wls"))


def test_influence_is_what_leaving_a_configuration_out_does(fitted):
    """Against fits without it by the normal equations, with the same linearisation."""
    result, found = fitted, fitted.influence()
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


def test_residuals_alike_in_time_are_found_and_clean_ones_seldom(fitted):
    """False-alarm rate of 1 % by permutation; a drift as large as the noise is found."""
    observed = fitted.observations
    n = len(observed.lead)
    rng = np.random.default_rng(1)
    clean = [autocorrelation(rng.standard_t(3, size=3 * n), observed).p for _ in range(80)]
    assert sum(p < 0.01 for p in clean) <= 5  # of 80, 0.8 expected
    walk = np.cumsum(rng.normal(size=(n, 3)), axis=0)
    drift = SIGMA * (walk / walk.std() + rng.normal(size=(n, 3)))
    course = autocorrelation(drift.ravel(), observed)
    assert course.p < 0.01 and course.correlations[0] > course.band
    for ratio, severity in ((2**0.5, "care"), (1.0, "note")):  # of what the noise explains, a part
        noise = replace(fitted.noise, ratio_to_stated=ratio)
        f = judged(replace(fitted, residual=drift.ravel(), noise=noise)).finding("autocorrelated")
        assert f.severity == severity and "random order" in f.remedy
