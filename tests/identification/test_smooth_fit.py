"""Smooth functions in the whole identification: error curves, and weights that nobody knows."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from support.calibration import PLACED, cell_of, measured, planar_chain, table_at
from support.cells import kr270_cell, kr270_chain, random_poses, random_table
from support.stick import model as of_stick
from support.stick import stick

from elastocal.cell_tables import Nominal, Tool
from elastocal.identification.identify import identify
from elastocal.identification.start import Options
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
    model: Model, x: Array, n: int, rng: np.random.Generator, sigma: float = SIGMA,
    loads: tuple = ((0, 0, 0),), marker: str = "M1",
) -> Measurements:  # fmt: skip
    table = table_at(rng.uniform(-HALF, HALF, (n, 3)), loads, (marker,))
    return measured(model, table, x, sigma, rng)


@lru_cache
def campaign():
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
    fit = identify(model, table, Options(method="ols", faulty="keep"))
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
    assert gone
    for part in gone:
        assert (part.value == 0).all() and (part.covariance == 0).all()
        assert part.sizes == {"rad": (0.0, (0.0, 0.0), 0.0)}
        assert any(part.group.name in told for told in fit.warnings)
        note = fit[model.names[part.group.columns[0, 0]]].note
        assert "do not show" in note


@pytest.mark.parametrize("errors", [1, 5])
def test_what_readings_do_not_show_is_known_by_the_size_of_errors(errors: float) -> None:
    """Not by how a nearly free exchange of two parameters bends the readings."""
    effects = (*PLACED, "joint_offset", "link_geometry", "joint_curve:joint2", "joint_curve:joint3")
    nominal, chain = Nominal(settings=dict.fromkeys(JOINTS[1:], CURVE)), kr270_chain()
    cell, rng = kr270_cell(effects, nominal=nominal), np.random.default_rng(2)
    m = Model.assembled(chain, replace(cell, tool=Tool(np.zeros(3), {"M1": np.array([0, 0, 0.1])})))
    sizes = np.array([p.typical or 1e-3 for p in m.parameters]) * np.where(m.shrunk, 1, errors)
    x = m.nominal + sizes * rng.normal(size=len(sizes))
    table = table_at(random_poses(chain, 60, 1), ((0, 0, 0),), ("M1",))
    fit = identify(m, measured(m, table, x, 5e-5, rng))
    own = [k for k, name in enumerate(m.names) if not m.shrunk[k]]
    std = np.array([fit[m.names[k]].std for k in own])
    assert (std < 3 * sizes[own]).all()
    assert ((fit.x - x)[own] / std).std() < 1.4


# Weights that nobody knows and the compliances that they bend: a product, fitted as one.

SMALL = 1e-5  # m
STATED = (1e-5, 2e-5, 3e-5)  # rad/(N m)
LOADS = ((0.0, 0.0, 0.0), (0.0, 0.0, -60.0))


def sagging_arm(*effects: str) -> Model:
    chain = stick("zyy", (0.3, 0.8, 0.6))
    nominal = Nominal(joint_compliance=STATED)
    return of_stick(chain, "joint_offset", *effects, tip=(0.1, 0.05, 0.1), nominal=nominal)


def sagging(m: Model) -> Array:
    """Springs off by a third, and moments of some 10 kg m."""
    x = m.nominal.copy()
    for name, factor in zip(("joint1", "joint2", "joint3"), (1.0, 1.35, 0.7), strict=True):
        x[m.names.index(f"{name}.compliance")] *= factor
    values = {"link2_moment_x": 9.0, "link2_moment_y": 0.4, "link3_moment_x": -2.5}
    for key, value in values.items():
        x[m.names.index(f"arm.{key}")] = value
    return x


def test_loads_tell_the_springs_and_these_the_moments() -> None:
    m = sagging_arm("joint_compliance", "link_weights")
    x = sagging(m)
    table, test = (
        readings(m, x, n, np.random.default_rng(n), sigma, LOADS, "tip")
        for n, sigma in ((40, SMALL), (100, 0.0))
    )
    found = identify(m, table, test=test)
    assert found.converged and found.test.rms < 1.5 * SMALL
    sag = identify(sagging_arm("joint_compliance", "gravity_sag"), table, test=test)
    assert found.test.rms < sag.test.rms, "each joint's own functions have more to fit"
    for name in ("joint2.compliance", "joint3.compliance", "arm.link2_moment_x"):
        estimate = found[name]
        assert abs(estimate.value - x[m.names.index(name)]) < 4.5 * estimate.std
    (part,) = found.smooth
    assert part.group.effect == "link_weights" and part.group.units == ("kg*m",)


@pytest.mark.long
def test_a_compliance_whose_weights_are_held_at_zero_is_left_out() -> None:
    """Without loads a spring shows by the weights alone: where their errors are dropped it moves
    nothing, though it was chosen beside them."""
    effects = ["base_frame", "joint_offset", "joint_compliance", "link_mass_error", "gravity_sag"]
    chain, rng = kr270_chain(), np.random.default_rng(1)
    m = Model.assembled(chain, kr270_cell(effects))
    poses = random_table(chain, 12, seed=1)
    table = replace(poses, force=np.zeros_like(poses.force), distance=None)
    x = m.nominal.copy()
    for k, p in enumerate(m.parameters):
        x[k] += (p.typical or 1e-7) * rng.normal() * (0.3 if p.lower < 0 else 0.0)
    position = m.predict(table, x).reshape(-1, 3) + 3e-5 * rng.normal(size=(len(table), 3))
    found = identify(m, replace(table, position=position))
    assert found.converged
    assert found["joint5.compliance"].std is None
