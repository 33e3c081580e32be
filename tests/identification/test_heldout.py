"""Held-out residuals in closed form against explicit fits that leave configurations out."""

import numpy as np
import pytest
from scipy import sparse
from support.calibration import cell_of, measured, planar_chain, table_at, true_values
from support.cells import random_poses

from elastocal.cell_tables import Nominal
from elastocal.identification.identify import Options, identify
from elastocal.identification.least_squares import (
    held_out_residual,
    predicts_better,
    rms_3d,
    share_left,
)
from elastocal.identification.weighted_problem import Weights
from elastocal.model.manipulator import Model

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
    configuration = rng.integers(0, 8, observations)  # unequal ones, in no order
    B = rng.normal(size=(observations * size, 7)) * 10.0 ** rng.uniform(-3, 3, 7)
    y = rng.normal(size=len(B))
    weights = weights_of(size, observations, 1) if weighted else UNIT
    x = np.linalg.lstsq(weights.apply(B), weights.apply(y), rcond=None)[0]
    held = held_out_residual(B, y - B @ x, weights, configuration, size)
    rows, W = np.repeat(configuration, size), weights.apply(B)
    left = share_left(np.linalg.qr(W)[0], rows)
    for c in np.unique(configuration):
        rest = rows != c  # noise is correlated within observations only
        with_c, without = (np.linalg.qr(some, mode="r") for some in (W, W[rest]))
        ratio = [((W[~rest] @ np.linalg.inv(R)) ** 2).sum(axis=1) for R in (with_c, without)]
        np.testing.assert_allclose(left[~rest], ratio[0] / ratio[1], rtol=1e-6)
        x_c = np.linalg.lstsq(weights.apply(B)[rest], weights.apply(y)[rest], rcond=None)[0]
        np.testing.assert_allclose(held[~rest], (y - B @ x_c)[~rest], rtol=1e-9, atol=1e-10)


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


def of_one_angle(effects, apart, forces, kind="auto", **given):
    """An arm whose joint 2 stands at one angle, `apart` rad about it, but in pose 4."""
    chain, rng = planar_chain(), np.random.default_rng(1)
    model = Model.assembled(chain, cell_of(effects, **given))
    q = random_poses(chain, 12, 1)
    q[:, 1] = -0.5 + apart * rng.normal(size=12)
    q[4, 1] = 0.7
    table, truth = table_at(q, forces), true_values(model, rng)
    result = identify(model, measured(model, table, truth, 2e-5, rng), Options(intervals=kind))
    return result, np.repeat(table.configuration == 4, 3)


def test_a_level_measured_once_has_no_held_out_residual():
    """Joint 2's compliance at a level that only one configuration visits."""
    given = {"compliance_levels": {"joint2": (-0.5, 0.7)}, "forces": [[0, 0, 0], [0, 0, -300]]}
    given |= {"nominal": Nominal(joint_compliance=(1e-5,) * 3), "apart": 0.0}
    result, alone = of_one_angle(("base_frame", "joint_compliance"), **given)
    assert "joint2.compliance_level2" in result.determined
    assert np.isinf(result.held_out[alone]).all() and np.isfinite(result.held_out[~alone]).all()
    assert result.heldout_rms == pytest.approx(rms_3d(result.held_out[~alone], 3))
    assert any("Some configuration alone determines" in w for w in result.warnings)
    known = of_one_angle(("base_frame", "joint_compliance"), kind="cr2", **given)[0]
    assert known["joint2.compliance_level2"].value is not None and known.predicted is None


def test_a_pose_that_hardly_any_other_replaces_is_predicted_with_typical_sizes():
    """Of joint 2 at one angle the others tell the links' directions to metres."""
    result, alone = of_one_angle(("base_frame", "link_geometry"), 1e-4, [[0, 0, 0]])
    assert 2e-5 < np.linalg.norm(result.held_out[alone]) < 5e-3
    assert result.heldout_rms < result.nominal_rms
