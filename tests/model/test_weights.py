"""Weights that nobody knows: enough functions for any masses, and none too many."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from model.test_agreement_with_pinocchio import standing_arm
from scipy.spatial.transform import Rotation
from support.cells import kr270_cell, kr270_chain, random_poses, random_table
from support.stick import model, positions, rows, stick

from elastocal.cell import Cell
from elastocal.cell_tables import Nominal
from elastocal.model.chain import Chain
from elastocal.model.effects.base import Arm
from elastocal.model.effects.statics import STANDARD_GRAVITY, GravitySag, LinkWeights
from elastocal.model.manipulator import Model
from elastocal.units import Array

SAG, WEIGHTS = GravitySag(), LinkWeights()


def evaluated(arm: Arm, D: ca.SX, q: Array) -> Array:
    f = ca.Function("D", [arm.q_commanded], [D])
    return np.stack([f(row).full() for row in q])


def sagging(chain: Chain, cell: Cell, place: str, q: Array) -> Array:
    """∂δq/∂a_i (poses, parameters)."""
    arm = Arm(chain, cell)
    p = {s.key: ca.SX.sym(s.key) for s in SAG.parameters(place, chain, cell)}
    D = ca.jacobian(SAG.drive(arm, place, p), ca.vertcat(*p.values()))
    return evaluated(arm, D, q)[:, 0]


def torques(chain: Chain, cell: Cell, q: Array) -> Array:
    """−∂²V/∂q∂p (poses, joints, parameters) of the links' moments."""
    arm = Arm(chain, cell)
    arm.assemble()
    p = {s.key: ca.SX.sym(s.key) for s in WEIGHTS.parameters("arm", chain, cell)}
    WEIGHTS.load(arm, "arm", p)
    D = -ca.jacobian(ca.gradient(arm.potential, arm.q_commanded), ca.vertcat(*p.values()))
    return evaluated(arm, D, q)


def predicted(D: Array, values: Array) -> Array:
    """The second half of the values, by the coefficients that fit the first."""
    half = len(D) // 2
    return D[half:] @ np.linalg.lstsq(D[:half], values[:half], rcond=1e-10)[0]


@pytest.mark.parametrize("seed", range(2))
def test_the_torques_of_any_weights_are_sums_of_them(tmp_path: Path, seed: int) -> None:
    """Masses, branches, prismatic joints and tilted bases, weighed by pinocchio: of each joint
    with functions of its own, and of all with one set of moments."""
    chain, cell, reference = standing_arm(tmp_path, seed)
    q = random_poses(chain, 160, seed)
    weighed = -np.array([reference.gravity_torques(each) for each in q])
    for place in SAG.places(chain, cell):
        tau = weighed[:, int(place[5:]) - 1]
        found = predicted(sagging(chain, cell, place, q), tau)
        np.testing.assert_allclose(found, tau[80:], atol=1e-6 * np.abs(tau).max() + 1e-9)
    D, tau = torques(chain, cell, q), weighed.ravel()
    found = predicted(D.reshape(len(tau), -1), tau)
    np.testing.assert_allclose(found, tau[len(tau) // 2 :], atol=1e-9 * np.abs(tau).max())


def test_the_moments_are_independent_but_for_what_an_upright_base_carries_anyway() -> None:
    chain, cell = kr270_chain(), kr270_cell()
    specs = WEIGHTS.parameters("arm", chain, cell)
    assert [s.key for s in specs] == [f"link{k}_moment_{a}" for k in range(1, 7) for a in "xy"]
    D = torques(chain, cell, random_poses(chain, 60, 3)).reshape(-1, 12)
    assert np.abs(D[:, :2]).max() < 1e-9  # joint 1 turns about the vertical
    shown = D[:, 2:] * np.array([s.typical for s in specs])[2:]
    assert np.linalg.cond(shown / np.linalg.norm(shown, axis=0)) < 20


def test_the_vertical_is_that_of_the_fitted_base() -> None:
    """Not of the nominal one: a base that was placed otherwise turns the weights."""
    chain = kr270_chain()
    table = random_table(chain, 5, seed=2)
    free = Model.assembled(chain, kr270_cell(["base_frame", "gravity_sag"]))
    vector = np.array([0.4, -0.3, 1.0])
    stated = Nominal(base_rotation=Rotation.from_rotvec(vector).as_matrix())
    fixed = Model.assembled(chain, kr270_cell(["gravity_sag"], nominal=stated))
    x = free.nominal
    x[3:6] = vector
    x[6:] = 1e-3 * np.arange(1, len(x) - 5)
    np.testing.assert_allclose(free.predict(table, x), fixed.predict(table, x[6:]), atol=1e-12)


def test_each_joint_yields_by_its_compliance_times_the_torque() -> None:
    """Two sticks: the outer one's weight bends both joints, the inner one's only the first."""
    k, S1, S2 = 1e-6, 6.0, 2.0
    nominal = Nominal(joint_compliance=(k, 3 * k))
    m = model(stick("yy", (1.0, 0.5)), "joint_compliance", "link_weights", nominal=nominal)
    q = np.radians([[10.0, 20.0], [-40.0, 90.0], [0.0, 0.0]])
    found = positions(m, rows(q), link1_moment_x=S1, link2_moment_x=S2)
    # About −y a lever arm c gives the torque g c towards the ground, +y.
    tau2 = STANDARD_GRAVITY * S2 * np.cos(q.sum(axis=1))
    tau1 = STANDARD_GRAVITY * S1 * np.cos(q[:, 0]) + tau2
    sagged = q + np.stack([k * tau1, 3 * k * tau2], axis=1)
    rigid = model(stick("yy", (1.0, 0.5)))
    np.testing.assert_allclose(found, positions(rigid, rows(sagged)), atol=1e-7)
    lowered = positions(rigid, rows(q))[:, 2] - found[:, 2]
    assert (lowered[[0, 2]] > 1e-5).all()
