"""Parametric bootstrap: linear theory, transformations, seeds and processes, failures, input."""

from functools import partial

import numpy as np
import pytest
from scipy import stats

from elastocal.errors import ElastocalError, InputError, InsufficientDataError
from elastocal.identification import ParametricBootstrap, parametric_bootstrap

B = np.random.default_rng(0).normal(size=(25, 3))
X = np.array([1.0, -2.0, 0.5])


def draw(rng):
    return B @ X + 0.1 * rng.normal(size=len(B))


def fit(y):
    return np.linalg.lstsq(B, y, rcond=None)[0]


def failing(share, y):
    if stats.norm.cdf((y[0] - B[0] @ X) / 0.1) < share:
        raise ElastocalError("no fit")
    return fit(y)


def test_a_linear_fit_has_its_textbook_covariance():
    """Entries of a Wishart matrix of 4000 draws: standard error of a standard deviation is
    1/√8000 = 1.1 %, of a correlation at most 1.6 %; four of them are the limits."""
    found = parametric_bootstrap(draw, fit, draws=4000, seed=1)
    truth = 0.01 * np.linalg.inv(B.T @ B)
    sizes = np.sqrt(np.diag(truth))
    covariance = found.covariance()
    np.testing.assert_allclose(covariance.std, sizes, rtol=0.045)
    gap = (covariance.matrix - truth) / np.outer(sizes, sizes)
    assert np.abs(gap).max() < 0.09
    assert np.isinf(covariance.dof).all()
    # Ends of a 90 % interval: quantiles of 4000 draws, standard error 0.034 std, and as much
    # again twice from the bias correction.
    expected = X[:, None] + stats.norm.ppf(0.95) * sizes[:, None] * [-1, 1]
    assert (np.abs(found.interval(X, 0.9) - expected) < 0.25 * sizes[:, None]).all()


def test_intervals_transform_with_the_parameter():
    """1/x of the draws gives 1/interval, ends exchanged: quantiles of an odd share of draws fall
    on draws only approximately, hence the tolerance."""
    draws = np.exp(np.random.default_rng(2).normal(size=(9999, 1)))
    x = np.array([1.2])
    plain = ParametricBootstrap(draws, 0).interval(x)
    inverse = ParametricBootstrap(1 / draws, 0).interval(1 / x)
    np.testing.assert_allclose(inverse[:, ::-1], 1 / plain, rtol=2e-3)


def test_a_median_bias_is_undone():
    """Draws N(x + d, 1) about x: BC gives N(x − d, 1) quantiles, the exact interval.  Made of
    normal scores, so only interpolation is left."""
    n, d = 19999, 0.3
    draws = (3 + d + stats.norm.ppf((np.arange(n) + 0.5) / n))[:, None]
    low, high = ParametricBootstrap(draws, 0).interval(np.array([3.0]))[0]
    assert low == pytest.approx(3 - d - 1.959964, abs=5e-3)
    assert high == pytest.approx(3 - d + 1.959964, abs=5e-3)


def test_draws_on_one_side_leave_finite_ends():
    draws = np.random.default_rng(3).normal(size=(200, 1))
    for x in (-10.0, 10.0):
        assert np.isfinite(ParametricBootstrap(draws, 0).interval(np.array([x]))).all()


@pytest.mark.parametrize("jobs", [2, 3])
def test_processes_do_not_change_the_draws(jobs):
    task = partial(failing, 0.1)
    one = parametric_bootstrap(draw, task, draws=37, seed=4)
    many = parametric_bootstrap(draw, task, draws=37, seed=4, jobs=jobs)
    np.testing.assert_array_equal(one.draws, many.draws)
    assert one.failures == many.failures > 0
    other = parametric_bootstrap(draw, task, draws=37, seed=5)
    assert not np.array_equal(one.draws[:5], other.draws[:5])


def test_more_draws_begin_with_the_same():
    few = parametric_bootstrap(draw, fit, draws=5, seed=6).draws
    many = parametric_bootstrap(draw, fit, draws=9, seed=6).draws
    np.testing.assert_array_equal(many[:5], few)


def test_failures_are_counted_and_many_are_said():
    some = parametric_bootstrap(draw, partial(failing, 0.02), draws=400, seed=7)
    assert 0 < some.failures < 20 and len(some.draws) + some.failures == 400
    assert "failed to fit" in some.description and "bias" not in some.description
    many = parametric_bootstrap(draw, partial(failing, 0.3), draws=400, seed=7)
    assert "so many failures bias" in many.covariance().description
    infinite = parametric_bootstrap(
        draw, lambda y: np.where(y[0] > y[1], np.nan, fit(y)), draws=50, seed=8
    )
    assert infinite.failures + len(infinite.draws) == 50
    assert np.isfinite(infinite.draws).all()


def test_a_programming_error_is_not_a_failed_draw():
    with pytest.raises(ZeroDivisionError):
        parametric_bootstrap(draw, lambda y: 1 / 0, draws=5)


def test_bad_input_is_told():
    with pytest.raises(InputError, match="at least 2 draws"):
        parametric_bootstrap(draw, fit, draws=1)
    with pytest.raises(InputError, match="jobs"):
        parametric_bootstrap(draw, fit, draws=5, jobs=0)
    with pytest.raises(InsufficientDataError, match="5 of 5 bootstrap fits failed"):
        parametric_bootstrap(draw, partial(failing, 1.1), draws=5)
    found = parametric_bootstrap(draw, fit, draws=30)
    with pytest.raises(InputError, match="at least 40 draws"):
        found.interval(X)
    with pytest.raises(InputError, match="shape"):
        found.interval(X[:2], 0.5)
    with pytest.raises(InputError, match="level"):
        found.interval(X, 1.0)
