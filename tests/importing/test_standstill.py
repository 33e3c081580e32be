"""Dwells are the longest runs from the start on, whatever the sampling."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from elastocal.importing.joining import dwells

STEPS = st.lists(st.tuples(st.sampled_from([0.1, 0.5, 2.0]), st.integers(-2, 2),
                           st.integers(-1, 1)), min_size=1, max_size=40)  # fmt: skip


def plainly(time, q, still, shortest):
    """Row by row, as the definition says."""
    found, start = [], 0
    while start < len(q):
        end = start
        while end + 1 < len(q) and (np.ptp(q[start : end + 2], axis=0) <= still).all():
            end += 1
        if end > start and time[end] >= time[start] + shortest:
            found.append((start, end))
            start = end
        start += 1
    return found


@settings(max_examples=300, deadline=None)
@given(STEPS, st.sampled_from([0.0, 1.0, 2.5]))
def test_as_the_definition_says(steps, shortest):
    time = np.cumsum([dt for dt, _, _ in steps])
    q = np.cumsum([(a, b) for _, a, b in steps], axis=0).astype(float)
    still = np.array([1.0, 0.0])
    first, last, standing = dwells(time, q, still, shortest)
    ends = list(zip(first, last, strict=True))
    assert ends == plainly(time, q, still, shortest)
    for (a, b), there in zip(ends, standing, strict=True):
        np.testing.assert_array_equal(there, np.median(q[a : b + 1], axis=0))
