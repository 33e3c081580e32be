"""Joints that settle anew at each visit and drift in time: formulas, choice, false alarms."""

from dataclasses import replace

import numpy as np
import pytest
from engine.dense import Dense
from scipy import stats

from elastocal.identification.least_squares import orthogonal
from elastocal.identification.noise_choice import estimate_noise
from elastocal.identification.noise_structure import Deviation, Readings, VisitRecord

SIGMA, SCATTER, DRIFT, LASTING = 2e-5, 2e-5, 4e-5, 0.2


def readings(seed=0, configurations=20, repeats=1):
    """Two loads and two markers at each pose, a visit for each load and repeat; e is zero."""
    rng = np.random.default_rng(seed)
    labels = np.array(list(np.ndindex(configurations, repeats, 2, 2)))[:, [0, 2, 3, 1]]
    c, load, marker, _repeat = labels.T
    visit = np.unique(labels[:, [0, 3, 1]], axis=0, return_inverse=True)[1].ravel()
    n, joints = len(labels), 3
    motion = rng.normal(size=(configurations, 2, 3, joints))[c, marker]
    when = visit / visit.max()
    record = VisitRecord(
        visit[:, None], motion[:, None], np.ones((n, 1)), when[:, None],
        np.ones(joints, dtype=bool), True, 3600.0,
    )  # fmt: skip
    B = rng.normal(size=(configurations, 2, 2, 3, 5))[c, load, marker]
    return Readings(B, np.zeros((n, 3)), c, load, marker, visits=record)


def covariance(r, joints=0.0, drift=0.0):
    n = len(r)
    visit = r.visits.visit[:, 0]
    G = r.visits.motion[:, 0].reshape(3 * n, -1)
    same = np.repeat(np.repeat(visit[:, None] == visit, 3, axis=0), 3, axis=1)
    V = SIGMA**2 * np.eye(3 * n) + joints**2 * (G @ G.T) * same
    return V + drift**2 * np.kron(course(r, LASTING), np.eye(3))


def course(r, lasting):
    """Correlation (n, n) of a drift: its waves, and what is left of it common to a visit."""
    visit, waves = r.visits.visit[:, 0], r.visits.waves(lasting)
    left = 1 - (waves**2).sum(axis=1)
    return waves @ waves.T + np.sqrt(np.outer(left, left)) * (visit[:, None] == visit)


def drawn(r, rng, joints=0.0, drift=0.0):
    V = covariance(r, joints, drift)
    return replace(r, e=(np.linalg.cholesky(V) @ rng.normal(size=len(V))).reshape(-1, 3))


@pytest.mark.parametrize("kind", ["independent+joints", "independent+time"])
def test_likelihood_and_estimate_are_those_of_dense_matrices(kind):
    r = drawn(readings(), np.random.default_rng(1), SCATTER, DRIFT)
    found = estimate_noise(r, kind)
    V = found.fit.own[0] * np.eye(3 * len(r))
    if found.fit.lasting is None:
        V += found.fit.common[0] / SCATTER**2 * (covariance(r, SCATTER) - covariance(r))
    else:
        V += found.fit.common[0] * np.kron(course(r, found.fit.lasting), np.eye(3))
    B, e = r.B.reshape(3 * len(r), -1), r.e.ravel()
    whole = Dense(B, e, [V], np.ones(1))
    x, Phi = whole.x, whole.Phi
    # B is orthonormal in the fit, which shifts ℓ by ½ log|BᵀB|.
    shift = 0.5 * np.linalg.slogdet(B.T @ B)[1]
    assert found.fit.log_likelihood == pytest.approx(whole.log_likelihood + shift, rel=1e-9)
    assert np.allclose(found.x, x, atol=1e-6 * np.sqrt(np.diag(Phi)).min())
    p = len(x)
    T = orthogonal(B)[1]
    assert np.allclose(T @ found.fit.expected.Phi[:p, :p] @ T.T, Phi, rtol=1e-6)
    # No other variances are likelier.
    assert np.abs(found.fit.model.objective(np.log(found.fit.theta))[1]).max() < 1e-2


def test_tests_of_either_alarm_falsely_once_in_a_hundred_times():
    """p-values of independent noise are uniform: 1 % and 20 % below these, within chance."""
    r, rng = readings(configurations=12), np.random.default_rng(4)
    p = np.array([[t.p for t in estimate_noise(drawn(r, rng)).tests] for _ in range(30)])
    for level, most in ((0.01, 3), (0.2, 14)):
        assert (((p < level).sum(axis=0)) <= most).all()
        assert stats.binom.sf(most, len(p), level) < 2e-3
    assert ((p > 0.5).mean(axis=0) > 0.3).all()


def test_a_place_without_a_reading_shares_nothing():
    """As that of a pose which is only planned beside a drift that the cell states."""
    unit, loading = np.zeros((3, 1), dtype=int), np.arange(1.0, 10.0).reshape(3, 1, 3, 1)
    found = Deviation("time", "time", unit, loading).packed(np.array([[0, -1], [1, 2]]))
    assert found[0, :3, 0].tolist() == [1, 2, 3] and not found[0, 3:].any()
    assert found[1, :, 0].tolist() == [4, 5, 6, 7, 8, 9]
