"""Linear least squares: of least norm, and by triangles that stand for all rows."""

from functools import reduce
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from elastocal.engine import least_norm
from elastocal.identification import weighted_problem
from elastocal.identification.weighted_problem import RFactor


@pytest.mark.parametrize("shape", [(9, 4), (4, 9), (6, 6)])
def test_least_norm_where_divide_and_conquer_does_not_converge(
    monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]
) -> None:
    """Full rank or not, the solution of least norm, by whichever of LAPACK's two ways."""
    rng = np.random.default_rng(0)
    A, b = rng.normal(size=shape), rng.normal(size=(shape[0], 2))
    A[:, 1] = 2 * A[:, 0]
    expected = np.linalg.pinv(A, rcond=1e-12) @ b
    np.testing.assert_allclose(least_norm(A, b, cond=1e-12), expected, atol=1e-12)
    lstsq = weighted_problem.linalg.lstsq

    def failing(*arguments, lapack_driver=None, **options):
        if lapack_driver is None:
            raise weighted_problem.linalg.LinAlgError("SVD did not converge")
        return lstsq(*arguments, lapack_driver=lapack_driver, **options)

    monkeypatch.setattr(weighted_problem.linalg, "lstsq", failing)
    np.testing.assert_allclose(least_norm(A, b, cond=1e-12), expected, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(
    rows=st.integers(1, 400), p=st.integers(1, 6), cuts=st.integers(1, 9), seed=st.integers(0, 99)
)
def test_a_triangle_stands_for_its_rows(rows, p, cuts, seed):
    """Products, norms, subsets of columns and minimiser are those of the rows, however cut."""
    rng = np.random.default_rng(seed)
    B, e = rng.normal(size=(rows, p)) * 10.0 ** rng.uniform(-3, 3, p), rng.normal(size=rows)
    edges = np.linspace(0, rows, cuts + 1).astype(int)
    parts = (RFactor.of(B[a:b], e[a:b]) for a, b in pairwise(edges) if b > a)
    r_factor = reduce(RFactor.merged, parts)
    norm = np.linalg.norm(B, axis=0)
    assert r_factor.rows == rows and r_factor.rss == pytest.approx(e @ e, rel=1e-12)
    np.testing.assert_allclose(r_factor.R.T @ r_factor.R, B.T @ B, rtol=0,
                               atol=1e-12 * np.outer(norm, norm).max())  # fmt: skip
    np.testing.assert_allclose(r_factor.R.T @ r_factor.projected, B.T @ e,
                               atol=1e-11 * norm.max() * np.linalg.norm(e))  # fmt: skip
    chosen = np.flatnonzero(rng.random(p) < 0.6)
    some = r_factor.of_columns(chosen)
    assert some.rss == pytest.approx(e @ e, rel=1e-12)
    np.testing.assert_allclose(some.R.T @ some.R, B[:, chosen].T @ B[:, chosen], rtol=0,
                               atol=1e-12 * np.outer(norm, norm).max())  # fmt: skip
    if rows > 2 * p:
        x = np.linalg.lstsq(B / norm, e, rcond=None)[0] / norm
        step = least_norm(r_factor.R / norm, r_factor.projected)
        np.testing.assert_allclose(step, x * norm, rtol=1e-8, atol=1e-10)
        left = np.linalg.norm(e - B @ x)
        assert r_factor.rest == pytest.approx(left, rel=1e-8, abs=1e-12 * np.linalg.norm(e))
