"""Cluster-robust covariance: dense algebra, statsmodels, unbiasedness, coverage, bad input."""

import numpy as np
import pytest
import statsmodels.api as sm
from hypothesis import given, settings
from hypothesis import strategies as st
from statsmodels.stats.sandwich_covariance import cov_cluster

from elastocal.errors import InputError, InsufficientDataError
from elastocal.identification.covariance import cluster_robust, hc

KINDS = ("CR0", "CR1", "CR2", "CR3")


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


@pytest.mark.parametrize("seed", range(1))
def test_cr2_is_unbiased_under_the_working_model(seed):
    """E v_j = σ² tr(G_jᵀG_j) = σ² (BᵀB)⁻¹_jj exactly, v_j = Σ_c (G_jcᵀu)² and cov(u) = σ²I; by
    polarisation from the estimator itself: the sum of v over e = (I − H) u_i, u_i unit vectors."""
    B, _, cluster = problem(seed, n=30)
    M = dense(B, cluster, "CR0")[1]
    expected = sum(cluster_robust(B, M[:, i], cluster, "CR2").matrix for i in range(len(B)))
    truth = np.linalg.inv(B.T @ B)
    np.testing.assert_allclose(expected, truth, rtol=1e-9, atol=1e-12)
    biased = sum(cluster_robust(B, M[:, i], cluster, "CR0").matrix for i in range(len(B)))
    assert (np.diag(biased) < 0.95 * np.diag(truth)).all()


@pytest.mark.parametrize("corrected", [True, False])
def test_equals_statsmodels(corrected):
    data = sm.datasets.grunfeld.load_pandas().data
    firm = data["firm"].astype("category").cat.codes.to_numpy().astype(int)
    B = sm.add_constant(data[["value", "capital"]].to_numpy(dtype=float))
    fitted = sm.OLS(data["invest"].to_numpy(dtype=float), B).fit()
    expected = cov_cluster(fitted, firm, use_correction=corrected)
    found = cluster_robust(B, fitted.resid, firm, "CR1" if corrected else "CR0")
    np.testing.assert_allclose(found.matrix, expected, rtol=1e-8)


@pytest.mark.parametrize("kind", ["HC0", "HC1", "HC2", "HC3"])
def test_singleton_clusters_are_rows(kind):
    """HC of statsmodels, with n − p degrees of freedom where leverage is not corrected."""
    B, e, _ = problem(5)
    found = hc(B, e, kind)
    fitted = sm.OLS(B @ np.arange(4.0) + e, B).fit()
    np.testing.assert_allclose(found.matrix, getattr(fitted, f"cov_{kind}"), rtol=1e-8)
    assert (found.dof == 36.0).all() == (kind in ("HC0", "HC1"))


def test_dof_of_the_difference_of_two_means():
    """HC2 of two groups is the Welch statistic; with equal variances its dof is the closed form
    (1/m + 1/n)² / (1/(m²(m − 1)) + 1/(n²(n − 1))) (Imbens & Kolesár 2016)."""
    m, n = 4, 19
    B = np.column_stack([np.ones(m + n), np.arange(m + n) < m]).astype(float)
    found = hc(B, residual(B, np.random.default_rng(3).normal(size=m + n)), "HC2")
    welch = (1 / m + 1 / n) ** 2 / (1 / (m**2 * (m - 1)) + 1 / (n**2 * (n - 1)))
    np.testing.assert_allclose(found.dof[1], welch, rtol=1e-10)


def test_a_row_of_leverage_one_leaves_its_parameter_unbounded():
    B, e, _ = problem(8)
    B = np.column_stack([B, np.eye(len(B))[17]])
    assert hc(B, residual(B, e), "HC2").dof[4] == 0
    with pytest.raises(InsufficientDataError, match=r"row 17 alone .* use HC2"):
        hc(B, residual(B, e), "HC3")


