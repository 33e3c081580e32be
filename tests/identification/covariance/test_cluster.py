"""Cluster-robust covariance: dense algebra, statsmodels, unbiasedness, coverage, bad input."""

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


def dense(B, cluster, kind):
    """Per cluster the matrix A_c, and I − H, from n × n matrices and an explicit inverse."""
    H = B @ np.linalg.inv(B.T @ B) @ B.T
    A = {}
    for c in np.unique(cluster):
        rows = np.flatnonzero(cluster == c)
        gap = np.eye(len(rows)) - H[np.ix_(rows, rows)]
        values, vectors = np.linalg.eigh(gap)
        power = {"CR0": 0.0, "CR1": 0.0, "CR2": -0.5, "CR3": -1.0}[kind]
        scaled = [v**power if v > 1e-8 or power == 0 else 0.0 for v in values]
        A[c] = vectors @ np.diag(scaled) @ vectors.T
    return A, np.eye(len(B)) - H


def dense_weights(B, cluster, kind):
    """G (p, n, clusters) with v_j = Σ_c (G_jcᵀ u)², for errors u."""
    A, M = dense(B, cluster, kind)
    bread = np.linalg.inv(B.T @ B)
    columns = [
        M[:, cluster == c] @ A[c] @ B[cluster == c] @ bread for c in np.unique(cluster)
    ]  # (n, p) each
    return np.array(columns).transpose(2, 1, 0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(2))
def test_equals_dense_algebra(kind, seed):
    """Variance and dof from n × n matrices, clusters smaller and larger than p."""
    B, e, cluster = problem(seed, n=24 if seed % 2 else 60, p=4, clusters=8)
    G = dense_weights(B, cluster, kind)
    found = cluster_robust(B, e, cluster, kind)
    n, p = B.shape
    factor = 8 / 7 * (n - 1) / (n - p) if kind == "CR1" else 1.0
    for j in range(p):
        gamma = G[j].T @ G[j]
        dof = np.trace(gamma) ** 2 / np.sum(gamma**2)
        np.testing.assert_allclose(found.dof[j], dof, rtol=1e-9)
        variance = factor * np.sum((G[j].T @ e) ** 2)
        np.testing.assert_allclose(found.matrix[j, j], variance, rtol=1e-9)


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


def test_intervals_cover_with_correlated_clusters_of_unequal_spread():
    """2000 data sets, clusters of 6 rows with a common error and a spread that grows threefold
    with the regressor.  A right interval misses 5 %; three binomial standard deviations of 2000
    are 1.5 %, and Satterthwaite's approximation costs up to 2 % more where few clusters matter.
    Intervals of independent rows must fail, or the data would test nothing."""
    rng, clusters = np.random.default_rng(20), 10
    cluster = np.repeat(np.arange(clusters), 6)
    level = rng.normal(size=clusters)
    B = np.column_stack([np.ones(len(cluster)), level[cluster], rng.normal(size=len(cluster))])
    spread = 0.5 + np.abs(level) / np.abs(level).max()
    Q, R = np.linalg.qr(B)
    missed, naive = np.zeros(3), np.zeros(3)
    for _ in range(2000):
        u = spread[cluster] * (rng.normal(size=clusters)[cluster] + rng.normal(size=len(cluster)))
        x = np.linalg.solve(R, Q.T @ u)
        e = u - B @ x
        low, high = cluster_robust(B, e, cluster).interval(x).T
        missed += (low > 0) | (high < 0)
        low, high = hc(B, e, "HC3").interval(x).T
        naive += (low > 0) | (high < 0)
    assert (missed / 2000 < 0.085).all() and (missed / 2000 > 0.02).all()
    assert (naive[:2] / 2000 > 0.15).all()
