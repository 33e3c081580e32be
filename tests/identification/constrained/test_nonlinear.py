"""Constrained fits of a whole arm: the KR 270 at the poses of Table 2, nonlinear equilibrium."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy import sparse
from support.calibration import measured, with_values
from support.cells import SLANTED, TABLE_2, kr270_cell, table_of

from elastocal.errors import ElastocalError, InputError
from elastocal.identification.constrained import constrained_fit
from elastocal.identification.knowledge import (
    Bounds,
    Constraints,
    GaussianPrior,
    SemidefiniteMatrix,
    equal,
    non_negative,
    physical_constraints,
)
from elastocal.identification.knowledge_fit import profile_fit_interval
from elastocal.identification.least_squares import FitProblem, fit
from elastocal.identification.weighted_problem import Weights
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe

SIGMA = 2e-4  # m, of a deflection: coarse, so that a stiff bearing is lost in the noise
BEARING_X, BEARING_Y = "joint2.off_axis_compliance_x", "joint2.off_axis_compliance_y"


@lru_cache
def arm() -> Model:
    return Model(
        kr270_cell(("joint_compliance", "off_axis_compliance:joint2"), observe="deflection")
    )


def problem(seed: int, shifted: int = 0, **values: float) -> FitProblem:
    """Readings of the arm with stiff bearings unless `values` say otherwise, start at nominal."""
    model = arm()
    truth = with_values(model, {"joint3.compliance": 5e-7} | values)
    rng = np.random.default_rng(seed)
    table = measured(model, table_of(TABLE_2, SLANTED, both=True), truth, SIGMA / 2**0.5, rng)
    if shifted:
        position = table.position.copy()
        position[np.flatnonzero(table.force.any(axis=1))[:shifted]] += 2e-2
        table = replace(table, position=position)
    observed = observe(table, "deflection")
    whiten = sparse.csr_array(sparse.eye_array(len(observed.value)) / SIGMA)
    sizes = model.sizes(model.regressor(table, model.nominal, None, observed).B)
    columns = np.arange(len(model.names))
    weights = Weights("axis", whiten, True, "")
    return FitProblem(model, observed, weights, model.nominal, columns, sizes)


@lru_cache
def negative_bearing() -> FitProblem:
    """A problem whose unconstrained estimate of BEARING_X is negative."""
    found = problem(0)
    assert fit(found).x[arm().names.index(BEARING_X)] < 0
    return found


def test_a_negative_compliance_becomes_zero_and_the_others_follow():
    stated = negative_bearing()
    found = constrained_fit(stated, physical_constraints(arm()))
    i = arm().names.index(BEARING_X)
    assert found.converged and found.kkt < 1e-8
    assert found.x[i] == 0
    (active,) = found.active
    assert (active.label, active.kind) == (f"{BEARING_X} >= 0", "lower")
    assert active.multiplier > 0
    held = fit(replace(stated, columns=np.delete(stated.columns, i)))
    np.testing.assert_allclose(found.x, held.x, atol=1e-7 * stated.sizes.min(), rtol=1e-7)
    assert found.objective == pytest.approx(held.whitened @ held.whitened, rel=1e-10)
    np.testing.assert_allclose(found.whitened, held.whitened, atol=1e-5)
    assert found.cofactor[i, i] == 0 and np.isnan(found.prior_share[i])


def test_without_active_constraints_it_is_the_fit():
    stated = problem(1, **{BEARING_X: 8e-8, BEARING_Y: 8e-8})
    found, free = constrained_fit(stated, physical_constraints(arm())), fit(stated)
    assert found.active == ()
    np.testing.assert_allclose(found.x, free.x, rtol=1e-8, atol=1e-14)


def test_the_models_own_bounds_are_the_physical_ones():
    stated = negative_bearing()
    bounded = constrained_fit(replace(stated, bounded=True))
    np.testing.assert_array_equal(bounded.x, constrained_fit(stated, physical_constraints(arm())).x)


def test_a_multiplier_is_the_price_of_its_bound_in_the_nonlinear_problem():
    stated = negative_bearing()
    (active,) = constrained_fit(stated, non_negative(BEARING_X)).active
    step = 1e-10
    up, down = (
        constrained_fit(stated, Constraints((Bounds(BEARING_X, lower=s * step),))).objective
        for s in (1, -1)
    )
    assert active.multiplier == pytest.approx((up - down) / (2 * step), rel=1e-3)


def test_a_semidefinite_joint_is_the_bounds_of_its_diagonal():
    stated = negative_bearing()
    drive = "joint2.compliance"
    K = SemidefiniteMatrix("joint2", ((BEARING_X, 0, 0), (0, BEARING_Y, 0), (0, 0, drive)))
    found = constrained_fit(stated, Constraints(matrices=(K,)))
    expected = constrained_fit(stated, non_negative(BEARING_X, BEARING_Y, drive))
    np.testing.assert_allclose(found.x, expected.x, atol=1e-6 * stated.sizes.min())
    assert [a.label for a in found.active] == ["joint2"]
    assert found.kkt < 1e-8


def test_a_coupled_matrix_binds_and_the_fit_stays_inside():
    # Bearing compliances as a matrix with a known coupling: x·y ≥ coupling² keeps both positive.
    stated = negative_bearing()
    coupling = 2e-8
    K = SemidefiniteMatrix("bearing", ((BEARING_X, coupling), (coupling, BEARING_Y)))
    found = constrained_fit(stated, Constraints(matrices=(K,)))
    x, y = (found.x[arm().names.index(n)] for n in (BEARING_X, BEARING_Y))
    assert x > 0 and y > 0
    assert x * y == pytest.approx(coupling**2, rel=1e-8)
    assert found.converged and found.kkt < 1e-8
    free = fit(stated)
    assert found.objective > free.whitened @ free.whitened


def test_an_equality_holds_exactly():
    stated = problem(2, **{BEARING_X: 8e-8, BEARING_Y: 6e-8})
    found = constrained_fit(stated, equal(BEARING_X, BEARING_Y))
    x, y = (found.x[arm().names.index(n)] for n in (BEARING_X, BEARING_Y))
    assert x == pytest.approx(y, rel=1e-12) and x > 0
    assert found.active[0].kind == "equality" and found.kkt < 1e-8


def test_an_infeasible_start_is_moved_inside():
    stated = negative_bearing()
    start = stated.x.copy()
    start[arm().names.index(BEARING_X)] = -3e-7
    found = constrained_fit(replace(stated, x=start), physical_constraints(arm()))
    expected = constrained_fit(stated, physical_constraints(arm()))
    np.testing.assert_allclose(found.x, expected.x, rtol=1e-8, atol=1e-16)


def test_a_sharp_prior_rules_and_a_flat_one_does_not():
    stated = problem(3, **{BEARING_X: 8e-8, BEARING_Y: 8e-8})
    free, i = fit(stated), arm().names.index(BEARING_X)
    flat, sharp = (
        constrained_fit(stated, prior=GaussianPrior.independent((BEARING_X,), [3e-7], [std]))
        for std in (1e-3, 1e-13)
    )
    np.testing.assert_allclose(flat.x, free.x, rtol=1e-6)
    assert sharp.x[i] == pytest.approx(3e-7, rel=1e-5)
    assert flat.prior_share[i] < 1e-6 and sharp.prior_share[i] > 1 - 1e-6


def test_a_tie_is_the_prior_it_stands_for():
    stated = problem(3)
    mean, std = stated.x[:2] * 1.2, stated.x[:2] * 0.05
    tie, centre = np.full(len(stated.x), 1e3), stated.x.copy()
    tie[:2], centre[:2] = std, mean
    tied = constrained_fit(replace(stated, tie=tie, centre=centre))
    prior = constrained_fit(stated, prior=GaussianPrior.independent(arm().names[:2], mean, std))
    np.testing.assert_allclose(tied.x, prior.x, rtol=1e-9, atol=1e-16)


def test_huber_resists_shifted_readings():
    stated = problem(4, shifted=4)
    truth = with_values(arm(), {"joint3.compliance": 5e-7})
    errors = [
        np.linalg.norm(
            (constrained_fit(stated, physical_constraints(arm()), loss=loss).x - truth)
            / stated.sizes
        )
        for loss in ("squares", "huber")
    ]
    assert errors[1] < 0.3 * errors[0]


def test_held_parameters_stay_and_may_not_break_a_constraint():
    stated = negative_bearing()
    i = arm().names.index(BEARING_X)
    held = replace(stated, columns=np.delete(stated.columns, i))
    assert constrained_fit(held, physical_constraints(arm())).x[i] == stated.x[i]
    outside = stated.x.copy()
    outside[i] = -1e-8
    with pytest.raises(InputError, match="is held at -1e-08, outside its bounds"):
        constrained_fit(replace(held, x=outside), physical_constraints(arm()))


def test_a_start_without_equilibrium_is_said():
    stated = negative_bearing()
    soft = stated.x.copy()
    soft[1] = 1e-2
    with pytest.raises(ElastocalError, match="no static equilibrium"):
        constrained_fit(replace(stated, x=soft))


def test_profile_of_an_active_parameter_is_one_sided():
    stated, physics = negative_bearing(), physical_constraints(arm())
    found = constrained_fit(stated, physics)
    interval = profile_fit_interval(stated, found, BEARING_X, physics, 1.0)
    assert interval.lower == 0.0 and interval.ends == ("bound", "crossing")
    # The upper end by its definition: there the objective is 3.84 above the minimum.
    at_end = Constraints((Bounds(BEARING_X, interval.upper, interval.upper),))
    rise = constrained_fit(stated, physics + at_end).objective - found.objective
    assert rise == pytest.approx(3.8415, abs=1e-3)
