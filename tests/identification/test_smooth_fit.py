"""Smooth functions in the whole identification, on a small arm whose joints have error curves."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from support.calibration import PLACED, cell_of, measured, planar_chain, table_at

from elastocal.cell.arm_description import Nominal
from elastocal.identification.identify import identify
from elastocal.identification.options import Options
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.units import Array

SIGMA = 2e-5  # m
SIZE, LENGTH, HALF = 5e-4, 0.5, 2.0
CURVE = {
    "curve_size_rad": SIZE, "curve_length_rad": LENGTH, "curve_low_rad": -HALF,
    "curve_high_rad": HALF,
}  # fmt: skip
JOINTS = ("joint1", "joint2", "joint3")
EFFECTS = (*PLACED, "joint_offset", *(f"joint_curve:{joint}" for joint in JOINTS))


@lru_cache
def arm(*effects: str) -> Model:
    """Three joints with error curves; the marker 0.1 m off the last axis."""
    cell = cell_of(
        effects or EFFECTS, {"M1": np.array([0.1, 0.05, 0.1])},
        nominal=Nominal(settings=dict.fromkeys(JOINTS, CURVE)),
    )  # fmt: skip
    return Model.assembled(planar_chain(), cell)


def true(model: Model, rng: np.random.Generator, curves: float = 1.0) -> Array:
    """Offsets of 1 mrad, and curves drawn from their prior, times `curves`."""
    x = model.nominal.copy()
    for i, p in enumerate(model.parameters):
        if p.shrunk:
            x[i] = curves * float(p.typical or 0.0) * rng.normal()
        elif p.effect == "joint_offset":
            x[i] = 1e-3 * rng.normal()
    return x


def readings(
    model: Model, x: Array, n: int, rng: np.random.Generator, sigma: float = SIGMA
) -> Measurements:
    table = table_at(rng.uniform(-HALF, HALF, (n, 3)))
    return measured(model, table, x, sigma, rng)


@lru_cache
def campaign():
    """Readings, others for a test, and the calibration."""
    model, rng = arm(), np.random.default_rng(1)
    x = true(model, rng)
    table, test = readings(model, x, 80, rng), readings(model, x, 200, rng, 0.0)
    return table, test, identify(model, table, test=test)


def test_new_poses_are_predicted_to_the_noise():
    table, test, fit = campaign()
    plain = identify(arm(*PLACED, "joint_offset"), table, test=test)
    assert fit.converged and fit.method == "reml"
    assert plain.test.rms > 3e-4, "the curves are large"
    assert fit.test.rms < 0.15 * plain.test.rms
    assert np.isclose(fit.heldout_rms, np.hypot(fit.test.rms, SIGMA * 3**0.5), rtol=0.6)
    assert np.isclose(fit.noise.sigma or 0.0, SIGMA, rtol=0.25)
    assert len(fit.smooth) == 3 and all(0.1 < part.scale < 10 for part in fit.smooth)


def test_held_out_residuals_are_those_of_refits():
    """Leaving out a configuration for good: prior and noise as found, on the model itself."""
    model, rng = arm(*(e for e in EFFECTS if e != "joint_offset")), np.random.default_rng(0)
    table = readings(model, true(model, rng), 40, rng)
    options = Options(method="ols", faulty="keep")
    fit = identify(model, table, options)
    observed = observe(table, model.observe)
    columns = np.array([model.names.index(name) for name in fit.determined])
    prior = np.zeros(len(columns))
    for part in fit.smooth:
        for c in part.group.columns.ravel():
            if c in columns:
                typical = float(model.parameters[c].typical or 0.0)
                prior[columns == c] = fit.sigma**2 / (part.scale * typical**2)
    B = model.regressor(table, fit.x, columns, observed).B
    # About the fit: the prior pulls by where each parameter stands.
    stands = fit.x[columns] * (prior > 0)
    for left in (0, 7, 23):
        keep = np.ones(len(observed.lead), dtype=bool)
        keep[left] = False
        rows = np.repeat(keep, 3)
        normal = B[rows].T @ B[rows] + np.diag(prior)
        step = np.linalg.solve(normal, B[rows].T @ fit.residual[rows] - prior * stands)
        expected = fit.residual[~rows] - B[~rows] @ step
        assert np.allclose(fit.held_out[~rows], expected, rtol=0.02, atol=2e-8)


def test_nothing_is_claimed_where_there_are_no_curves():
    model, rng = arm(), np.random.default_rng(7)
    x = true(model, rng, curves=0.0)
    table, test = readings(model, x, 60, rng), readings(model, x, 200, rng, 0.0)
    fit = identify(model, table, test=test)
    plain = identify(arm(*PLACED, "joint_offset"), table, test=test)
    assert fit.test.rms < 1.15 * plain.test.rms + 1e-6
    assert sum(part.effective for part in fit.smooth) < 8
    gone = [part for part in fit.smooth if part.scale == 0]
    for part in gone:
        assert (part.value == 0).all() and (part.covariance == 0).all()
        assert any(part.group.name in told for told in fit.warnings)
        note = fit[model.names[part.group.columns[0, 0]]].note
        assert "do not show" in note


def test_faulty_readings_are_judged_beside_the_curves():
    """0.3 mm hide in what curves of 0.5 mrad leave a model without them, not beside them."""
    table, test, clean = campaign()
    position = np.asarray(table.position).copy()
    position[[5, 40]] += [[3e-4, 0, 0], [0, 0, -4e-4]]
    fit = identify(arm(), replace(table, position=position), test=test)
    assert {o.line for o in fit.excluded} == set(table.row[[5, 40]])
    assert not clean.faulty
    assert fit.test.rms < 1.2 * clean.test.rms
