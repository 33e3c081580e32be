"""The fit of the majority is not carried away by 30 % of blunders."""

import numpy as np
import pytest

from elastocal.identification.outliers import majority


def kept(arm, B, y):
    good, variance = majority(B.reshape(270, 3, -1), y.reshape(270, 3))
    rows = np.repeat(good, 3)
    x = np.linalg.lstsq(B[rows], y[rows])[0]
    std = np.sqrt(np.diag(np.linalg.inv(arm.B.T @ arm.B)))
    return good, variance, np.abs((x - arm.x) / std).max()


@pytest.mark.parametrize("seed", range(3))
def test_thirty_per_cent_of_blunders_do_not_carry_it_away(arm, seed):
    """1 to 10 mm at a noise of 10 µm on 81 of 270 readings.  The other 70 % alone have √(1/0.7)
    times the standard deviations, and 9 parameters in 3 tables stay below 4.5 of those with a
    probability above 0.999; least squares is off by tens."""
    noise, bad = arm.errors(np.random.default_rng(seed), 0.3, 100, 1000)
    y = arm.observed(noise)
    good, variance, off = kept(arm, arm.B, y)
    assert not good[bad].any() and good.mean() > 0.65
    assert off < 4.5 * np.sqrt(1 / 0.7)
    assert variance == pytest.approx(1.0, abs=0.2)


def test_blunders_that_agree_on_another_answer_at_leverage_points(arm):
    """30 % of the readings lie ten times as far out and fit another x exactly."""
    rng = np.random.default_rng(0)
    y = arm.observed(arm.errors(rng)[0])
    bad = rng.permutation(270) < 81
    rows = np.repeat(bad, 3)
    B = np.where(rows[:, None], 10 * arm.B, arm.B)
    y[rows] = (B @ (arm.x + 100))[rows]
    good, _, off = kept(arm, B, y)
    assert not good[bad].any() and off < 4.5 * np.sqrt(1 / 0.7)
