"""What must not matter does not: units, order, names, the parameters' scale and correlation."""

from dataclasses import replace

import numpy as np
import pytest
from identification.variance.dense import Table, readings

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
