"""Joint limits of robot and cell together, and ranges to draw from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.calibration import planar_chain

from elastocal.model.chain import Chain, finite_ranges

bound = st.none() | st.floats(-5, 5)


def limited(low: list[float | None], high: list[float | None], kinds: list[str]) -> Chain:
    chain = planar_chain(4)
    joints = [
        replace(
            joint,
            kind=kind,
            lower=-np.inf if a is None else a,
            upper=np.inf if b is None else (b if a is None else max(a + 0.1, b)),
        )
        for joint, a, b, kind in zip(chain.joints, low, high, kinds, strict=True)
    ]
    return replace(chain, joints=tuple(joints))


@given(
    st.lists(bound, min_size=4, max_size=4),
    st.lists(bound, min_size=4, max_size=4),
    st.lists(st.sampled_from(["revolute", "prismatic"]), min_size=4, max_size=4),
)
def test_ranges_are_finite_and_keep_every_limit(low, high, kinds) -> None:
    chain = limited(low, high, kinds)
    lower = np.array([j.lower for j in chain.joints])
    upper = np.array([j.upper for j in chain.joints])
    a, b = finite_ranges(chain, lower, upper)
    assert np.isfinite(a).all()
    assert (a < b).all()
    given_low, given_high = np.isfinite(lower), np.isfinite(upper)
    np.testing.assert_array_equal(a[given_low], lower[given_low])
    np.testing.assert_array_equal(b[given_high], upper[given_high])
    turn = np.where([k == "revolute" for k in kinds], 2 * np.pi, 2.0)
    open_ended = ~(given_low & given_high)
    np.testing.assert_allclose((b - a)[open_ended], turn[open_ended])
    free = ~(given_low | given_high)
    near = np.full(4, 0.7)
    middle = np.mean(finite_ranges(chain, lower, upper, near), axis=0)
    np.testing.assert_allclose(middle[free], 0.7)
