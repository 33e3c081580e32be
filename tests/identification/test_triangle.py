"""A triangle stands for all rows, also where they are ill-conditioned."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from elastocal.identification.weighted_problem import RFactor, merge

NIST = Path(__file__).parent / "nist"
CERTIFIED = json.loads((NIST / "certified.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize(("name", "digits"), [("Longley", 9), ("Filip", 6), ("Wampler5", 9)])
def test_an_ill_conditioned_problem_keeps_its_digits(name, digits):
    """Condition numbers to 5e9 (columns scaled) enter once.  Normal equations, where they enter
    squared, lose all digits of Filip; parts of five rows are smaller than the triangle itself.

    A digit counts of a coefficient or of its standard error, whichever is larger: the rounding of
    readings 2e5 times as large as the coefficients, as Wampler5 has them, differs from one
    processor's kernels to another's.
    """
    certified = CERTIFIED[name]
    rows = np.loadtxt(NIST / f"{name}.csv", delimiter=",", skiprows=1)
    y, predictors = rows[:, 0], rows[:, 1:]
    columns = [np.ones((len(y), 1))] if 0 in certified["powers"] else []
    B = np.hstack(columns + [predictors**k for k in certified["powers"] if k > 0])
    pieces = [slice(a, a + 5) for a in range(0, len(y), 5)]
    r_factor = merge(RFactor.of(B[piece], y[piece]) for piece in pieces)
    scale = 1 / np.linalg.norm(B, axis=0)
    x, std = np.array(certified["x"]), np.array(certified["std"])
    error = np.abs(r_factor.step(scale) - x) / np.maximum(np.abs(x), std)
    assert (error < 10.0**-digits).all()
    sigma = r_factor.rest / np.sqrt(len(y) - len(x))
    found = sigma * np.sqrt(np.diag(r_factor.cofactor(scale)))
    assert (np.abs(found / std - 1) < 10.0**-digits).all()
    if name == "Filip":
        scaled = B * scale
        normal = scale * np.linalg.lstsq(scaled.T @ scaled, scaled.T @ y, rcond=None)[0]
        assert (np.abs(normal / x - 1) > 0.1).any()


@settings(max_examples=50, deadline=None)
@given(
    rows=st.integers(1, 400), p=st.integers(1, 6), cuts=st.integers(1, 9), seed=st.integers(0, 99)
)
def test_a_triangle_stands_for_its_rows(rows, p, cuts, seed):
    """Products, norms, subsets of columns and minimiser are those of the rows, however cut."""
    rng = np.random.default_rng(seed)
    B, e = rng.normal(size=(rows, p)) * 10.0 ** rng.uniform(-3, 3, p), rng.normal(size=rows)
    edges = np.linspace(0, rows, cuts + 1).astype(int)
    r_factor = merge(RFactor.of(B[a:b], e[a:b]) for a, b in pairwise(edges) if b > a)
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
        np.testing.assert_allclose(r_factor.step(1 / norm) * norm, x * norm, rtol=1e-8, atol=1e-10)
        left = np.linalg.norm(e - B @ x)
        assert r_factor.rest == pytest.approx(left, rel=1e-8, abs=1e-12 * np.linalg.norm(e))
