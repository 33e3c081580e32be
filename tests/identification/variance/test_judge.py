"""Deletion residuals against literal deletion, and what the search for faulty readings finds."""

from dataclasses import replace

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
    unexplained_readings,
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


@pytest.mark.parametrize("size", [1, 6])
def test_other_sizes_are_judged_the_same(size):
    r = table(size=size, markers=1, repeats=4)
    found = estimate_noise(r, "axis+configuration" if size > 1 else "independent+configuration")
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


def test_readings_far_from_the_fitted_ones_are_judged_by_the_fitted_variances():
    """Fitted near the tracker, where angular noise is no variance of its own: none farther off."""
    r = table(configurations=14, unbalanced=False)
    far = r.configuration >= 12
    r = replace(r, reach=np.where(far, 9.0, 3.0))
    found = estimate_noise(r.take(~far), "polar")
    assert found.fit.structure.names == ("range", "transverse")
    covariance, dof = own_noise(found.fit, r)
    u = r.sight[:, 0]
    along = u[:, :, None] * u[:, None, :]
    expected = found.fit.own[0] * along + found.fit.own[1] * (np.eye(3) - along)
    np.testing.assert_allclose(covariance, expected, rtol=1e-10, atol=1e-22)
    assert (dof > 10).all()


def test_one_component_and_variance_give_externally_studentised_residuals():
    """The verdict changes exactly where their p-value crosses the level."""
    r = table(size=1, markers=1, repeats=1, unbalanced=False, configurations=25)
    B, e = r.B[:, 0], r.e[:, 0]
    n, p = B.shape
    H = B @ np.linalg.inv(B.T @ B) @ B.T
    residual, rest = e - H @ e, 1 - np.diag(H)
    s2 = (residual @ residual - residual**2 / rest) / (n - p - 1)
    external = residual / np.sqrt(s2 * rest)
    smallest = np.sort(2 * stats.t.sf(np.abs(external), n - p - 1))[:4]
    found = estimate_noise(r, "independent")
    for count in range(1, 4):
        level = n * np.sqrt(smallest[count - 1] * smallest[count])
        faulty = unexplained_readings(found, r, np.ones(n, dtype=bool), level)
        assert faulty.sum() == count
        assert set(np.argsort(-np.abs(external))[:count]) == set(np.flatnonzero(faulty))


def test_a_direction_that_one_reading_alone_determines_is_not_judged():
    r = table(size=1, markers=1, repeats=1, unbalanced=False, configurations=25)
    B = np.concatenate([r.B, np.zeros((25, 1, 1))], axis=2)
    B[7, 0, 4] = 1.0
    e = r.e.copy()
    e[7] = 1.0
    verdict = settle(Readings(B, e, r.configuration, r.load, r.marker), "independent")
    assert verdict.good.all()


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


def test_false_alarms_do_happen():
    """At a level of one half, about 39 % (1 − e^−½) of clean tables have one."""
    rng = np.random.default_rng(2)
    r = table(1, configurations=10, unbalanced=False)
    everything = np.ones(len(r), dtype=bool)
    found = 0
    for _ in range(200):
        r = r.moved(1e-5 * rng.normal(size=r.e.shape))
        found += unexplained_readings(estimate_noise(r, "independent"), r, everything, 0.5).any()
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], 200, 1 - np.exp(-0.5))
    assert low <= found <= high


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


def test_a_wrong_suspicion_is_taken_back():
    r = table(4, configurations=10, repeats=4)
    e = 1e-5 * np.random.default_rng(1).normal(size=r.e.shape)
    suspected = np.random.default_rng(2).random(len(r)) < 0.9
    assert settle(r.moved(e), "independent", suspected).good.all()


@pytest.mark.parametrize("kind", ["groups", "groups+configuration", "marker", "auto"])
def test_a_whole_group_may_be_excluded(kind):
    r = table(4, configurations=10, repeats=5, unbalanced=False)
    e = 1e-5 * np.random.default_rng(1).normal(size=r.e.shape)
    gone = r.marker == 2 if kind == "marker" else r.configuration == 3
    e[gone] += 0.1 * np.random.default_rng(3).normal(size=(gone.sum(), 3))
    verdict = settle(r.moved(e), kind, ~gone)
    assert np.array_equal(verdict.good, ~gone)
    assert np.isfinite(verdict.noise.x).all()


def test_a_search_that_goes_in_circles_ends_and_keeps_what_was_good_in_between(monkeypatch):
    r = table(4, configurations=10)
    n = len(r)
    rounds = []

    def undecided(noise, readings, good, level):
        rounds.append(good.copy())
        faulty = np.zeros(n, dtype=bool)
        faulty[[0, 1] if good[0] else [1, 2]] = True
        return faulty

    monkeypatch.setattr("elastocal.identification.noise_choice.unexplained_readings", undecided)
    verdict = settle(r, "independent")
    assert len(rounds) < 6
    assert set(np.flatnonzero(~verdict.good)) == {1}  # 0 and 2 come and go
    kept = estimate_noise(r.take(verdict.good), "independent")
    np.testing.assert_array_equal(verdict.noise.x, kept.x)


@pytest.mark.parametrize(("share", "kept"), [(0.4, False), (0.6, True)])
def test_more_than_half_are_never_excluded(monkeypatch, share, kept):
    """Where most readings would have to go, the model is at fault, and all stay."""
    r = table(4, configurations=10)
    faulty = np.arange(len(r)) < share * len(r)
    judge = "elastocal.identification.noise_choice.unexplained_readings"
    monkeypatch.setattr(judge, lambda *_: faulty)
    assert settle(r, "independent").good.all() == kept
