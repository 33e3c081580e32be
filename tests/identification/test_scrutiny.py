"""A second look at a fit: influence, correlation in time, parameter sets, parts of its errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.calibration import SPRINGS, cell_of, measured, random_chain, table_at, true_values
from support.cells import random_poses

from elastocal.cell.arm_description import CartesianNoise, Nominal, Tracker
from elastocal.identification.findings import judged
from elastocal.identification.identify import identify
from elastocal.identification.options import Options
from elastocal.identification.scrutiny import autocorrelation
from elastocal.model.manipulator import Model

SIGMA = 1e-5
STIFF = tuple(np.array([1.0, 0.9, 1.2, 8.0, 10.0, 6.0]) * 1e-7)
MARKERS = {"M1": np.array([0.1, 0, 0.05]), "M2": np.array([-0.05, 0.1, 0.1])}


@pytest.fixture(scope="module")
def fitted():
    cell = cell_of(
        SPRINGS, MARKERS, Tracker(noise=CartesianNoise(np.full(3, SIGMA))),
        nominal=Nominal(joint_compliance=STIFF),
    )  # fmt: skip
    model, rng = Model.assembled(random_chain(3), cell), np.random.default_rng(0)
    q = random_poses(model.chain, 25, 3)
    plan = table_at(q, ((0, 0, 0), (0, 0, -2000.0)), tuple(MARKERS))
    x = true_values(model, rng, 5e-4, anywhere=False)
    table = measured(model, plan, x, SIGMA, rng)
    return table, identify(model, table, Options(method="wls"))


def test_influence_is_what_leaving_a_configuration_out_does(fitted):
    """Against fits without it by the normal equations, with the same linearisation."""
    _, result = fitted
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


def test_residuals_alike_in_time_are_found_and_clean_ones_seldom(fitted):
    """False-alarm rate of 1 % by permutation; a drift as large as the noise is found."""
    _, result = fitted
    observed = result.observations
    n = len(observed.lead)
    rng = np.random.default_rng(1)
    clean = [autocorrelation(rng.standard_t(3, size=3 * n), observed).p for _ in range(80)]
    assert sum(p < 0.01 for p in clean) <= 5  # of 80, 0.8 expected
    walk = np.cumsum(rng.normal(size=(n, 3)), axis=0)
    drift = SIGMA * (walk / walk.std() + rng.normal(size=(n, 3)))
    course = autocorrelation(drift.ravel(), observed)
    assert course.p < 0.01 and course.correlations[0] > course.band
    for ratio, severity in ((2**0.5, "care"), (1.0, "note")):  # of what the noise explains, a part
        noise = replace(result.noise, ratio_to_stated=ratio)
        f = judged(replace(result, residual=drift.ravel(), noise=noise)).finding("autocorrelated")
        assert f.severity == severity and "random order" in f.remedy
