"""The functions that unknown weights bring are enough for any masses, and none too many."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from model.test_agreement_with_pinocchio import random_configurations, standing_arm
from scipy.spatial.transform import Rotation
from support.cells import kr270_cell, kr270_chain, random_table

from elastocal.cell.arm_description import Nominal
from elastocal.cell.work_cell import Cell
from elastocal.model.arm import Arm
from elastocal.model.chain import Chain
from elastocal.model.effects.loads import GravitySag
from elastocal.model.manipulator import Model
from elastocal.units import Array

SAG = GravitySag()


def functions(chain: Chain, cell: Cell, place: str, q: Array) -> Array:
    """∂δq/∂a_i (poses, parameters)."""
    arm = Arm(chain, cell)
    p = {s.key: ca.SX.sym(s.key) for s in SAG.parameters(place, chain, cell)}
    D = ca.jacobian(SAG.drive(arm, place, p), ca.vertcat(*p.values()))
    f = ca.Function("D", [arm.q_commanded], [D])
    return np.vstack([f(row).full() for row in q])


@pytest.mark.parametrize("seed", range(3))
def test_the_torques_of_any_weights_are_sums_of_them(tmp_path: Path, seed: int) -> None:
    """Masses, branches, prismatic joints and tilted bases, weighed by pinocchio."""
    chain, cell, reference = standing_arm(tmp_path, seed)
    q = random_configurations(chain, 160, seed)
    torques = np.array([reference.gravity_torques(each) for each in q])
    for place in SAG.places(chain, cell):
        D, tau = functions(chain, cell, place, q), torques[:, int(place[5:]) - 1]
        found, *_ = np.linalg.lstsq(D[:80], tau[:80], rcond=1e-10)
        np.testing.assert_allclose(D[80:] @ found, tau[80:], atol=1e-6 * np.abs(tau).max() + 1e-9)


def test_they_are_independent_and_one_in_size() -> None:
    chain = kr270_chain()
    q = random_configurations(chain, 300, 3)
    turned = [Rotation.random(random_state=k).as_matrix() for k in range(30)]
    for place in SAG.places(chain, kr270_cell()):
        cells = (kr270_cell(nominal=Nominal(base_rotation=R)) for R in turned)
        D = np.vstack([functions(chain, cell, place, q[k::30]) for k, cell in enumerate(cells)])
        assert np.linalg.cond(D) < 50
        np.testing.assert_allclose(np.sqrt((D**2).mean(axis=0)), 1.0, rtol=0.15)


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
