"""Gaussian priors: the posterior in closed form, what share is theirs, and how they are read."""

import tomllib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.constrained import solve

from elastocal.errors import ElastocalError, InputError
from elastocal.identification.knowledge import GaussianPrior, non_negative, share_of_prior

NAMES = ("joint1.compliance", "joint2.compliance", "link1.x")
SIZES = np.array([1e-7, 1e-6, 1e-3])
RNG = np.random.default_rng(9)
B = RNG.normal(size=(20, 3)) / SIZES
Y = B @ (SIZES * [1.0, -2.0, 0.5]) + 0.7 * RNG.normal(size=20)
MEAN, STD = SIZES * [1.2, 2.0, 0.4], SIZES * [0.3, 0.2, 0.1]


def test_posterior_is_ridge_regression():
    prior = GaussianPrior.independent(NAMES, MEAN, STD)
    found = solve(B, Y, NAMES, prior=prior, sigma=0.7)
    J = B * SIZES
    H = J.T @ J / 0.7**2 + np.diag((SIZES / STD) ** 2)
    expected = SIZES * np.linalg.solve(H, J.T @ Y / 0.7**2 + SIZES / STD**2 * MEAN)
    np.testing.assert_allclose(found.x, expected, rtol=1e-12)
    posterior = np.linalg.inv(H) * np.outer(SIZES, SIZES)
    np.testing.assert_allclose(0.7**2 * found.cofactor, posterior, rtol=1e-10)
    np.testing.assert_allclose(found.residual, Y - B @ expected, atol=1e-10)


def test_correlated_prior_is_the_augmented_system():
    C = np.outer(STD[:2], STD[:2]) * np.array([[1.0, 0.8], [0.8, 1.0]])
    found = solve(B, Y, NAMES, prior=GaussianPrior(NAMES[:2], MEAN[:2], C))
    precision = np.zeros((3, 3))
    precision[:2, :2] = np.linalg.inv(C)
    J = B * SIZES
    H = J.T @ J + precision * np.outer(SIZES, SIZES)
    rhs = J.T @ Y + SIZES * (precision @ np.append(MEAN[:2], 0.0))
    np.testing.assert_allclose(found.x, SIZES * np.linalg.solve(H, rhs), rtol=1e-11)


def test_the_prior_of_a_parameter_that_no_reading_sees_stays_as_it_is():
    blind = B.copy()
    blind[:, 1] = 0
    wide = STD * [100, 1, 100]
    found = solve(blind, Y, NAMES, prior=GaussianPrior.independent(NAMES, MEAN, wide))
    assert found.x[1] == pytest.approx(MEAN[1], rel=1e-13)
    assert found.cofactor[1, 1] == pytest.approx(STD[1] ** 2, rel=1e-12)
    assert found.prior_share[1] == pytest.approx(1.0, abs=1e-12)


def test_share_of_a_single_parameter_is_its_share_of_the_precision():
    tau, n = 0.5, 8
    prior = GaussianPrior.independent(("k",), [0.0], [tau])
    found = solve(np.ones((n, 1)), np.ones(n), ("k",), prior=prior, sigma=2.0)
    assert found.prior_share[0] == pytest.approx(tau**-2 / (tau**-2 + n / 4), rel=1e-12)


def test_shares_of_data_and_prior_add_up_to_one():
    found = solve(B, Y, NAMES, prior=GaussianPrior.independent(NAMES, MEAN, STD))
    of_data = share_of_prior(found.cofactor, B)
    np.testing.assert_allclose(found.prior_share + of_data, 1.0, rtol=1e-11)
    assert ((found.prior_share > 0) & (found.prior_share < 1)).all()


def test_no_prior_has_no_share_and_a_fixed_value_none_to_share():
    assert (solve(B, Y, NAMES).prior_share == 0).all()
    found = solve(
        B,
        Y,
        NAMES,
        non_negative(*NAMES),
        prior=GaussianPrior.independent(NAMES[:1], [1e-7], [1e-8]),
    )
    assert found.x[1] == 0 and np.isnan(found.prior_share[1])


def test_a_prior_is_read_from_a_table():
    prior = GaussianPrior.from_dict(
        {"joint2.compliance": {"mean": 2.9e-7, "std": 3e-8}, "link1.x": {"mean": 0, "std": 1}}
    )
    assert prior.names == ("joint2.compliance", "link1.x")
    np.testing.assert_array_equal(prior.mean, [2.9e-7, 0.0])
    np.testing.assert_allclose(prior.covariance, np.diag([9e-16, 1.0]))
    P, target = prior.rows(NAMES)
    x = np.array([5.0, 3.2e-7, 0.5])
    assert np.sum((target - P @ x) ** 2) == pytest.approx(1.0 + 0.25)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "empty"),
        ("a = 1.0", "prior.a takes .*; found 1.0"),
        ("a = { mean = 1.0 }", "prior.a.std is missing; it takes a positive number"),
        ("a = { mean = 1.0, sd = 2.0 }", "unknown key prior.a.sd; did you mean std"),
        ("a = { mean = 1.0, std = 0 }", "std takes a positive number in SI units; found 0"),
        ("a = { mean = 1.0, std = inf }", "std takes a positive number in SI units; found inf"),
        ("a = { mean = nan, std = 1.0 }", "mean takes a finite number in SI units; found nan"),
        ("a = { mean = true, std = 1.0 }", "mean takes a finite number in SI units; found true"),
        ("joint2.compliance = { mean = 1.0, std = 1.0 }", r'in quotes: .prior."joint2.compliance"'),
    ],
)
def test_a_wrong_prior_says_where_and_what(text, says):
    with pytest.raises(InputError, match=says):
        GaussianPrior.from_dict(tomllib.loads(text))


@pytest.mark.parametrize(
    ("covariance", "says"),
    [
        (np.array([[1.0, 1.0], [1.0, 1.0]]), "not positive definite"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "not positive definite"),
        (np.diag([1.0, 0.0]), "not positive definite"),
        (np.eye(3), "2 × 2 covariance"),
        (np.diag([1.0, np.nan]), "finite"),
    ],
)
def test_an_impossible_covariance_is_refused(covariance, says):
    with pytest.raises(InputError, match=says):
        GaussianPrior(("a", "b"), np.zeros(2), covariance)


def test_wrong_names_are_named():
    prior = GaussianPrior.independent(("joint2.complianc",), [0.0], [1.0])
    with pytest.raises(InputError, match=r"did you mean 'joint2\.compliance'"):
        solve(B, Y, NAMES, prior=prior)
    with pytest.raises(InputError, match="twice"):
        GaussianPrior.independent(("a", "a"), [0.0, 1.0], [1.0, 1.0])


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=2)
        | st.dictionaries(st.sampled_from(["mean", "std", "x"]), inner, max_size=3)
    ),
    max_leaves=5,
)


@given(st.dictionaries(st.text(max_size=8), JSON, max_size=3))
def test_any_table_is_a_prior_or_an_input_error(table):
    try:
        prior = GaussianPrior.from_dict(table)
    except ElastocalError:
        return
    assert prior.names == tuple(table) and np.isfinite(prior.rows(prior.names)[0]).all()
