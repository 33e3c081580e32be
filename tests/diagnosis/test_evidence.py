"""The closed form of the evidence against dense Gaussians."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp
from support.diagnosis_data import dense_noise, random_data, used_rows

from elastocal.diagnosis import (
    Flips,
    NoiseValues,
    NoisyData,
    direct,
    evidence_of,
    exceedance,
    project,
)
from elastocal.diagnosis.diagnosis import SMALLEST_P
from elastocal.diagnosis.evidence import SCALES, _principal

NOISE = NoiseValues(0.9, np.array([4e-6, 9e-6, 1e-5]), np.full(3, 0.5))
SEEDS = range(4)


def group(data: NoisyData, seed: int, k: int = 3) -> np.ndarray:
    rng = np.random.default_rng((seed, 11))
    return data.masked(1e-5 * rng.normal(size=(*data.r.shape, k)))


def dense_evidence(data: NoisyData, C: np.ndarray, s: float) -> float:
    """log N(r; 0, S + s²CCᵀ) − log N(r; 0, S) with everything else integrated out in S."""
    rows = used_rows(data)
    X, C = (a.reshape(-1, a.shape[2])[rows] * 1e5 for a in (data.X, C))
    r = data.r.ravel()[rows] * 1e5
    S = 1e10 * dense_noise(data, NOISE) + X / data.precision @ X.T
    with_group, without = (
        stats.multivariate_normal(cov=V).logpdf(r) for V in (S + s**2 * C @ C.T, S)
    )
    return float(with_group - without)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_evidence_is_the_ratio_of_dense_densities(seed: int) -> None:
    data = random_data(seed)
    C = group(data, seed)
    found = direct(C, project(data, NOISE))
    each = [dense_evidence(data, C, s) for s in SCALES]
    for s, expected in zip(SCALES, each, strict=True):
        assert found.evidence(np.array([s]))[0] == pytest.approx(expected, rel=1e-7, abs=1e-7)
    mixed = logsumexp(each) - np.log(len(SCALES))
    assert found.evidence()[0] == pytest.approx(mixed, rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("seed", SEEDS)
def test_columns_of_zeros_and_turned_columns_count_the_same(seed: int) -> None:
    """The prior is isotropic: the evidence of a group is that of any rotation of it."""
    data = random_data(seed)
    C, at = group(data, seed), project(data, NOISE)
    plain = direct(C, at).evidence()
    padded = np.concatenate([np.zeros((*data.r.shape, 2)), C], axis=2)
    np.testing.assert_allclose(direct(padded, at).evidence(), plain, rtol=1e-9)
    turn = stats.ortho_group(3, seed=seed).rvs()
    np.testing.assert_allclose(direct(C @ turn, at).evidence(), plain, rtol=1e-8)


@pytest.mark.parametrize("seed", SEEDS)
def test_what_the_fitted_columns_can_do_has_no_evidence(seed: int) -> None:
    """Under a flat prior P removes their span; rounding must not bring it back."""
    data = random_data(seed)
    data = replace(data, precision=np.full(data.X.shape[2], 1e-11))
    at, C = project(data, NOISE), group(data, seed, 1)
    mix = np.random.default_rng(seed).normal(size=(data.X.shape[2], 2))
    both = direct(np.concatenate([C, data.masked(data.X @ mix)], axis=2), at)
    assert (both.lam[0] == 0).sum() == 2 and (both.beta[0][both.lam[0] == 0] == 0).all()
    np.testing.assert_allclose(both.evidence(), direct(C, at).evidence(), rtol=1e-6)


@pytest.mark.parametrize("seed", SEEDS)
def test_flipped_configurations_are_flipped_residuals_projected_anew(seed: int) -> None:
    """b = CᵀP(De), P dense: residuals e as large as the noise, D the configurations' signs."""
    data = random_data(seed)
    C, at = group(data, seed), project(data, NOISE)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (6, len(data.r)))
    found = direct(C, at, Flips(signs, at.scattered)).flipped(np.zeros((1, 1)))[0]
    rows = used_rows(data)
    X, c = (a.reshape(-1, a.shape[2])[rows] for a in (data.X, C))
    inverse = np.linalg.inv(dense_noise(data, NOISE))
    M = X.T @ inverse @ X + np.diag(data.precision)
    P = inverse - inverse @ X @ np.linalg.solve(M, X.T @ inverse)
    e = at.scattered.ravel()[rows]
    lam, U = np.linalg.eigh(c.T @ P @ c)
    each = np.repeat(signs, data.r.shape[1], axis=1)[:, rows]
    beta = np.array([U.T @ c.T @ P @ (d * e) for d in each])
    expected = evidence_of(lam[None], beta[:, None], SCALES)[:, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-8)


