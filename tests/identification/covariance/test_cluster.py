"""Cluster-robust covariance: statsmodels, rows in parts, bad input."""

import numpy as np
import pytest
import statsmodels.api as sm

from elastocal.errors import InputError, InsufficientDataError
from elastocal.identification.covariance import cluster_robust, clustered, of_rows, orthogonal

KINDS = ("CR0", "CR1", "CR2", "CR3")


def hc(B, e, kind):
    return of_rows(cluster_robust(B, e, np.arange(len(e)), f"CR{kind[2]}"), len(e), kind)


def residual(B, y):
    return y - B @ np.linalg.lstsq(B, y, rcond=None)[0]


def problem(seed, n=40, p=4, clusters=7):
    """Unequal clusters in no order, with an error common to each."""
    rng = np.random.default_rng(seed)
    cluster = rng.integers(0, clusters, n) * 3 - 5
    cluster[:clusters] = np.arange(clusters) * 3 - 5  # none empty
    B = rng.normal(size=(n, p))
    y = rng.normal(size=n) + rng.normal(size=clusters)[(cluster + 5) // 3]
    return B, residual(B, y), cluster


@pytest.mark.parametrize("kind", ["HC0", "HC1", "HC2", "HC3"])
def test_singleton_clusters_are_rows(kind):
    """HC of statsmodels, with n − p degrees of freedom where leverage is not corrected."""
    B, e, _ = problem(5)
    found = hc(B, e, kind)
    fitted = sm.OLS(B @ np.arange(4.0) + e, B).fit()
    np.testing.assert_allclose(found.matrix, getattr(fitted, f"cov_{kind}"), rtol=1e-8)
    assert (found.dof == 36.0).all() == (kind in ("HC0", "HC1"))


def test_a_row_of_leverage_one_leaves_its_parameter_unbounded():
    B, e, _ = problem(8)
    B = np.column_stack([B, np.eye(len(B))[17]])
    assert hc(B, residual(B, e), "HC2").dof[4] == 0
    with pytest.raises(InsufficientDataError, match=r"row 17 alone .* use HC2"):
        hc(B, residual(B, e), "HC3")


def test_clusters_are_those_of_statsmodels():
    B, e, cluster = problem(7)
    fitted = sm.OLS(B @ np.arange(4.0) + e, B).fit()
    theirs = fitted.get_robustcov_results("cluster", groups=cluster + 5).cov_params()
    np.testing.assert_allclose(cluster_robust(B, e, cluster, "CR1").matrix, theirs, rtol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_rows_may_come_in_parts(kind):
    B, e, cluster = problem(6)
    whole, factors = cluster_robust(B, e, cluster, kind), orthogonal(B)
    some = np.isin(cluster, np.unique(cluster)[:3])
    parts = [(factors.Q[own], e[own], cluster[own]) for own in (some, ~some)]
    found = clustered(parts, factors.V, kind)
    np.testing.assert_allclose(found.matrix, whole.matrix, rtol=1e-9)
    np.testing.assert_allclose(found.dof, whole.dof, rtol=1e-9)


def test_bad_input_is_told():
    B, e, cluster = problem(11)
    with pytest.raises(InsufficientDataError, match="all rows are in one"):
        cluster_robust(B, e, np.zeros(len(B), dtype=int))
    with pytest.raises(InputError, match=r"columns \[\d\] of B depend"):
        cluster_robust(np.column_stack([B, B[:, 0] - B[:, 1]]), e, cluster)
    with pytest.raises(InsufficientDataError, match="no residual"):
        cluster_robust(B[:4], e[:4], cluster[:4])
