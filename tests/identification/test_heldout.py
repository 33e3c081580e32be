"""Held-out residuals in closed form against explicit fits that leave configurations out."""

import numpy as np
import pytest
from scipy import sparse
from support.calibration import (
    GEOMETRY,
    SPRINGS,
    cell_of,
    measured,
    planar_chain,
    random_chain,
    table_at,
    true_values,
)
from support.cells import random_poses

from elastocal.cell.arm_description import CartesianNoise, Nominal, Tracker
from elastocal.identification.identify import identify
from elastocal.identification.least_squares import Problem, fit
from elastocal.identification.options import Options
from elastocal.identification.residuals import held_out_residual, predicts_better
from elastocal.identification.weighted_problem import Weights, weights_for
from elastocal.model.manipulator import Model
from elastocal.model.observations import subset

UNIT = Weights("none", None, False, "")


def weights_of(size, blocks, seed):
    """Correlated within groups of `size` rows, as noise is within a configuration."""
    rng = np.random.default_rng(seed)
    parts = [np.linalg.inv(np.tril(rng.normal(size=(size, size))) + 3 * np.eye(size))
             for _ in range(blocks)]  # fmt: skip
    return Weights("covariance", sparse.csr_array(sparse.block_diag(parts)), True, "")


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("size", [1, 3, 6])
def test_equals_refits_of_a_linear_model(size, weighted):
    """Allen's identity is exact: only rounding separates closed form and refits."""
    rng = np.random.default_rng(size)
    observations = 24 if size > 1 else 60
    # unequal configurations, in no order
    configuration = rng.integers(0, 8, observations)
    B = rng.normal(size=(observations * size, 7)) * 10.0 ** rng.uniform(-3, 3, 7)
    y = rng.normal(size=len(B))
    weights = weights_of(size, observations, 1) if weighted else UNIT
    x = np.linalg.lstsq(weights.apply(B), weights.apply(y), rcond=None)[0]
    held = held_out_residual(B, y - B @ x, weights, configuration, size)
    rows = np.repeat(configuration, size)
    for c in np.unique(configuration):
        # Noise is correlated within observations only, so leaving rows out leaves the rest.
        rest = rows != c
        x_c = np.linalg.lstsq(weights.apply(B)[rest], weights.apply(y)[rest], rcond=None)[0]
        np.testing.assert_allclose(held[~rest], (y - B @ x_c)[~rest], rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("stated", [False, True])
@pytest.mark.parametrize("effects", [GEOMETRY, SPRINGS], ids=["geometry", "springs"])
def test_equals_refits_of_an_arm(effects, stated):
    """An arm is linear over a step of one standard deviation: 1e-3 rad of it bend a metre's arc
    by 1e-6 rad, so 1 % of the noise is a wide limit."""
    sigma = 5e-5
    noise = CartesianNoise(np.array([1.0, 2.0, 0.5]) * sigma) if stated else None
    chain = planar_chain(4) if effects == GEOMETRY else random_chain(5, 3)
    nominal = Nominal(joint_compliance=(2e-5,) * chain.n_joints)
    model = Model.assembled(chain, cell_of(effects, tracker=Tracker(noise=noise), nominal=nominal))
    rng = np.random.default_rng(3)
    truth = true_values(model, rng)
    forces = [[0, 0, 0], [50, 0, -200]]
    table = measured(model, table_at(random_poses(chain, 20, 3), forces), truth, sigma, rng)
    result = identify(model, table, Options(method="wls" if stated else "ols"))
    kept = np.array([model.names.index(name) for name in result.determined])
    observed = result.observations
    sizes = model.sizes(model.regressor(table, result.x).B)
    for c in range(0, 20, 4):
        others = subset(observed, observed.configuration != c)
        weights = weights_for(others, model.cell.tracker)
        problem = Problem(model, others, weights, result.x, kept)
        refit = fit(problem, kept, result.x, sizes)
        mine = np.repeat(observed.configuration == c, 3)
        left_out = (observed.value - model.predict(table, refit.x, observed))[mine]
        np.testing.assert_allclose(result.held_out[mine], left_out, atol=0.01 * sigma)


def test_a_wider_set_is_needed_where_the_parameters_it_adds_are_something():
    """None is found in at most 1 % of tables, one of six standard deviations in most."""
    rng = np.random.default_rng(5)
    configuration = np.repeat(np.arange(20), 2)
    B = rng.normal(size=(120, 8))
    B[:, 7] -= B[:, :6] @ np.linalg.lstsq(B[:, :6], B[:, 7], rcond=None)[0]
    unit = B[:, 7] / np.linalg.norm(B[:, 7])

    def held(y, p):
        x = np.linalg.lstsq(B[:, :p], y, rcond=None)[0]
        return held_out_residual(B[:, :p], y - B[:, :p] @ x, UNIT, configuration, 3)

    def needed(size):
        y = rng.normal(size=120) + size * unit
        return predicts_better(held(y, 6), held(y, 8), UNIT, configuration, 3)

    assert sum(needed(0.0) for _ in range(500)) <= 11  # 5 expected at most; p < 0.01 of more
    assert sum(needed(6.0) for _ in range(50)) > 35


def test_infinite_where_one_configuration_alone_determines_a_parameter():
    rng = np.random.default_rng(0)
    B = rng.normal(size=(30, 4))
    configuration = np.repeat(np.arange(5), 2)
    only = np.repeat(configuration, 3) == 2
    B[~only, 3] = 0.0
    y = rng.normal(size=30)
    x = np.linalg.lstsq(B, y, rcond=None)[0]
    held = held_out_residual(B, y - B @ x, UNIT, configuration, 3)
    assert np.isinf(held[only]).all()
    assert np.isfinite(held[~only]).all()
    for c in (0, 1, 3, 4):
        rest = np.repeat(configuration, 3) != c
        x_c = np.linalg.lstsq(B[rest], y[rest], rcond=None)[0]
        np.testing.assert_allclose(held[~rest], (y - B @ x_c)[~rest], rtol=1e-9, atol=1e-12)


def test_a_level_measured_once_has_no_held_out_residual():
    """Joint 2's compliance at a level that only one configuration visits."""
    chain = planar_chain()
    levels = {"joint2": (-0.5, 0.7)}
    nominal = Nominal(joint_compliance=(1e-5,) * 3)
    effects = ("base_frame", "joint_compliance")
    model = Model.assembled(chain, cell_of(effects, compliance_levels=levels, nominal=nominal))
    q = random_poses(chain, 12, 1)
    q[:, 1] = -0.5
    q[4, 1] = 0.7
    rng = np.random.default_rng(1)
    table = table_at(q, [[0, 0, 0], [0, 0, -300]])
    truth = true_values(model, rng)
    result = identify(model, measured(model, table, truth, 2e-5, rng))
    assert "joint2.compliance_level2" in result.determined
    alone = np.repeat(table.configuration == 4, 3)
    assert np.isinf(result.held_out[alone]).all() and np.isfinite(result.held_out[~alone]).all()
    assert np.isinf(result.heldout_rms)
    assert any("Some configuration alone determines" in w for w in result.warnings)
    assert result.to_json()["heldout_rms_um"] is None
