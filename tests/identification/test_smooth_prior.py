"""Parameters with a prior beside parameters without one, against textbook formulas."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize

from elastocal.identification.smooth_fit import LinearRows, Posterior, Scales
from elastocal.identification.weighted_problem import RFactor

ROWS, FREE, SHRUNK = 80, 4, 15
GROUP = np.repeat([0, 1, 2], 5)
STD = np.concatenate([np.full(5, 0.5), np.linspace(1.0, 0.2, 5), np.full(5, 0.3)])


def drawn(seed: int, scale: tuple[float, ...] = (1.0, 1.0, 1.0), sigma: float = 0.3):
    """B (rows, free + shrunk) and e."""
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(ROWS, FREE + SHRUNK))
    alpha = 3 * rng.normal(size=FREE)
    b = STD * np.sqrt(np.array(scale))[GROUP] * rng.normal(size=SHRUNK)
    e = B @ np.concatenate([alpha, b]) + sigma * rng.normal(size=ROWS)
    return B, e


def linear(B, e) -> LinearRows:
    return LinearRows(RFactor.of(B, e), STD, GROUP, 3)


def marginal(B, e, scales: Scales, kept: np.ndarray) -> tuple[np.ndarray, float]:
    """V of the rows, and −2 × the restricted log-likelihood but a constant, by the textbook."""
    Bf, Bs = B[:, kept], B[:, FREE:]
    V = scales.variance * np.eye(ROWS) + Bs * (STD**2 * scales.scale[GROUP]) @ Bs.T
    W = np.linalg.inv(V)
    N = Bf.T @ W @ Bf
    P = W - W @ Bf @ np.linalg.inv(N) @ Bf.T @ W
    return V, np.linalg.slogdet(V)[1] + np.linalg.slogdet(N)[1] + e @ P @ e


@pytest.mark.parametrize("kept", [np.arange(FREE), np.array([0, 2])])
def test_the_posterior_is_that_of_ridge_regression(kept):
    B, e = drawn(0)
    scales = Scales(np.array([1.0, 0.3, 0.0]), 0.2, np.zeros(3))
    found = Posterior(linear(B, e).only(kept), scales)
    own = np.flatnonzero(scales.scale[GROUP] > 0)
    assert np.array_equal(found.own, own)
    chosen = np.concatenate([kept, FREE + own])
    C, prior = B[:, chosen], np.zeros(len(chosen))
    prior[len(kept) :] = scales.variance / (STD**2 * scales.scale[GROUP])[own]
    normal = C.T @ C + np.diag(prior)
    assert np.allclose(found.step, np.linalg.solve(normal, C.T @ e), rtol=1e-9)
    assert np.allclose(found.cofactor, np.linalg.inv(normal), rtol=1e-8)
    hat = C @ np.linalg.solve(normal, C.T)
    assert np.isclose(found.effective.sum(), np.trace(hat))
    assert np.allclose(np.diag(C @ found.cofactor @ C.T), np.diag(hat))
    share = np.diag(found.cofactor * prior @ found.cofactor) / np.diag(found.cofactor)
    assert np.allclose(found.prior_share, share)
    # Of the ordinary ones alone, the others taken for noise.
    weight, R = scales.variance * np.linalg.inv(marginal(B, e, scales, kept)[0]), found.marginal.R
    assert np.allclose(R.T @ R, B[:, kept].T @ weight @ B[:, kept])


@pytest.mark.parametrize("seed", range(3))
def test_sizes_are_those_of_the_largest_restricted_likelihood(seed):
    B, e = drawn(seed, (0.5, 0.9, 0.2))
    problem = linear(B, e).only(np.arange(FREE))
    found = problem.scales()
    assert (found.scale < 1).all(), "else their price matters"

    def textbook(log):
        scale, variance = np.exp(log[:3]), np.exp(log[3])
        return marginal(B, e, Scales(scale, variance, np.zeros(3)), np.arange(FREE))[1]

    at = np.log([*np.maximum(found.scale, 1e-6), found.variance])
    better = optimize.minimize(textbook, at, method="Nelder-Mead", options={"maxiter": 4000})
    assert textbook(at) - better.fun < 0.05
    none = Scales(np.where(np.arange(3) == 1, 0.0, found.scale), found.variance, np.zeros(3))
    # What a group gains is at the variance that goes with its absence, so never more than here.
    worse = marginal(B, e, none, np.arange(FREE))[1] - textbook(at)
    assert found.gain[1] <= worse / 2 + 1e-6


def test_a_size_that_is_known_is_not_estimated_away():
    """What others stand for as well would be nothing, and known to be."""
    problem = linear(*drawn(0, (0.0, 1.0, 1.0)))
    assert problem.scales().scale[0] < 0.05
    assert replace(problem, functions=0).scales().scale[0] > 0.1
