"""The mixed model against dense matrices, statsmodels, and published Kenward–Roger figures."""

import warnings
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import statsmodels.formula.api as smf
from engine.dense import Table, dense, readings

from elastocal.engine import Expected, LogPrior, MixedFit
from elastocal.identification.least_squares import Covariance
from elastocal.identification.noise_choice import NoisyReadings, fitted, prior_of_groups
from elastocal.identification.noise_structure import STRUCTURES, Kind, Readings

TABLES = {
    "size 1": Table(size=1, configurations=5, markers=3, repeats=3, p=3),
    "size 3": Table(),
    "size 6": Table(size=6, configurations=4, markers=1, repeats=3, p=5),
    "loads": Table(configurations=4, loads=2, markers=2, repeats=3, p=5),
    "no repeats": Table(markers=3, repeats=1, unbalanced=False),
    "unlike": Table(configurations=3, markers=9, repeats=2),
}
# Every table with half of the structures in turn, half of them with what visits share.
CASES = [
    (table, name, bool(i % 2))
    for i, table in enumerate(TABLES)
    for j, name in enumerate(STRUCTURES)
    if (i + j) % 2 == 0 and (TABLES[table].size == 3 or name not in ("marker", "polar"))
]


@pytest.mark.parametrize(("table", "name", "share"), CASES)
def test_likelihood_slope_and_information_are_those_of_all_rows(table, name, share):
    r = readings(TABLES[table], 10)
    noisy = NoisyReadings(r, Kind(name, ("configuration",) * share))
    rng, own = np.random.default_rng(11), noisy.own
    theta = np.exp(rng.normal(size=len(noisy.names))) * 1e-10
    theta[:own] *= 1e10 if name == "stated" else 1.0
    whole = dense(name, r, noisy.structure.names, [d.name for d in noisy.deviations], theta)
    model = noisy.model()
    value, slope, information = model.objective(np.log(theta))
    assert -value / 2 == pytest.approx(whole.log_likelihood, rel=1e-10)
    size = theta * np.sqrt(np.diag(whole.information))
    np.testing.assert_allclose(slope / size, -2 * theta * whole.score / size, rtol=1e-7, atol=1e-7)
    # The average of observed and expected curvature.
    average = np.outer(theta, theta) * (whole.observed + whole.information)
    np.testing.assert_allclose(information, average, rtol=1e-6, atol=1e-6 * np.abs(average).max())
    at = Expected(model.state(theta))
    scale = np.sqrt(np.diag(whole.information))
    shape = np.outer(scale, scale)
    np.testing.assert_allclose(at.information / shape, whole.information / shape, atol=1e-8)
    assert (np.diag(at.information) > 1e-9 * at.known).all()
    W = np.linalg.inv(whole.information + np.diag(scale**2))
    found, dof = at.kenward_roger(W, np.eye(len(at.Phi)))
    covariance, theirs = whole.kenward_roger(W)
    np.testing.assert_allclose(found, covariance, rtol=1e-6, atol=1e-8 * covariance.max())
    np.testing.assert_allclose(dof, theirs, rtol=1e-6)


NESTED = Kind("independent", ("configuration",))
NAMES = ["common to each configuration", "common to each configuration and marker"]


def mixed_lm(r, **effects):
    """statsmodels' REML fit on the long table: one row per component of a reading."""
    n, size = r.e.shape
    frame = pd.DataFrame(r.B.reshape(n * size, -1), columns=[f"b{k}" for k in range(4)])
    frame["e"] = r.e.ravel()
    frame["group"] = np.repeat(r.configuration, size) * size + np.tile(np.arange(size), n)
    frame["marker"] = np.repeat(r.marker, size)
    model = smf.mixedlm("e ~ b0 + b1 + b2 + b3 - 1", frame, groups="group", **effects)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # statsmodels on its own optimisers
        return model.fit(reml=True, method="powell", xtol=1e-12, ftol=1e-14)


@pytest.mark.parametrize("unbalanced", [False, True])
def test_nested_effects_equal_statsmodels(unbalanced):
    """Configuration, and marker within configuration, repeats left over."""
    table = Table(size=1, configurations=14, markers=4, repeats=4, unbalanced=unbalanced)
    r = readings(table, 4, noise=1.0, shared=0.8)
    rng = np.random.default_rng(0)
    r = replace(r, e=r.e + 0.7 * rng.normal(size=(14, 4))[r.configuration, r.marker][:, None])
    found = fitted(r, NESTED)
    assert [d.name for d, _ in found.found] == NAMES
    theirs = mixed_lm(r, re_formula="1", vc_formula={"marker": "0 + C(marker)"})
    assert found.log_likelihood >= theirs.llf - 1e-9 * abs(theirs.llf)
    variances = [theirs.scale, theirs.cov_re.iloc[0, 0], theirs.vcomp[0]]
    np.testing.assert_allclose(found.theta, variances, rtol=1e-3)
    np.testing.assert_allclose(found.state.x, theirs.fe_params, rtol=2e-4)


