"""Intervals of robust fits hold the truth as often as they say; those from the weights do not."""

import numpy as np
import pytest
from support.calibration import binomial_band

from elastocal.identification.robust import covariance_of, huber, least_absolute


def tables(arm, share, count, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield arm.observed(arm.errors(rng, share, 100, 1000)[0])


def holds(x, covariance, truth):
    low, high = covariance.interval(x).T
    return (low < truth) & (truth < high)


def coverage(arm, fit, share, count, cluster=None):
    return np.array(
        [
            holds(found.x, covariance_of(found, arm.B, cluster), arm.x)
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


def test_intervals_hold_the_truth_where_readings_of_a_configuration_err_alike(arm):
    """A deviation as large as the noise, in 15 clusters; intervals of independent readings do
    not."""
    rng, held = np.random.default_rng(4), {"alike": [], "alone": []}
    for _ in range(20):
        common = np.repeat(rng.normal(size=(15, 3)), 18, axis=0)
        found = huber(arm.B, arm.observed(arm.errors(rng)[0] + common), 3)
        for name, cluster in (("alike", arm.configuration), ("alone", None)):
            held[name].append(holds(found.x, covariance_of(found, arm.B, cluster), arm.x))
    low, _ = binomial_band(np.size(held["alike"]) // 3, 0.95)
    assert low <= np.sum(held["alike"]) / 3
    assert np.sum(held["alone"]) / 3 < low
