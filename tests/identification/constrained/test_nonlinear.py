"""Constrained fits of a whole arm: the KR 270 at the poses of Table 2, nonlinear equilibrium."""

from functools import lru_cache

import numpy as np
import pytest
from scipy import sparse
from support.calibration import measured, with_values
from support.cells import SLANTED, TABLE_2, kr270_cell, table_of
from support.constrained import NONE, non_negative

from elastocal.identification.knowledge import (
    Bounds,
    Constraints,
    SemidefiniteMatrix,
    physical_constraints,
)
from elastocal.identification.least_squares import KnownFit, PriorRows, Problem, fit, profile_end
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


def problem(seed: int, **values: float) -> tuple:
    """Readings of the arm with stiff bearings unless `values` say otherwise, start at nominal."""
    model = arm()
    truth = with_values(model, {"joint3.compliance": 5e-7} | values)
    rng = np.random.default_rng(seed)
    table = measured(model, table_of(TABLE_2, SLANTED, both=True), truth, SIGMA / 2**0.5, rng)
    observed = observe(table, "deflection")
    whiten = sparse.csr_array(sparse.eye_array(len(observed.value)) / SIGMA)
    sizes = model.sizes(model.regressor(table, model.nominal, None, observed).B)
    columns = np.arange(len(model.names))
    weights = Weights("axis", whiten, True, "")
    problem = Problem(model, observed, weights, model.nominal, columns)
    return problem, columns, model.nominal, sizes


def fitted(stated: tuple, constraints: Constraints = NONE, prior=None) -> KnownFit:
    problem, columns, x, _ = stated
    known = PriorRows.stated(problem.model.names, columns, x, constraints, prior, 1.0)
    return KnownFit(fit(*stated, known=known), known, 1.0)


@lru_cache
def negative_bearing() -> tuple:
    """A problem whose unconstrained estimate of BEARING_X is negative."""
    found = problem(0)
    assert fit(*found).x[arm().names.index(BEARING_X)] < 0
    return found


def test_a_multiplier_is_the_price_of_its_bound_in_the_nonlinear_problem():
    stated = negative_bearing()
    (active,) = fitted(stated, non_negative(BEARING_X)).best.active
    step = 1e-10
    up, down = (
        fitted(stated, Constraints((Bounds(BEARING_X, lower=s * step),))).objective for s in (1, -1)
    )
    assert active.multiplier == pytest.approx((up - down) / (2 * step), rel=1e-3)


def test_a_coupled_matrix_binds_and_the_fit_stays_inside():
    # Bearing compliances as a matrix with a known coupling: x·y ≥ coupling² keeps both positive.
    stated = negative_bearing()
    coupling = 2e-8
    K = SemidefiniteMatrix("bearing", ((BEARING_X, coupling), (coupling, BEARING_Y)))
    found = fitted(stated, Constraints(matrices=(K,)))
    x, y = (found.fit.x[arm().names.index(n)] for n in (BEARING_X, BEARING_Y))
    assert x > 0 and y > 0
    assert x * y == pytest.approx(coupling**2, rel=1e-6)
    assert found.fit.converged
    free = fit(*stated)
    assert found.objective > free.whitened @ free.whitened


def test_an_infeasible_start_is_moved_inside():
    stated = negative_bearing()
    problem, columns, x, sizes = stated
    start = x.copy()
    start[arm().names.index(BEARING_X)] = -3e-7
    found = fitted((problem, columns, start, sizes), physical_constraints(arm()))
    expected = fitted(stated, physical_constraints(arm()))
    np.testing.assert_allclose(found.fit.x, expected.fit.x, rtol=1e-8, atol=1e-16)


@pytest.mark.parametrize("name", [BEARING_X, "joint3.compliance"])
def test_ends_of_a_profile_are_where_the_objective_has_risen_as_far_as_allowed(name):
    stated, physics = negative_bearing(), physical_constraints(arm())
    found, i = fitted(stated, physics), arm().names.index(name)
    for side in (-1, 1):
        end = profile_end(found, i, 3.84, side)
        if name == BEARING_X and side < 0:
            assert end == 0
            continue
        assert side * (end - found.fit.x[i]) > 0
        at_end = Constraints((Bounds(name, end, end),))
        rise = fitted(stated, physics + at_end).objective - found.objective
        assert rise == pytest.approx(3.84, abs=1e-5)
