"""Covariance from independent rows: statsmodels, Stata, dense formulas, unbiasedness, bad input."""

import numpy as np
import pytest
import statsmodels.api as sm

from elastocal.errors import InputError, InsufficientDataError
from elastocal.identification import hc

KINDS = ("HC0", "HC1", "HC2", "HC3", "HC4")


def residual(B, y):
    return y - B @ np.linalg.lstsq(B, y, rcond=None)[0]


def problem(seed, n=30, p=4):
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(n, p)) * np.exp(rng.normal(size=(n, 1)))
    return B, residual(B, rng.normal(size=n) * np.exp(rng.normal(size=n)))


def dense(B):
    bread = np.linalg.inv(B.T @ B)
    return bread, B @ bread @ B.T


@pytest.mark.parametrize("kind", ["HC0", "HC1", "HC2", "HC3"])
@pytest.mark.parametrize("seed", range(3))
def test_equals_statsmodels(kind, seed):
    B, e = problem(seed)
    fitted = sm.OLS(B @ np.arange(4.0) + e, B).fit()
    found = hc(B, e, kind)
    np.testing.assert_allclose(found.matrix, getattr(fitted, f"cov_{kind}"), rtol=1e-8)
    if kind in ("HC0", "HC1"):
        np.testing.assert_array_equal(found.dof, 26.0)


def test_equals_stata():
    """`reg y x, vce(robust)` and `vce(hc2)` of Stata, 10 decimals, as quoted in the tests of the
    R package dfadjust (Kolesár; test_clustervar.R): y = cos 0…9, tan 1…10; x = sin 1…10, 2…11."""
    y = np.concatenate([np.cos(np.arange(10)), np.tan(np.arange(1, 11))])
    x = np.concatenate([np.sin(np.arange(1, 11)), np.sin(np.arange(2, 12))])
    B = np.column_stack([np.ones(20), x])
    e = residual(B, y)
    np.testing.assert_allclose(hc(B, e, "HC1").std, [0.4278077455, 0.4392155956], atol=1e-10)
    np.testing.assert_allclose(hc(B, e, "HC2").std, [0.4227339762, 0.4421048122], atol=1e-10)


def test_hc4_by_its_formula():
    """Cribari-Neto 2004: ω_i = e_i²/(1 − h_i)^δ_i, δ_i = min(4, n h_i/Σh)."""
    B, e = problem(1)
    bread, H = dense(B)
    h = np.diag(H)
    delta = np.minimum(4, h / h.mean())
    assert (delta == 4).any() and (delta < 4).any()
    expected = bread @ B.T @ np.diag(e**2 / (1 - h) ** delta) @ B @ bread
    np.testing.assert_allclose(hc(B, e, "HC4").matrix, expected, rtol=1e-10)


@pytest.mark.parametrize("kind", ["HC2", "HC3", "HC4"])
def test_satterthwaite_dof_from_dense_matrices(kind):
    """(Σλ)²/Σλ² over the eigenvalues of the quadratic form in the errors."""
    B, e = problem(2)
    n, p = B.shape
    bread, H = dense(B)
    h = np.diag(H)
    power = {"HC2": 1.0, "HC3": 2.0, "HC4": np.minimum(4, n * h / p)}[kind]
    found = hc(B, e, kind)
    M = np.eye(n) - H
    for j in range(p):
        a = (B @ bread)[:, j] / (1 - h) ** (power / 2)
        values = np.linalg.eigvalsh(M @ np.diag(a**2) @ M)
        np.testing.assert_allclose(found.dof[j], values.sum() ** 2 / (values**2).sum(), rtol=1e-9)


def test_dof_of_the_difference_of_two_means():
    """HC2 of two groups is the Welch statistic; with equal variances its dof is the closed form
    (1/m + 1/n)² / (1/(m²(m − 1)) + 1/(n²(n − 1))) (Imbens & Kolesár 2016)."""
    m, n = 4, 19
    B = np.column_stack([np.ones(m + n), np.arange(m + n) < m]).astype(float)
    y = np.random.default_rng(3).normal(size=m + n)
    found = hc(B, residual(B, y), "HC2")
    one, two = y[:m], y[m:]
    np.testing.assert_allclose(
        found.matrix[1, 1], one.var(ddof=1) / m + two.var(ddof=1) / n, rtol=1e-12
    )
    welch = (1 / m + 1 / n) ** 2 / (1 / (m**2 * (m - 1)) + 1 / (n**2 * (n - 1)))
    np.testing.assert_allclose(found.dof[1], welch, rtol=1e-10)


