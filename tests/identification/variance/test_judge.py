"""Deletion residuals against literal deletion, and what the search for faulty readings finds."""

import numpy as np
import pytest
from identification.variance.dense import Table, own_parts, readings, shared_part
from scipy import stats

from elastocal.identification.noise_choice import (
    _deletion_fit,
    _not_fitted,
    estimate_noise,
    outlier_screening,
    own_noise,
    settle,
)
from elastocal.identification.noise_structure import Readings
from elastocal.identification.outliers import FALSE_ALARM

KINDS = [
    "independent",
    "axis",
    "marker",
    "polar",
    "stated",
    "independent+configuration",
    "axis+configuration",
    "marker+configuration",
    "polar+configuration",
    "stated+configuration",
]


def dense_covariance(found, r):
    """V (rows, rows) of all readings at the θ of the fit."""
    fit = found.fit
    parts = own_parts(fit.structure.name, r, fit.structure.names)
    parts += [shared_part(effect.name, r) for effect in fit.shared]
    return sum(t * part for t, part in zip(fit.state.theta, parts, strict=True))


def predicted(r, V, known, i, covariance=None):
    """Error of the best linear prediction of reading i from the readings `known`, over its own
    deviation, at fixed V; `covariance` stands for that of the estimate, default (BᵀV⁻¹B)⁻¹."""
    size = r.size
    a = (known[:, None] * size + np.arange(size)).ravel()
    b = i * size + np.arange(size)
    B, e = r.B.reshape(-1, r.n_parameters), r.e.ravel()
    W = np.linalg.inv(V[np.ix_(a, a)])
    Phi = np.linalg.inv(B[a].T @ W @ B[a])
    x = Phi @ B[a].T @ W @ e[a]
    k = V[np.ix_(b, a)] @ W
    d = e[b] - B[b] @ x - k @ (e[a] - B[a] @ x)
    F = B[b] - k @ B[a]
    spread = V[np.ix_(b, b)] - k @ V[np.ix_(a, b)]
    spread = spread + F @ (Phi if covariance is None else covariance) @ F.T
    return d / np.sqrt(np.diag(spread))


def table(seed=0, **changes):
    return readings(Table(**{"configurations": 8, "markers": 3, **changes}), seed, shared=2e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_fitted_readings_are_judged_as_if_each_were_deleted(kind):
    r = table()
    found = estimate_noise(r, kind)
    t = _deletion_fit(found, r, own_noise(found.fit, r)[0])
    V = dense_covariance(found, r)
    for i in range(len(r)):
        others = np.delete(np.arange(len(r)), i)
        np.testing.assert_allclose(t[i], predicted(r, V, others, i), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_readings_outside_the_fit_are_predicted_from_it(kind):
    """Some with mates in their configuration or set, some whose configuration is not fitted."""
    r = table()
    good = np.random.default_rng(3).random(len(r)) < 0.8
    good[r.configuration == 2] = False
    found = estimate_noise(r.take(good), kind)
    rest = np.flatnonzero(~good)
    t = _not_fitted(found, r.take(~good), own_noise(found.fit, r)[0][~good])
    V = dense_covariance(found, r)
    for row, i in zip(t, rest, strict=True):
        expected = predicted(r, V, np.flatnonzero(good), i, found.covariance.matrix)
        np.testing.assert_allclose(row, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["independent", "auto"])
def test_false_alarms_on_clean_tables_are_as_rare_as_stated(kind):
    """1 % per table, Bonferroni; more than the 99.99 % point of the binomial is too many."""
    rng = np.random.default_rng(12)
    r = table(1, configurations=10, repeats=3, unbalanced=False)
    alarms = 0
    tables = 200 if kind == "independent" else 50
    for _ in range(tables):
        verdict = settle(r.moved(1e-5 * rng.normal(size=r.e.shape)), kind)
        alarms += not verdict.good.all()
    assert alarms <= stats.binom.ppf(0.9999, tables, FALSE_ALARM)


@pytest.mark.parametrize("kind", ["independent", "axis+configuration", "auto"])
def test_gross_errors_are_found_and_nothing_else(kind):
    """From all readings under one variance or three; the free choice, which could take errors for
    the noise of a group, from the screening."""
    r = table(4, configurations=10, repeats=4)
    rng = np.random.default_rng(7)
    for _ in range(10):
        bad = rng.permutation(len(r))[:3]
        e = 1e-5 * rng.normal(size=r.e.shape)
        e[bad, rng.integers(3, size=3)] += 1e-3
        start = outlier_screening(r, e) if kind == "auto" else None
        assert set(np.flatnonzero(~settle(r.moved(e), kind, start).good)) == set(bad)


def test_errors_that_mask_each_other_are_found_from_a_robust_start():
    """Two readings with the same error and the same great leverage draw the fit to them: each is
    predicted well by the other.  Starting from all readings they stay; the screening finds them."""
    r = table(4, configurations=10, repeats=4, unbalanced=False)
    bad = np.flatnonzero((r.configuration == 0) & (r.marker == 0))[:2]
    B, e = r.B.copy(), 1e-5 * np.random.default_rng(5).normal(size=r.e.shape)
    B[bad] *= 50
    e[bad] += B[bad] @ np.full(4, 1e-5)
    marker = np.where(np.isin(np.arange(len(r)), bad), 9, r.marker)
    r = Readings(B, e, r.configuration, r.load, marker)
    assert settle(r, "independent").good[bad].all()
    first = outlier_screening(r, e)  # what a robust fit leaves: the errors
    assert not first[bad].any()
    assert set(np.flatnonzero(~settle(r, "independent", first).good)) == set(bad)


@pytest.mark.parametrize(("share", "kept"), [(0.4, False), (0.6, True)])
def test_more_than_half_are_never_excluded(monkeypatch, share, kept):
    """Where most readings would have to go, the model is at fault, and all stay."""
    r = table(4, configurations=10)
    faulty = np.arange(len(r)) < share * len(r)
    judge = "elastocal.identification.noise_choice.unexplained_readings"
    monkeypatch.setattr(judge, lambda *_: faulty)
    assert settle(r, "independent").good.all() == kept
