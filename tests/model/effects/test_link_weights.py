"""Moments that all joints share are enough for the torques of any weights, and none too many."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from model.effects.stick import model, positions, rows, stick
from model.test_agreement_with_pinocchio import random_configurations, standing_arm
from support.cells import kr270_cell, kr270_chain

from elastocal.cell.arm_description import Nominal
from elastocal.cell.work_cell import Cell
from elastocal.model.arm import Arm
from elastocal.model.chain import Chain
from elastocal.model.effects.loads import STANDARD_GRAVITY, LinkWeights
from elastocal.units import Array

WEIGHTS = LinkWeights()


def torques(chain: Chain, cell: Cell, q: Array) -> Array:
    """−∂²V/∂q∂p (poses, joints, parameters)."""
    arm = Arm(chain, cell)
    arm.assemble()
    p = {s.key: ca.SX.sym(s.key) for s in WEIGHTS.parameters("arm", chain, cell)}
    WEIGHTS.load(arm, "arm", p)
    D = -ca.jacobian(ca.gradient(arm.potential, arm.q_commanded), ca.vertcat(*p.values()))
    f = ca.Function("D", [arm.q_commanded], [D])
    return np.stack([f(row).full() for row in q])


@pytest.mark.parametrize("seed", range(3))
def test_one_set_of_moments_makes_the_torques_of_any_weights_about_all_joints(
    tmp_path: Path, seed: int
) -> None:
    """Masses, branches, prismatic joints and tilted bases, weighed by pinocchio."""
    chain, cell, reference = standing_arm(tmp_path, seed)
    q = random_configurations(chain, 80, seed)
    weighed = -np.array([reference.gravity_torques(each) for each in q])
    D = torques(chain, cell, q)
    half = D[:40].reshape(-1, D.shape[2]), weighed[:40].ravel()
    found, *_ = np.linalg.lstsq(*half, rcond=1e-10)
    largest = np.abs(weighed).max()
    np.testing.assert_allclose(D[40:] @ found, weighed[40:], atol=1e-9 * largest)


def test_they_are_independent_but_for_what_an_upright_base_carries_anyway() -> None:
    chain, cell = kr270_chain(), kr270_cell()
    names = [s.key for s in WEIGHTS.parameters("arm", chain, cell)]
    assert names == [f"link{k}_moment_{a}" for k in range(1, 7) for a in "xy"]
    D = torques(chain, cell, random_configurations(chain, 60, 3)).reshape(-1, 12)
    sizes = np.array([s.typical for s in WEIGHTS.parameters("arm", chain, cell)])
    assert np.abs(D[:, :2]).max() < 1e-9  # joint 1 turns about the vertical
    shown = D[:, 2:] * sizes[2:]
    assert np.linalg.cond(shown / np.linalg.norm(shown, axis=0)) < 20


def test_each_joint_yields_by_its_compliance_times_the_torque() -> None:
    """Two sticks: the outer one's weight bends both joints, the inner one's only the first."""
    k, S1, S2 = 1e-6, 6.0, 2.0
    nominal = Nominal(joint_compliance=(k, 3 * k))
    m = model(stick("yy", (1.0, 0.5)), "joint_compliance", "link_weights", nominal=nominal)
    q = np.radians([[10.0, 20.0], [-40.0, 90.0], [0.0, 0.0]])
    found = positions(m, rows(q), link1_moment_x=S1, link2_moment_x=S2)
    # About −y a lever arm c gives the torque g c towards the ground, +y.
    inner, both = np.cos(q[:, 0]), np.cos(q.sum(axis=1))
    tau2 = STANDARD_GRAVITY * S2 * both
    tau1 = STANDARD_GRAVITY * S1 * inner + tau2
    sagged = q + np.stack([k * tau1, 3 * k * tau2], axis=1)
    rigid = model(stick("yy", (1.0, 0.5)))
    np.testing.assert_allclose(found, positions(rigid, rows(sagged)), atol=1e-7)
    lowered = positions(rigid, rows(q))[:, 2] - found[:, 2]
    assert (lowered[[0, 2]] > 1e-5).all()
