"""Synthetic measurements: the model's own readings, noise of the stated size, a seed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from support.calibration import GEOMETRY, cell_of, planar_chain, table_at, true_values
from support.cells import random_poses

from elastocal.cell_tables import (
    CartesianNoise,
    DesignSpec,
    Nominal,
    PolarNoise,
    Tracker,
    Unsteadiness,
)
from elastocal.messages import InputError
from elastocal.model.manipulator import Model
from elastocal.model.observations import position_covariance
from elastocal.simulation import draw_errors, simulate

AXIS = Tracker(noise=CartesianNoise(np.array([1e-5, 2e-5, 5e-5])))
POLAR = Tracker(np.array([3.0, 0.5, 1.0]), PolarNoise(2e-6, 5e-6, 1e-5, 3e-5))


def model_with(tracker=None, effects=GEOMETRY, **cell):
    return Model.assembled(planar_chain(), cell_of(effects, tracker=tracker, **cell))


def plan_of(model, n=20, forces=((0, 0, 0),), markers=("M1",)):
    return table_at(random_poses(model.chain, n, 1), forces, markers)


def chi2_band(dof, level=1e-3):
    return stats.chi2.ppf(level / 2, dof), stats.chi2.isf(level / 2, dof)


@pytest.mark.parametrize(
    ("tracker", "rows"), [(AXIS, None), (POLAR, None), (AXIS, "polar"), (POLAR, "of M1")]
)
def test_noise_has_the_stated_covariance(tracker, rows):
    """Whitened by the stated covariance, 900 errors are χ²(900), each component's 300 χ²(300)."""
    own = DesignSpec(marker_sigma={"M1": 7e-5} if rows == "of M1" else {})
    cell = replace(cell_of(GEOMETRY, tracker=tracker), design=own)
    model = Model.assembled(planar_chain(), cell)
    plan = plan_of(model, 300)
    if rows == "polar":
        sigma = 10.0 ** np.random.default_rng(2).uniform(-6, -4, (300, 3))
        plan = replace(plan, sigma=sigma, sigma_frame=rows)
    exact = simulate(model, plan, model.nominal, 0, noise=False)
    noisy = simulate(model, plan, model.nominal, 3)
    kind = "rows" if rows else ("axis" if tracker is AXIS else "polar")
    covariance, _ = position_covariance(replace(noisy, position=exact.position), tracker, kind)
    error = noisy.position - exact.position
    z = np.linalg.solve(np.linalg.cholesky(covariance), error[..., None])[..., 0]
    for squares, dof in ((z**2).sum(), 900), ((z**2).sum(axis=0), 300):
        low, high = chi2_band(dof, 1e-3 * dof / 900)
        assert np.all(low < squares) and np.all(squares < high)
    assert abs(z.mean()) < 4 / np.sqrt(900)


def test_drawn_errors_have_the_typical_sizes():
    nominal = Nominal(joint_compliance=(1e-6, 2e-6, 3e-6))
    model = model_with(effects=(*GEOMETRY, "joint_compliance"), nominal=nominal)
    rng = np.random.default_rng(0)
    draws = [draw_errors(model, 2.0, rng) for _ in range(300)]
    assert list(draws[0]) == list(model.names)
    low, high = chi2_band(300, 1e-3 / len(model.names))
    for p in model.parameters:
        size = 0.2 * p.nominal if p.effect == "joint_compliance" else p.typical
        z = np.array([d[p.name] - p.nominal for d in draws]) / (2.0 * size)
        assert low < (z**2).sum() < high, p.name
    assert draw_errors(model, 2.0, np.random.default_rng(0)) == draws[0]
    assert draw_errors(model, 0.0, rng) == dict(zip(model.names, model.nominal, strict=True))


def test_a_drift_is_correlated_in_time_and_the_table_says_when():
    model = model_with(noise=Unsteadiness(drift=1e-4, lasting=60.0))
    plan, truth = plan_of(model), true_values(model_with(), np.random.default_rng(0))
    exact = simulate(model, plan, truth, 0, noise=False)
    assert exact.time is None
    tables = [simulate(model, plan, truth, k) for k in range(200)]
    off = np.array([t.position - exact.position for t in tables])
    assert abs(np.sqrt(np.mean(off**2)) / 1e-4 - 1) < 0.1
    assert (np.diff(tables[0].time) == 30.0).all()  # what a visit takes
    neighbours = np.mean(off[:, 1:] * off[:, :-1]) / np.mean(off**2)
    assert abs(neighbours - np.exp(-0.5)) < 0.1


def test_tails_have_the_stated_standard_deviation_and_many_far_readings():
    sigma = 1e-5
    noise = CartesianNoise(np.full(3, sigma))
    normal, far = (
        model_with(tracker=Tracker(noise=noise), noise=Unsteadiness(tails=t)) for t in (None, 5.0)
    )
    plan, truth = plan_of(normal), true_values(normal, np.random.default_rng(0))
    exact = simulate(normal, plan, truth, 0, noise=False).position
    found = []
    for model in (normal, far):
        off = np.array([simulate(model, plan, truth, k).position - exact for k in range(120)])
        assert np.sqrt(np.mean(off**2)) == pytest.approx(sigma, rel=0.06)
        found.append(np.mean(np.abs(off) > 4 * sigma))
    assert found[1] > 10 * max(found[0], 1e-4)
    with pytest.raises(InputError, match=r"tails takes a number > 2.*found 2\.0"):
        Unsteadiness(tails=2.0)
