"""Gaussian priors: how they are read, and what they refuse."""

import tomllib

import numpy as np
import pytest

from elastocal.errors import InputError
from elastocal.identification.knowledge import GaussianPrior

NAMES = ("joint1.compliance", "joint2.compliance", "link1.x")


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
