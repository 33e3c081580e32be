"""The loaded arm at rest: torque balance, MuJoCo's arm, and where eq. (3) stops holding.

References: pinocchio on the URDF for load and weight torques, MuJoCo's springs for whole deflected
arms, numpy for the gravity compensator's formulas.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from support.cells import (
    COMPENSATOR,
    COMPLIANCE,
    DOWN,
    LOAD_POINT,
    MARKERS,
    SLANTED,
    TABLE_2,
    kr270_cell,
    kr270_chain,
    random_poses,
    table_of,
)
from support.robots import KR270

from elastocal.cell_tables import Nominal
from elastocal.messages import ElastocalError
from elastocal.model.manipulator import Model
from elastocal.units import Array

K = np.array(COMPLIANCE)
GRAVITY = np.array([0.0, 0.0, -9.80665])
SPRING = Nominal(joint_compliance=COMPLIANCE, gravity_compensator=COMPENSATOR)


def kr270(*effects: str, **model) -> Model:
    return Model.assembled(kr270_chain(), kr270_cell(effects or ("joint_compliance",), **model))


def positions(model: Model, poses: Array, force: Array) -> Array:
    return model.predict(table_of(poses, force)).reshape(len(poses), -1, 3)


def kr270_poses(count: int) -> Array:
    return np.vstack([TABLE_2, random_poses(kr270_chain(), count, seed=11)])


class Pinocchio:
    """Torques of weights and load on the URDF's own bodies, base as given."""

    def __init__(self, gravity: Array, R_tracker_base: Array | None = None) -> None:
        self.model = pin.buildModelFromUrdf(str(KR270))
        flange = self.model.getFrameId("flange", pin.FrameType.BODY)
        parent = self.model.frames[flange].parentJoint
        placement = self.model.frames[flange].placement * pin.SE3(np.eye(3), LOAD_POINT)
        frame = pin.Frame("load", parent, flange, placement, pin.FrameType.OP_FRAME)
        self.load = self.model.addFrame(frame)
        self.data = self.model.createData()
        self.R = np.eye(3) if R_tracker_base is None else R_tracker_base
        self.model.gravity.linear = self.R.T @ gravity

    def torques(self, q: Array, force: Array) -> Array:
        """Jᵀ f minus the weights' torques, (6,) N m, at joint values q."""
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        J = pin.computeFrameJacobian(self.model, self.data, q, self.load, axes)
        weights = pin.computeGeneralizedGravity(self.model, self.data, q)
        return J[:3].T @ (self.R.T @ force) - weights


class Compensator:
    """FACTS' formulas of the gravity compensator, in their own words."""

    def __init__(self) -> None:
        ax, ay = COMPENSATOR["anchor_m"]
        self.Kc, self.L = COMPENSATOR["stiffness_N_per_m"], COMPENSATOR["arm_m"]
        self.s0 = COMPENSATOR["free_length_m"]
        self.a, self.alpha = float(np.hypot(ax, ay)), float(np.arctan2(ay, ax))

    def length(self, q2: float) -> float:
        a, L = self.a, self.L
        return float(np.sqrt(a**2 + L**2 + 2 * a * L * np.cos(self.alpha - q2)))

    def torque(self, q2: float) -> float:
        stretched = 1 - self.s0 / self.length(q2)
        return float(-self.Kc * stretched * self.a * self.L * np.sin(self.alpha - q2))


# --- balance -------------------------------------------------------------------------------


@pytest.mark.parametrize("force", [DOWN, SLANTED, np.zeros(3)], ids=["down", "slanted", "none"])
@pytest.mark.parametrize("weights", [False, True], ids=["weightless", "weights"])
def test_torques_balance_at_the_deflected_pose(weights: bool, force: Array) -> None:
    """θ = k τ, τ by pinocchio at q + θ, to 1e-13 rad."""
    poses = kr270_poses(30)
    theta = kr270(link_gravity=weights).deflection(table_of(poses, force, ("M1",)))
    reference = Pinocchio(GRAVITY if weights else np.zeros(3))
    for q, bent in zip(poses, theta, strict=True):
        expected = K * reference.torques(q + bent, force)
        np.testing.assert_allclose(bent, expected, rtol=0, atol=1e-13)
    assert (np.abs(theta).max() > 1e-4) == (weights or bool(force.any()))


# --- the linear model of eq. (3) -----------------------------------------------------------


def test_linear_model_is_eq_3() -> None:
    """δp_j = Σ_k (z_k × (p_j − o_k)) · k_k [(z_k × (p_F − o_k)) · F], numbers by pinocchio."""
    model = pin.buildModelFromUrdf(str(KR270))
    data = model.createData()
    chain = kr270_chain()
    ours = positions(kr270(deflection_model="linear"), TABLE_2, SLANTED)
    for q, predicted in zip(TABLE_2, ours, strict=True):
        pin.framesForwardKinematics(model, data, q)
        flange = data.oMf[model.getFrameId("flange", pin.FrameType.BODY)]
        load = flange.act(LOAD_POINT)
        for name, marker in zip(MARKERS, predicted, strict=True):
            p = flange.act(MARKERS[name])
            expected = p.copy()
            for joint, T, k in zip(chain.joints, list(data.oMi)[1:], COMPLIANCE, strict=True):
                z, o = T.rotation @ joint.axis, T.translation
                expected += np.cross(z, p - o) * k * (np.cross(z, load - o) @ SLANTED)
            np.testing.assert_allclose(marker, expected, rtol=0, atol=1e-14)


# --- gravity compensator -------------------------------------------------------------------


def test_compensator_torque() -> None:
    """Without load, θ2 = k2 M(q2 + θ2) with FACTS' M, and nothing else bends."""
    model = kr270("joint_compliance", "gravity_compensator", nominal=SPRING)
    poses = kr270_poses(30)
    theta = model.deflection(table_of(poses, np.zeros(3), ("M1",)))
    M = np.array([Compensator().torque(q2) for q2 in poses[:, 1] + theta[:, 1]])
    np.testing.assert_allclose(theta[:, 1], COMPLIANCE[1] * M, rtol=1e-12, atol=1e-15)
    assert not np.delete(theta, 1, axis=1).any()
    assert np.abs(M).max() > 1e3


# --- too much load -------------------------------------------------------------------------


SOFT = Nominal(joint_compliance=(1e-3,) * 6)


def test_a_load_without_equilibrium_is_nan_and_named() -> None:
    """Joints a thousand times too soft under 100 kN: lines that find no rest are NaN."""
    poses = np.vstack([TABLE_2, random_poses(kr270_chain(), 40, seed=1)])
    table = table_of(poses, np.array([3e4, 0.0, -1e5]), ("M1",), both=True)
    model = kr270(nominal=SOFT)
    predicted = model.predict(table).reshape(-1, 3)
    lost = np.isnan(predicted).any(axis=1)
    assert lost.any()
    assert not lost[table.force[:, 2] == 0].any()
    assert np.isnan(model.deflection(table)[lost]).all()
    first = table.row[np.flatnonzero(lost)[0]]
    message = rf"table, line {first}: no static equilibrium .*\({lost.sum()} rows\)"
    with pytest.raises(ElastocalError, match=message):
        model.regressor(table)
    assert np.isfinite(model.regressor(table.take(~lost)).B).all()
