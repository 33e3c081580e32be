"""The independent arm: same kinematics as ours and pinocchio's, torque balance at rest."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from support import elastic_arms
from support.elastic_arms import MujocoArm
from support.robots import KR270, random_chain_urdf

from elastocal.model.chain import Chain
from elastocal.model.rigid import nominal_flange
from elastocal.model.urdf import read_urdf

pytest.importorskip("mujoco")

# Table 3 of Klimchik et al. (2013) in rad/(N m); k1 is not in it, k2 near its first level.
COMPLIANCE = np.array([0.35, 0.29, 0.416, 2.786, 3.483, 2.074]) * 1e-6


@pytest.fixture(scope="module")
def kr270() -> Chain:
    return read_urdf(KR270)


def configurations(chain: Chain, count: int, seed: int = 0) -> np.ndarray:
    low = [max(joint.lower, -np.pi) for joint in chain.joints]
    high = [min(joint.upper, np.pi) for joint in chain.joints]
    return np.random.default_rng(seed).uniform(low, high, (count, chain.n_joints))


@pytest.mark.parametrize("seed", [None, *range(10)])
def test_kinematics_agree(tmp_path: Path, kr270: Chain, seed: int | None) -> None:
    chain = kr270
    if seed is not None:
        path = tmp_path / "chain.urdf"
        path.write_text(random_chain_urdf(seed))
        chain = read_urdf(path, base="base", flange="flange")
    marker = np.array([0.1, -0.2, 0.3])
    arm = MujocoArm(chain, np.ones(chain.n_joints), markers={"M1": marker})
    symbol = ca.SX.sym("q", chain.n_joints)
    ours = ca.Function("T", [symbol], [nominal_flange(chain, symbol)])
    for q in configurations(chain, 20):
        T = ours(q).full()
        np.testing.assert_allclose(arm.flange(q), T, rtol=0, atol=1e-12)
        expected = T[:3, :3] @ marker + T[:3, 3]
        np.testing.assert_allclose(arm.markers(q)["M1"], expected, rtol=0, atol=1e-12)


def test_it_is_independent_of_our_kinematics() -> None:
    lines = Path(str(elastic_arms.__file__)).read_text().splitlines()
    imported = {line.split()[1] for line in lines if line.startswith("from elastocal")}
    assert imported <= {"elastocal.errors", "elastocal.model.chain", "elastocal.units"}