def test_hc2_is_unbiased_under_equal_variances():
    """Σ_i over e = (I − H) u_i, unit vectors u_i, is E cov / σ² exactly."""
    B, _ = problem(4)
    M = np.eye(len(B)) - dense(B)[1]
    for kind, sign in {"HC0": -1, "HC2": 0, "HC3": 1}.items():
        mean = sum(hc(B, M[:, i], kind).matrix for i in range(len(B)))
        gap = np.diag(mean) / np.diag(dense(B)[0]) - 1
        if sign == 0:
            np.testing.assert_allclose(gap, 0, atol=1e-10)
        else:
            assert (sign * gap > 0.01).all()


@pytest.mark.parametrize("kind", KINDS)
def test_follows_a_reparametrisation(kind):
    def estimate(B, e):
        return hc(B, e, kind)

    B, e = problem(5)
    C = np.random.default_rng(6).normal(size=(4, 4)) + 2 * np.eye(4)
    found, moved = estimate(B, e), estimate(B @ np.linalg.inv(C), e)
    scale = np.abs(moved.matrix).max()
    np.testing.assert_allclose(moved.matrix, C @ found.matrix @ C.T, atol=1e-10 * scale)
    units = 10.0 ** np.array([-9, 0, 6, -3])
    scaled = estimate(B * units, e)
    np.testing.assert_allclose(scaled.matrix * np.outer(units, units), found.matrix, rtol=1e-10)
    np.testing.assert_allclose(scaled.dof, found.dof, rtol=1e-10)


def test_an_ill_conditioned_fit_keeps_its_digits():
    """Columns that agree to 1e-6: BᵀB has condition 1e12.  B = A T exactly rounded, so the
    covariance is that of A carried by T⁻¹; QR keeps 1e-9 where the normal equations keep 1e-4."""
    A, e = problem(7)
    T = np.eye(4)
    T[0, 1] = 2.0**20
    found = hc(A @ T, e, "HC2")
    inverse = np.eye(4)
    inverse[0, 1] = -(2.0**20)
    expected = inverse @ hc(A, e, "HC2").matrix @ inverse.T
    np.testing.assert_allclose(found.std, np.sqrt(np.diag(expected)), rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_row_of_leverage_one(kind):
    """Fitted exactly: HC0 and HC1 leave it out, HC2 to HC4 say which row it is."""
    B, e = problem(8)
    column = np.zeros(len(B))
    column[17] = 2.0
    B = np.column_stack([B, column])
    e = residual(B, e)
    if kind in ("HC0", "HC1"):
        assert np.isfinite(hc(B, e, kind).matrix).all()
    else:
        with pytest.raises(InsufficientDataError, match="row 17 of B alone"):
            hc(B, e, kind)


def test_blocks_of_rows_make_no_difference(monkeypatch):
    B, e = problem(9)
    whole = hc(B, e, "HC2").dof
    monkeypatch.setattr("elastocal.identification.covariance.ENTRIES", 16 * 7)
    np.testing.assert_allclose(hc(B, e, "HC2").dof, whole, rtol=1e-12)


def test_bad_input_is_told():
    B, e = problem(10)
    with pytest.raises(InputError, match="HC5"):
        hc(B, e, "HC5")
    with pytest.raises(InputError, match="shape"):
        hc(B, e[:-1])
    with pytest.raises(InputError, match="finite"):
        hc(np.where(B > 0, B, np.inf), e)
    with pytest.raises(InputError, match="depend on the others"):
        hc(np.column_stack([B, B.sum(axis=1)]), e)
    with pytest.raises(InsufficientDataError, match="4 rows leave no residual of 4 parameters"):
        hc(B[:4], e[:4])