def test_an_ill_conditioned_fit_keeps_its_digits():
    """Columns that agree to 1e-6: BᵀB has condition 1e12.  B = A T exactly rounded, so the
    covariance is that of A carried by T⁻¹; QR keeps 1e-9 where the normal equations keep 1e-4."""
    A, e, _ = problem(7)
    T = np.eye(4)
    T[0, 1] = 2.0**20
    inverse = 2 * np.eye(4) - T
    expected = inverse @ hc(A, e, "HC2").matrix @ inverse.T
    np.testing.assert_allclose(hc(A @ T, e, "HC2").std, np.sqrt(np.diag(expected)), rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_follows_a_reparametrisation(kind):
    """Bx = (B C⁻¹)(C x): covariance C · cov · Cᵀ; units that differ by decades cost no digits."""
    B, e, cluster = problem(6)
    C = np.random.default_rng(7).normal(size=(4, 4)) + 2 * np.eye(4)
    found = cluster_robust(B, e, cluster, kind)
    moved = cluster_robust(B @ np.linalg.inv(C), e, cluster, kind)
    scale = np.abs(moved.matrix).max()
    np.testing.assert_allclose(moved.matrix, C @ found.matrix @ C.T, atol=1e-10 * scale)
    units = 10.0 ** np.array([-9, 0, 6, -3])
    scaled = cluster_robust(B * units, e, cluster, kind)
    np.testing.assert_allclose(scaled.matrix * np.outer(units, units), found.matrix, rtol=1e-10)
    np.testing.assert_allclose(scaled.dof, found.dof, rtol=1e-10)


def fixed_effects(seed):
    """A slope and one constant per cluster: every cluster determines its constant alone."""
    rng = np.random.default_rng(seed)
    cluster = np.repeat(np.arange(6), 5)
    B = np.column_stack([rng.normal(size=30), np.eye(6)[cluster]])
    return B, residual(B, rng.normal(size=30)), cluster


def test_parameters_of_a_single_cluster_have_no_interval():
    """With fixed effects CR2 needs the generalised inverse.  The slope stays unbiased (exactly,
    as above) and the constants, of which the residual says nothing, are unbounded."""
    B, e, cluster = fixed_effects(10)
    M = dense(B, cluster, "CR0")[1]
    expected = sum(cluster_robust(B, M[:, i], cluster).matrix[0, 0] for i in range(len(B)))
    np.testing.assert_allclose(expected, np.linalg.inv(B.T @ B)[0, 0], rtol=1e-9)
    for kind in ("CR0", "CR1", "CR2"):
        found = cluster_robust(B, e, cluster, kind)
        assert found.dof[0] > 1 and np.isfinite(found.interval(np.zeros(7))[0]).all()
    # The slope alone moves with the within-cluster variation: constants hang on both.
    assert (found.dof[1:] == 0).all() and np.isinf(found.std[1:]).all()
    np.testing.assert_array_equal(found.interval(np.zeros(7))[1:], [[-np.inf, np.inf]] * 6)
    assert "single cluster" in found.description
    with pytest.raises(InsufficientDataError, match="cluster 0 alone"):
        cluster_robust(B, e, cluster, "CR3")


def test_bad_input_is_told():
    B, e, cluster = problem(11)
    with pytest.raises(InsufficientDataError, match="all rows are in one"):
        cluster_robust(B, e, np.zeros(len(B), dtype=int))
    with pytest.raises(InputError, match="one per row of B"):
        cluster_robust(B, e, cluster[:-1])
    with pytest.raises(InputError, match="float64"):
        cluster_robust(B, e, cluster * 1.0)
    with pytest.raises(InputError, match="CR2"):
        cluster_robust(B, e, cluster, "CR9")
    with pytest.raises(InputError, match=r"columns \[\d\] of B depend"):
        cluster_robust(np.column_stack([B, B[:, 0] - B[:, 1]]), e, cluster)
    with pytest.raises(InputError, match=r"e\[3\]|y\[3\]"):
        cluster_robust(B, np.where(np.arange(len(B)) == 3, np.nan, e), cluster)
    with pytest.raises(InsufficientDataError, match="no residual"):
        cluster_robust(B[:4], e[:4], cluster[:4])


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31), n=st.integers(3, 60), p=st.integers(1, 6),
    groups=st.integers(1, 60), kind=st.sampled_from(KINDS),
)  # fmt: skip
def test_any_clustering_gives_a_covariance_or_says_why_not(seed, n, p, groups, kind):
    rng = np.random.default_rng(seed)
    B, cluster = rng.normal(size=(n, p)), rng.integers(0, groups, n)
    try:
        found = cluster_robust(
            B, residual(B, rng.normal(size=n)) if n > p else np.ones(n), cluster, kind
        )
    except InsufficientDataError:
        few = n <= p or len(np.unique(cluster)) < 2
        assert few or (kind == "CR3" and np.max(np.bincount(cluster)) > n - p)
        return
    assert np.linalg.eigvalsh(found.matrix)[0] >= -1e-9 * np.abs(found.matrix).max()
    # CR0 and CR1 sum squares of G numbers that sum to zero, CR2 and CR3 of any G.
    most = len(np.unique(cluster)) - (kind in ("CR0", "CR1"))
    assert (found.dof >= 0).all() and (found.dof <= most + 1e-6).all()


@pytest.mark.parametrize("clusters", [10])
def test_intervals_cover_with_correlated_clusters_of_unequal_spread(clusters):
    """2000 data sets, clusters of 6 rows with a common error and a spread that grows threefold
    with the regressor.  A right interval misses 5 %; three binomial standard deviations of 2000
    are 1.5 %, and Satterthwaite's approximation costs up to 2 % more where few clusters matter.
    Intervals of independent rows must fail, or the data would test nothing."""
    rng = np.random.default_rng(20)
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