# Yates 1935, as nlme::Oats of R orders it: blocks I to VI; Victory, Golden Rain, Marvellous;
# nitrogen 0, 0.2, 0.4, 0.6.
OATS = """
111 130 157 174 117 114 161 141 105 140 118 156  61  91  97 100  70 108 126 149  96 124 121 144
 68  64 112  86  60 102  89  96  89 129 132 124  74  89  81 122  64 103 132 133  70  89 104 117
 62  90 100 116  80  82  94 126  63  70 109  99  53  74 118 113  89  82  86 104  97  99 119 121
"""


def test_marginal_means_of_oats_as_printed():
    """emmeans(Oats.lmer, "nitro") of yield ~ Variety + factor(nitro) + (1|Block/Variety) without
    nine of the plots: vignette "sophisticated" of the R package emmeans (Lenth), CRAN snapshot of
    2018-02-25, computed by pbkrtest from an lmer fit.

    Columns: one per nitrogen level, and varieties as deviations, so that the first four parameters
    are the marginal means of the nitrogen levels.
    """
    block, variety, nitro = np.indices((6, 3, 4)).reshape(3, -1)
    kept = np.setdiff1d(np.arange(72), np.array([1, 2, 3, 5, 8, 13, 21, 34, 55]) - 1)
    deviation = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]])
    B = np.hstack([np.eye(4)[nitro], deviation[variety]])[kept]
    e = np.array(OATS.split(), dtype=float)[kept]
    r = Readings(B[:, None, :], e[:, None], block[kept], nitro[kept], variety[kept])
    noisy = NoisyReadings(r, NESTED)
    noisy.deviations = [d for d in noisy.deviations if "load" not in d.name]
    assert [d.name for d in noisy.deviations] == NAMES
    found = MixedFit(noisy.model(), noisy.start(), (1, 2))
    covariance, dof = found.expected.kenward_roger(found.covariance, np.eye(6))
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
    x = found.state.x
    np.testing.assert_allclose(x[:4], printed[:, 0], rtol=1e-5)
    result = Covariance("", covariance, dof, "")
    np.testing.assert_allclose(result.std[:4], printed[:, 1], rtol=1e-4)
    np.testing.assert_allclose(dof[:4], [7.78, 7.19, 7.19, 6.95], atol=0.0055)
    np.testing.assert_allclose(result.interval(x)[:4], printed[:, 2:], rtol=2e-4)


# Many variances with a prior.

MEAN = 2 * np.log([1e-5, 2e-5, 6e-5])


def groups(configurations, each, omega_u, omega_v, seed, p=2):
    """Readings in many groups, log θ = μ_a + u_c + v_ca; log θ (configurations, 3)."""
    rng = np.random.default_rng(seed)
    log = MEAN + np.sqrt(omega_u) * rng.normal(size=(configurations, 1))
    log = log + np.sqrt(omega_v) * rng.normal(size=(configurations, 3))
    c = np.repeat(np.arange(configurations), each)
    e = np.exp(log[c] / 2) * rng.normal(size=(len(c), 3))
    marker = np.tile(np.arange(each), configurations)
    return Readings(rng.normal(size=(len(c), 3, p)), e, c, 0 * c, marker), log


def test_shrunk_variances_are_nearer_the_truth_and_their_likelihood_is_an_integral():
    """Mean square error of log θ on 18 groups of 6 readings: less than half of the plain one."""
    shrunk, plain = 0.0, 0.0
    for seed in range(10):
        r, log = groups(15, 6, 0.2, 0.1, seed)
        noisy = NoisyReadings(r, Kind("groups"))
        prior = prior_of_groups(noisy)
        start = np.exp(prior.mean)
        each = [MixedFit(noisy.model(p), start) for p in (prior, None)]
        shrunk += ((np.log(each[0].theta) - log.ravel()) ** 2).mean()
        plain += ((np.log(each[1].theta) - log.ravel()) ** 2).mean()
    assert shrunk < 0.5 * plain
    # One log variance unknown, the others fixed by a narrow prior: quadrature against Laplace.
    noisy = NoisyReadings(groups(4, 12, 0.0, 0.0, 1)[0], Kind("groups"))
    mean, precision = np.tile(MEAN, 4), np.diag(np.full(12, 1e8))
    precision[0, 0] = 1 / 0.5
    found = MixedFit(noisy.model(LogPrior(mean, precision)), np.exp(mean))
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    at = [np.exp(mean + np.sqrt(0.5) * z * (np.arange(12) == 0)) for z in nodes]
    values = np.array([-0.5 * noisy.model().state(theta).value for theta in at])
    integral = values.max() + np.log(weights @ np.exp(values - values.max()) / np.sqrt(2 * np.pi))
    # Laplace with the expected curvature of 11 degrees of freedom is off by a few hundredths.
    assert found.log_likelihood == pytest.approx(integral, abs=0.1)
