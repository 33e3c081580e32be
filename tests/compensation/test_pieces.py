"""Small pieces: levels, points, targets as tables, commands as tables."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from elastocal.compensation.commands import one_target, read_targets
from elastocal.errors import ElastocalError, InputError
from elastocal.model.calibrated import share_of_levels

KINDS = ("revolute",) * 6


@given(
    levels=st.lists(st.integers(-30, 30), min_size=1, max_size=6, unique=True),
    angle=st.floats(-40, 40),
)
def test_shares_interpolate_between_levels(levels, angle) -> None:
    values = np.array(levels, dtype=float)
    share = share_of_levels(np.array([angle]), values)[0]
    assert np.isclose(share.sum(), 1) and share.min() >= 0
    # Shares of a linear function of the level give that function, clamped at the ends.
    assert np.isclose(share @ values, np.clip(angle, values.min(), values.max()))
    assert np.count_nonzero(share) <= 2


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("x_mm,y_mm\n1,2\n", "without z_mm"),
        ("rx_deg,ry_deg,rz_deg\n1,2,3\n", "x_mm,y_mm,z_mm are missing"),
        ("x_mm,y_mm,z_mm,approach_1\n1,2,3,1\n", "approach_2"),
        ("x,y_mm,z_mm\n1,2,3\n", "has no unit"),
        ("x_mm,y_mm,z_mm\n1,2,three\n", "line 2, column z_mm"),
        ("x_mm,y_mm,z_mm,q1_deg\n1,2,3,4\n", "the robot has 6 joints"),
        ("x_mm,y_mm,z_mm,speed\n1,2,3,4\n", "unknown column 'speed'"),
        ("x_mm,y_mm,z_mm,marker\n1,2,3,A\n1,2,3,B\n", "`point`"),
        ("x_mm,y_mm,z_mm,qw,qx,qy,qz\n1,2,3,1,1,0,0\n", "norm"),
    ],
)
def test_tables_that_say_no_target_are_refused(tmp_path, text, told) -> None:
    path = tmp_path / "targets.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=told):
        read_targets(path, KINDS, "base")


@settings(max_examples=60, deadline=None)
@given(text=st.text("0123456789,.-+eE naif", max_size=30))
def test_any_target_text_is_a_target_or_told(text) -> None:
    try:
        targets = one_target(text, "base")
    except ElastocalError as error:
        assert "`target` takes" in str(error)
    else:
        assert np.isfinite(targets.position).all()
