"""Kenward–Roger covariance and degrees of freedom: textbook formulas and published figures."""

import numpy as np
import pytest
from identification.variance.dense import Table, dense, readings

from elastocal.identification.covariance import Covariance
from elastocal.identification.noise_choice import estimate_noise
from elastocal.identification.noise_structure import (
    STRUCTURES,
    Readings,
    independent,
    shared_effects,
)
from elastocal.identification.reml import kenward_roger, reml

# Yates 1935, as nlme::Oats of R orders it: blocks I to VI; Victory, Golden Rain, Marvellous;
# nitrogen 0, 0.2, 0.4, 0.6.
OATS = """
111 130 157 174 117 114 161 141 105 140 118 156  61  91  97 100  70 108 126 149  96 124 121 144
 68  64 112  86  60 102  89  96  89 129 132 124  74  89  81 122  64 103 132 133  70  89 104 117
 62  90 100 116  80  82  94 126  63  70 109  99  53  74 118 113  89  82  86 104  97  99 119 121
"""


@pytest.fixture(scope="module")
def oats():
    """yield ~ Variety + factor(nitro) + (1|Block/Variety) without nine of the plots.

    Columns: one per nitrogen level, and varieties as deviations, so that the first four
    parameters are the marginal means of the nitrogen levels.
    """
    block, variety, nitro = np.indices((6, 3, 4)).reshape(3, -1)
    left_out = np.array([1, 2, 3, 5, 8, 13, 21, 34, 55]) - 1
    kept = np.setdiff1d(np.arange(72), left_out)
    deviation = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]])
    B = np.hstack([np.eye(4)[nitro], deviation[variety]])[kept]
    e = np.array(OATS.split(), dtype=float)[kept]
    r = Readings(B[:, None, :], e[:, None], block[kept], nitro[kept], variety[kept])
    structure = independent(r)
    wanted = (("configuration",), ("configuration", "marker"))
    effects = tuple(e for e in shared_effects(structure.sets, 1) if e.by in wanted)
    assert len(effects) == 2
    return reml(structure, effects)


def test_marginal_means_of_oats_as_printed(oats):
    """emmeans(Oats.lmer, "nitro"): vignette "sophisticated" of the R package emmeans (Lenth),
    CRAN snapshot of 2018-02-25, computed by pbkrtest from an lmer fit."""
    covariance, dof = kenward_roger(oats)
    printed = np.array(
        [
            # emmean, SE, lower, upper
            [78.89207, 7.294379, 61.98930, 95.79484],
            [97.03425, 7.136271, 80.25029, 113.81822],
            [114.19816, 7.136186, 97.41454, 130.98179],
            [124.06857, 7.070235, 107.32795, 140.80919],
        ]
    )
    # lmer stops where its deviance settles: five digits of its variances agree, seven do not.
    np.testing.assert_allclose(oats.state.x[:4], printed[:, 0], rtol=1e-6)
    found = Covariance("", covariance, dof, "")
    np.testing.assert_allclose(found.std[:4], printed[:, 1], rtol=2e-5)
    np.testing.assert_allclose(dof[:4], [7.78, 7.19, 7.19, 6.95], atol=0.0051)
    interval = found.interval(oats.state.x)[:4]
    np.testing.assert_allclose(interval, printed[:, 2:], rtol=5e-5)


CASES = [
    ("independent", Table()),
    ("axis", Table(unbalanced=False)),
    ("axis", Table(size=6, configurations=5, markers=1, repeats=4)),
    ("marker", Table(markers=3)),
    ("polar", Table()),
    ("stated", Table()),
    ("independent", Table(size=1, configurations=8, markers=3)),
]


@pytest.mark.parametrize("share", [False, True], ids=["alone", "shared"])
@pytest.mark.parametrize(("name", "table"), CASES)
def test_textbook_formula(name, table, share):
    r = readings(table, 3, shared=2e-5)
    structure = STRUCTURES[name](r)
    fit = reml(structure, shared_effects(structure.sets, r.size, share))
    covariance, dof = kenward_roger(fit)
    shared = [e.name for e in fit.shared]
    whole = dense(name, r, structure.names, shared, fit.state.theta)
    # At its bound a variance counts as known.
    free = np.concatenate([fit.own > 1e-9 * fit.own.max(), fit.common > 0])
    W = np.zeros_like(whole.information)
    W[np.ix_(free, free)] = np.linalg.inv(whole.information[np.ix_(free, free)])
    expected, expected_dof = whole.kenward_roger(W)
    np.testing.assert_allclose(covariance, expected, rtol=1e-6, atol=1e-8 * expected.max())
    np.testing.assert_allclose(dof, expected_dof, rtol=1e-6)


@pytest.mark.parametrize("size", [1, 3])
def test_one_variance_without_shared_effects_is_least_squares(size):
    """Φ_A = s² (BᵀB)⁻¹ with t on rows − p degrees of freedom, exactly."""
    r = readings(Table(size=size, configurations=9, markers=2), 0)
    B, e = r.B.reshape(-1, 4), r.e.ravel()
    x, rss = np.linalg.lstsq(B, e)[:2]
    found = estimate_noise(r, "independent")
    np.testing.assert_allclose(found.x, x, rtol=1e-9)
    dof = len(e) - 4
    expected = rss[0] / dof * np.linalg.inv(B.T @ B)
    np.testing.assert_allclose(found.covariance.matrix, expected, rtol=1e-8)
    np.testing.assert_allclose(found.covariance.dof, dof, rtol=1e-8)
    assert found.fit.own[0] == pytest.approx(rss[0] / dof, rel=1e-8)


def test_variances_that_do_not_matter_leave_the_covariance_alone():
    """Each parameter seen by one axis only: x, y, z are three separate regressions."""
    rng = np.random.default_rng(8)
    n = 60
    B = np.zeros((n, 3, 6))
    for axis in range(3):
        B[:, axis, 2 * axis : 2 * axis + 2] = rng.normal(size=(n, 2))
    e = rng.normal(size=(n, 3)) * [1e-5, 3e-5, 9e-5]
    zeros = np.zeros(n, dtype=int)
    found = estimate_noise(Readings(B, e, np.arange(n), zeros, zeros), "axis")
    for axis in range(3):
        b = B[:, axis, 2 * axis : 2 * axis + 2]
        x, rss = np.linalg.lstsq(b, e[:, axis])[:2]
        here = slice(2 * axis, 2 * axis + 2)
        np.testing.assert_allclose(found.x[here], x, rtol=1e-7)
        expected = rss[0] / (n - 2) * np.linalg.inv(b.T @ b)
        np.testing.assert_allclose(found.covariance.matrix[here, here], expected, rtol=1e-6)
        np.testing.assert_allclose(found.covariance.dof[here], n - 2, rtol=1e-6)