def test_the_distance_is_the_signal_of_the_typical_size_off_the_fitted_columns() -> None:
    """d² = tr CᵀPC: the expected squared signal, in standard deviations, of γ ~ N(0, I)."""
    data = random_data(1)
    C, at = group(data, 1), project(data, NOISE)
    gamma = np.random.default_rng(0).normal(size=(20000, 3))
    P = at.inverse - at.H @ at.H.transpose(0, 2, 1)
    A = sum(c.T @ p @ c for c, p in zip(C, P, strict=True))
    H, flat = at.H.reshape(-1, at.H.shape[2]), C.reshape(-1, 3)
    own = sum(h.T @ c for h, c in zip(at.H, C, strict=True))
    np.testing.assert_allclose(own, H.T @ flat, rtol=1e-9)
    A = sum(c.T @ v @ c for c, v in zip(C, at.inverse, strict=True)) - own.T @ own
    simulated = np.mean(np.einsum("gi,ij,gj->g", gamma, A, gamma))
    assert direct(C, at).distance[0] ** 2 == pytest.approx(simulated, rel=0.05)


def test_strong_evidence_does_not_overflow() -> None:
    lam, beta = np.array([[1e6]]), np.array([[1e6]])
    assert np.isfinite(evidence_of(lam, beta, SCALES)).all()
    assert evidence_of(lam, beta, SCALES)[0] == pytest.approx(5e5, rel=1e-3)


FLIPS = np.sort(np.random.default_rng(3).chisquare(3, 199) / 2)


def test_where_flips_reach_it_a_p_value_is_their_share() -> None:
    assert exceedance(FLIPS, FLIPS[100]) == pytest.approx(100 / 200)
    assert exceedance(FLIPS, FLIPS[-1]) == pytest.approx(2 / 200)
    assert exceedance(FLIPS[:0], 5.0) == 1.0


def test_beyond_all_flips_a_p_value_goes_on_falling_down_to_its_floor() -> None:
    beyond = [exceedance(FLIPS, FLIPS[-1] + step) for step in (1e-9, 1.0, 2.0, 3.0, 30.0)]
    assert beyond[0] <= 1 / 200 and beyond[-1] == SMALLEST_P
    assert beyond == sorted(beyond, reverse=True) and len(set(beyond)) == 5


@pytest.mark.parametrize("kind", ["one", "many", "sum", "largest", "rare"])
@pytest.mark.parametrize("true", [2e-3, 5e-4])
def test_p_values_from_the_tail_are_not_below_what_they_are(kind: str, true: float) -> None:
    """Log evidences of one effect and of many, their sums and maxima: the p-value at the quantile
    that leaves `true` beyond it is no smaller in the median, and nine times as large at most."""

    def draw(rng: np.random.Generator, n: int) -> np.ndarray:
        return {
            "one": lambda: rng.chisquare(1, n) / 2,
            "many": lambda: rng.chisquare(8, n) / 2,
            "sum": lambda: logsumexp(rng.chisquare(3, (n, 60)) / 2, axis=1),
            "largest": lambda: rng.chisquare(2, (n, 20)).max(axis=1) / 2,
            "rare": lambda: logsumexp(rng.chisquare(1, (n, 100)) / 2 - 2, axis=1),
        }[kind]()

    rng = np.random.default_rng(5)
    observed = float(np.quantile(draw(rng, 100_000), 1 - true))
    told = [exceedance(draw(rng, 199), observed) for _ in range(200)]
    assert true < np.median(told) < 9 * true


def test_pairs_of_columns_have_the_eigenvalues_of_lapack() -> None:
    """Also where the two are parallel, one is zero, or both are alike."""
    X = np.random.default_rng(0).normal(size=(50, 4, 2))
    X[0, :, 1], X[1, :, 1], X[2] = 2 * X[0, :, 0], 0.0, np.eye(4)[:, :2]
    A = X.transpose(0, 2, 1) @ X
    (lam, U), (known, _) = _principal(A), np.linalg.eigh(A)
    np.testing.assert_allclose(lam, known, atol=1e-13)
    np.testing.assert_allclose(U * lam[:, None] @ U.transpose(0, 2, 1), A, atol=1e-13)
    np.testing.assert_allclose(U.transpose(0, 2, 1) @ U, np.tile(np.eye(2), (50, 1, 1)), atol=1e-13)
