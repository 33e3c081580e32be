"""Rotation vectors: log against scipy, near no turn and near half a turn too; reach of an arm."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from elastocal.model import rigid
from elastocal.model.chain import Chain, Joint
from elastocal.model.rigid import reach_of

_R = ca.SX.sym("R", 3, 3)
_log = ca.Function("log", [_R], [rigid.vector_from_rotation(_R)])

NEAR_ZERO = [0.0, 1e-300, 1e-20, 1e-15, 1e-12, 1e-8, 1e-4]


def test_slides_alone_reach_as_far_as_all_of_them_go() -> None:
    """The first one's travel counts where no joint turns; before one that turns it does not."""
    place = np.eye(4)
    place[:3, 3] = 0.0, 0.0, 0.1
    joints = [Joint(f"joint{i}", "prismatic", place, np.eye(3)[0], 0.0, 2.0) for i in range(4)]
    assert 6.2 < reach_of(Chain("gantry", tuple(joints), np.eye(4))) < np.hypot(8.0, 0.3)
    turning = replace(joints[1], kind="revolute", axis=np.array([0.0, 0.0, 1.0]))
    assert reach_of(Chain("with a wrist", (*joints[:3], turning), np.eye(4))) > 4.5
    assert reach_of(Chain("rail", (joints[0], turning, *joints[2:]), np.eye(4))) < 4.1


def log(R: np.ndarray) -> np.ndarray:
    return _log(R).full().ravel()


directions = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: v @ v > 1e-4)
axes = directions.map(lambda v: v / np.linalg.norm(v))
angles = st.floats(0, np.pi - 0.01) | st.sampled_from(NEAR_ZERO)


@given(axis=axes, angle=angles)
@settings(deadline=None)
def test_log_is_scipys(axis: np.ndarray, angle: float) -> None:
    R = Rotation.from_rotvec(angle * axis).as_matrix()
    np.testing.assert_allclose(log(R), angle * axis, rtol=0, atol=1e-12)


@pytest.mark.parametrize("below", [0.0, 1e-12, 1e-9, 1e-6, 1e-3])
@given(axis=axes)
@settings(deadline=None)
def test_log_up_to_half_a_turn(below: float, axis: np.ndarray) -> None:
    """Near π the axis may come back reversed; the rotation and the angle are the same."""
    R = Rotation.from_rotvec((np.pi - below) * axis).as_matrix()
    np.testing.assert_allclose(Rotation.from_rotvec(log(R)).as_matrix(), R, rtol=0, atol=1e-14)
    assert np.linalg.norm(log(R)) == pytest.approx(np.pi - below, abs=1e-14)
