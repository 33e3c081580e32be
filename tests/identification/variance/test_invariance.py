"""What must not matter does not: units, order, names, the parameters' scale and correlation."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identification.variance.dense import Table, readings

from elastocal.errors import ElastocalError
from elastocal.identification.noise_choice import settle

BASE = Table(configurations=9, markers=3, repeats=4)
KINDS = [
    "auto",
    "independent+configuration",
    "axis",
    "marker+configuration",
    "groups",
    "groups+configuration",
    "polar+configuration",
    "stated",
]


@pytest.fixture(scope="module")
def usual():
    """Readings with a shared effect, a faulty one, and what each kind finds in them."""
    r = readings(BASE, 2, shared=2e-5)
    e = r.e * [1.0, 2.0, 3.0]
    e[5] += 3e-3
    r = r.moved(e)
    return r, {kind: settle(r, kind, ~np.isin(np.arange(len(r)), [5])) for kind in KINDS}


def start(r, faulty=5):
    return np.arange(len(r)) != faulty


def same(found, expected, x=1.0, rtol=1e-6):
    """`found` is `expected` with its parameters times `x` (a number or (p,))."""
    assert found.noise.kind == expected.noise.kind
    np.testing.assert_allclose(found.noise.x, x * expected.noise.x, rtol=rtol)
    theirs = expected.noise.covariance
    np.testing.assert_allclose(found.noise.covariance.std, np.abs(x) * theirs.std, rtol=rtol)
    np.testing.assert_allclose(found.noise.covariance.dof, theirs.dof, rtol=10 * rtol)


@pytest.mark.parametrize("kind", KINDS)
def test_scale_of_the_columns(usual, kind):
    r, found = usual
    scale = np.array([1e-9, 1e-3, 1e4, 1e9])
    same(settle(replace(r, B=r.B * scale), kind, start(r)), found[kind], 1 / scale)


@pytest.mark.parametrize("kind", KINDS)
def test_correlation_of_the_parameters(usual, kind):
    """x → C x with a condition of 1e7: fitted values stay, to the digits that are there."""
    r, found = usual
    rng = np.random.default_rng(0)
    left, right = np.linalg.qr(rng.normal(size=(4, 4)))[0], np.linalg.qr(rng.normal(size=(4, 4)))[0]
    C = left * np.logspace(0, -7, 4) @ right
    other = settle(replace(r, B=r.B @ C), kind, start(r))
    assert other.noise.kind == found[kind].noise.kind
    np.testing.assert_allclose(r.B @ C @ other.noise.x, r.B @ found[kind].noise.x, atol=1e-10)
    back = np.linalg.inv(C)
    std = np.sqrt(np.diag(back @ found[kind].noise.covariance.matrix @ back.T))
    np.testing.assert_allclose(other.noise.covariance.std, std, rtol=1e-6)


@pytest.mark.parametrize("factor", [1e-6, 1e6])
@pytest.mark.parametrize("kind", KINDS)
def test_unit_of_length(usual, kind, factor):
    """B and e in µm or km: the same parameters, variances times the square."""
    r, found = usual
    stated = r.stated * factor**2
    reach = r.reach  # stays: θ_a takes the unit
    other = replace(r, B=r.B * factor, e=r.e * factor, stated=stated, reach=reach)
    verdict = settle(other, kind, start(r))
    same(verdict, found[kind])
    expected = found[kind].noise.fit.state.theta
    if verdict.noise.kind.startswith("stated"):
        expected = expected * np.where(np.arange(len(expected)) == 0, 1.0, factor**2)
    else:
        expected = expected * factor**2
    np.testing.assert_allclose(verdict.noise.fit.state.theta, expected, rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_size_of_the_residuals(usual, kind):
    """e alone times 1e6: estimates and deviations follow, dof and verdicts stay."""
    r, found = usual
    other = replace(r, e=1e6 * r.e, stated=1e12 * r.stated)
    verdict = settle(other, kind, start(r))
    same(verdict, found[kind], 1e6)
    assert np.array_equal(verdict.good, found[kind].good)


@pytest.mark.parametrize("kind", KINDS)
def test_order_of_the_readings(usual, kind):
    r, found = usual
    order = np.random.default_rng(1).permutation(len(r))
    verdict = settle(r.take(order), kind, start(r)[order])
    same(verdict, found[kind])
    assert np.array_equal(verdict.good, found[kind].good[order])


@pytest.mark.parametrize("kind", KINDS)
def test_names_of_configurations_and_markers(usual, kind):
    r, found = usual
    new = np.random.default_rng(2).permutation(1000)
    other = replace(r, configuration=new[r.configuration], marker=new[r.marker] - 500)
    verdict = settle(other, kind, start(r))
    same(verdict, found[kind])
    assert np.array_equal(verdict.good, found[kind].good)


@pytest.mark.parametrize("kind", KINDS)
def test_shift_along_the_model(usual, kind):
    """e + B x₀ moves the estimate by x₀ and changes no variance."""
    r, found = usual
    x0 = np.array([1e-4, -2e-4, 3e-5, 1e-4])
    verdict = settle(r.moved(r.e + r.B @ x0), kind, start(r))
    np.testing.assert_allclose(verdict.noise.x, found[kind].noise.x + x0, atol=1e-9)
    theta = found[kind].noise.fit.state.theta
    # A variance of zero stands at its smallest number, which is no figure.
    nothing = 1e-9 * theta.max()
    np.testing.assert_allclose(verdict.noise.fit.state.theta, theta, rtol=1e-5, atol=nothing)


@settings(max_examples=60, deadline=None)
@given(
    size=st.sampled_from([1, 3, 6]),
    configurations=st.integers(1, 6),
    loads=st.integers(1, 2),
    markers=st.integers(1, 3),
    repeats=st.integers(1, 4),
    p=st.integers(1, 3),
    seed=st.integers(0, 10**6),
    noise=st.sampled_from([1e-30, 1e-6, 1e3]),
)
def test_any_table_gives_finite_numbers_or_a_clear_refusal(
    size, configurations, loads, markers, repeats, p, seed, noise
):
    shape = Table(size, configurations, loads, markers, repeats, p, unbalanced=False)
    r = readings(shape, seed, noise=noise)
    try:
        verdict = settle(replace(r, stated=None))
    except ElastocalError as refusal:
        # Repeats add no rows that tell columns apart.
        few = r.e.size / repeats < p + 5
        assert few or "measure" in str(refusal), str(refusal)
        return
    found = verdict.noise
    assert np.isfinite(found.x).all()
    assert np.isfinite(found.covariance.matrix).all()
    assert (np.diag(found.covariance.matrix) > 0).all()
    assert (found.covariance.dof > 0).all()
