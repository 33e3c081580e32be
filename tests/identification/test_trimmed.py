"""The search for the majority's fit: all starts at once find what one at a time would."""

import numpy as np
import pytest
from scipy import linalg

from elastocal.identification import least_trimmed_squares
from elastocal.identification.robust_fits import STEPS, TOGETHER, _searched


def one_by_one(B, e, subset):
    """Shift and trimmed cost two concentration steps from a subset, by least squares on B."""
    n, size, p = B.shape
    half = (n + p // size + 1) // 2
    chosen = subset
    for step in range(STEPS + 1):
        shift = linalg.lstsq(B[chosen].reshape(-1, p), e[chosen].ravel())[0]
        squared = ((e - B @ shift) ** 2).sum(axis=1)
        if step < STEPS:
            chosen = np.argsort(squared)[:half]
    return shift, np.sort(squared)[:half].sum()


@pytest.mark.parametrize(("n", "p", "spread"), [(30, 9, 1.0), (100, 9, 1e6), (80, 27, 1.0)])
def test_all_starts_at_once_find_what_one_at_a_time_does(n, p, spread):
    """Of columns of unlike length, and of more starts than are held at a time."""
    rng = np.random.default_rng(n)
    B = rng.normal(size=(n, 3, p)) * np.geomspace(1, spread, p)
    e = B @ (rng.normal(size=p) / np.geomspace(1, spread, p)) + 0.1 * rng.normal(size=(n, 3))
    e[: n // 4] += 5
    subsets = np.array([rng.choice(n, n // 2, replace=False) for _ in range(TOGETHER + 20)])
    shifts, costs = _searched(B, e, subsets)
    for k in (0, TOGETHER - 1, TOGETHER, len(subsets) - 1):
        shift, cost = one_by_one(B, e, subsets[k])
        np.testing.assert_allclose(shifts[k], shift, rtol=1e-6, atol=1e-8 * np.abs(shift).max())
        assert costs[k] == pytest.approx(cost, rel=1e-8)


def test_a_direction_that_no_reading_shows_stays_where_it_is():
    """A column of zeros: the others are fitted as if it were not there."""
    rng = np.random.default_rng(4)
    B = rng.normal(size=(120, 5))
    e = B @ np.arange(1.0, 6.0) + 0.01 * rng.normal(size=120)
    e[:40] += 3
    alone = least_trimmed_squares(B, e, 3)
    beside = least_trimmed_squares(np.column_stack([B, np.zeros(120)]), e, 3)
    np.testing.assert_allclose(beside, np.append(alone, 0.0), atol=1e-9)
