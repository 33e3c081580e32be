"""Intervals of robust fits hold the truth as often as they say; those from the weights do not."""

import numpy as np
import pytest
from support.calibration import binomial_band

from elastocal.identification.robust import (
    asymptotic_covariance,
    clustered_covariance,
    huber,
    least_absolute,
)


def tables(arm, share, count, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield arm.observed(arm.errors(rng, share, 100, 1000)[0])


def holds(x, covariance, truth):
    low, high = covariance.interval(x).T
    return (low < truth) & (truth < high)


def coverage(arm, fit, share, count):
    return np.array(
        [
            holds(found.x, asymptotic_covariance(found), arm.x)
            for found in (fit(arm.B, y, 3) for y in tables(arm, share, count))
        ]
    )


@pytest.mark.parametrize("share", [0.0, 0.05])
@pytest.mark.parametrize("fit", [huber, least_absolute], ids=["huber", "l1"])
def test_intervals_hold_the_truth(arm, fit, share):
    """95 % of 30 tables × 9 parameters; parameters of a table are nearly independent (each level
    has its own column), and the band of 99.9 % is that of a third as many."""
    held = coverage(arm, fit, share, 30)
    low, high = binomial_band(held.size // 3, 0.95)
    assert low <= held.sum() / 3 <= high

    # The deviations they are compared with are the true ones: test_intervals_hold_the_truth.


def test_with_every_observation_its_own_cluster_it_is_the_jackknife(arm):
    """For a loss that is quadratic throughout: refits of least squares without each reading."""
    y = arm.observed(arm.errors(np.random.default_rng(5))[0])
    found = huber(arm.B, y, 3, c=1e6)
    shifts = []
    for i in range(270):
        kept = np.ones(810, dtype=bool)
        kept[3 * i : 3 * i + 3] = False
        shifts.append(found.x - np.linalg.lstsq(arm.B[kept], y[kept])[0])
    expected = 269 / 270 * np.transpose(shifts) @ shifts
    covariance = clustered_covariance(found, np.arange(270))
    np.testing.assert_allclose(covariance.matrix, expected, rtol=1e-8, atol=1e-15)


def test_dof_are_satterthwaites_of_the_quadratic_form(arm):
    """For least squares the estimated variance of x_j is Σ_g (a_gᵀ e)² with e = (I − H)ε: the form
    written out with all 810 rows."""
    y = arm.observed(arm.errors(np.random.default_rng(8))[0])
    found = huber(arm.B, y, 3, c=1e6)
    covariance = clustered_covariance(found, arm.configuration)
    project = np.eye(810) - arm.B @ np.linalg.pinv(arm.B)
    A = np.zeros((15, 9, 810))
    for g in range(15):
        rows = np.repeat(arm.configuration == g, 3)
        others = np.linalg.inv(arm.B[~rows].T @ arm.B[~rows])
        A[g][:, rows] = others @ arm.B[rows].T
    for j in range(9):
        T = A[:, j] @ project @ A[:, j].T
        expected = np.trace(T) ** 2 / (T**2).sum()
        assert covariance.dof[j] == pytest.approx(expected, rel=1e-8)
        assert covariance.matrix[j, j] == pytest.approx(
            14 / 15 * ((A[:, j] @ found.residual) ** 2).sum(), rel=1e-8
        )
