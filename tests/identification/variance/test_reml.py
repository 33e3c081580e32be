"""REML against statsmodels' MixedLM, and what a maximum must satisfy."""

import warnings

import numpy as np
import pandas as pd
import pytest
import statsmodels.formula.api as smf
from identification.variance.dense import Table, readings
from scipy import optimize
from statsmodels.regression.mixed_linear_model import MixedLMParams

from elastocal.identification.noise_structure import (
    STRUCTURES,
    independent,
    shared_effects,
)
from elastocal.identification.reml import evaluate, reml, stacks


def mixed_lm(r, **effects):
    """statsmodels' model and REML fit on the long table: one row per component of a reading."""
    n, size = r.e.shape
    frame = pd.DataFrame(r.B.reshape(n * size, -1), columns=[f"b{k}" for k in range(4)])
    frame["e"] = r.e.ravel()
    component = np.tile(np.arange(size), n)
    frame["group"] = np.repeat(r.configuration, size) * size + component
    frame["marker"] = np.repeat(r.marker, size)
    model = smf.mixedlm("e ~ b0 + b1 + b2 + b3 - 1", frame, groups="group", **effects)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # statsmodels on its own optimisers
        # Its default, L-BFGS, runs into the bound on some of these tables.
        return model, model.fit(reml=True, method="powell", xtol=1e-12, ftol=1e-14)


@pytest.mark.parametrize("unbalanced", [False, True])
@pytest.mark.parametrize("size", [1, 3])
def test_random_intercept_equals_mixed_lm(size, unbalanced):
    table = Table(size=size, configurations=12, markers=2, repeats=4, unbalanced=unbalanced)
    r = readings(table, 2, noise=1.0, shared=0.8)
    structure = independent(r)
    effects = [e for e in shared_effects(structure.sets, size) if e.by == ("configuration",)]
    found = reml(structure, tuple(effects))
    assert found.converged
    model, theirs = mixed_lm(r)
    assert found.log_likelihood >= theirs.llf - 1e-12 * abs(theirs.llf)
    assert found.log_likelihood == pytest.approx(theirs.llf, rel=1e-10)
    np.testing.assert_allclose(found.state.x, theirs.fe_params, rtol=1e-6)
    variances = [theirs.scale, theirs.cov_re.iloc[0, 0]]
    np.testing.assert_allclose(found.state.theta, variances, rtol=1e-4)
    # An optimiser on values of ℓ leaves θ to half of the digits; their score at ours is exact.
    ratio = found.state.theta[1:, None] / found.state.theta[0]
    at_ours = MixedLMParams.from_components(fe_params=found.state.x, cov_re=ratio)
    assert model.loglike(at_ours) == pytest.approx(found.log_likelihood, rel=1e-12)
    score = model.score(at_ours, profile_fe=True)
    assert abs(score[-1] * ratio[0, 0]) < 1e-7
    off = MixedLMParams.from_components(fe_params=found.state.x, cov_re=ratio * (1 + 1e-6))
    assert abs(model.score(off, profile_fe=True)[-1] * ratio[0, 0]) > 1e-6


@pytest.mark.parametrize("unbalanced", [False, True])
def test_two_nested_effects_equal_mixed_lm(unbalanced):
    """Configuration, and marker within configuration, repeats left over."""
    table = Table(size=1, configurations=14, markers=4, repeats=4, unbalanced=unbalanced)
    r = readings(table, 4, noise=1.0, shared=0.8)
    rng = np.random.default_rng(0)
    r = r.moved(r.e + 0.7 * rng.normal(size=(14, 4))[r.configuration, r.marker][:, None])
    structure = independent(r)
    effects = shared_effects(structure.sets, 1)
    assert [e.by for e in effects] == [("configuration",), ("configuration", "marker")]
    found = reml(structure, effects)
    _, theirs = mixed_lm(r, re_formula="1", vc_formula={"marker": "0 + C(marker)"})
    variances = np.array([theirs.scale, theirs.cov_re.iloc[0, 0], theirs.vcomp[0]])
    assert found.log_likelihood >= theirs.llf - 1e-12 * abs(theirs.llf)
    np.testing.assert_allclose(found.state.theta, variances, rtol=1e-3)
    at_theirs = evaluate(structure, stacks(structure, effects), variances)
    assert at_theirs.log_likelihood == pytest.approx(theirs.llf, rel=1e-11)
    np.testing.assert_allclose(at_theirs.x, theirs.fe_params, rtol=1e-8)


CASES = [
    ("independent", Table(size=1, configurations=10, markers=3)),
    ("axis", Table(configurations=8)),
    ("marker", Table(configurations=8, markers=3)),
    ("polar", Table(configurations=10, markers=3)),
    ("stated", Table(configurations=8)),
    ("axis", Table(size=6, configurations=8, markers=1, repeats=4)),
]


@pytest.mark.parametrize(("name", "table"), CASES)
def test_no_optimiser_finds_a_higher_likelihood(name, table):
    """Nelder–Mead in log θ from the optimum stays there: θ to 1e-6, ℓ to rounding."""
    r = readings(table, 6, noise=1.0, shared=1.0)
    structure = STRUCTURES[name](r)
    effects = shared_effects(structure.sets, r.size)
    found = reml(structure, effects)
    assert found.converged
    free = found.state.theta > 1e-6 * found.state.theta.max()
    stacked = stacks(structure, effects)

    def minus(log):
        theta = np.zeros(len(free))
        theta[free] = np.exp(log)
        return -evaluate(structure, stacked, theta).log_likelihood

    log = np.log(found.state.theta[free])
    better = optimize.minimize(
        minus, log + 0.01, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12}
    )
    assert -better.fun <= found.log_likelihood + 1e-8
    np.testing.assert_allclose(better.x, log, atol=1e-4)
