"""Our CasADi chain against pinocchio reading the original file, unreduced."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.cells import kr270_cell, random_poses
from support.robots import KR270, PACKAGED, packaged_urdf, random_chain_urdf

from elastocal.cell import Cell
from elastocal.cell_tables import Nominal
from elastocal.model.chain import Chain
from elastocal.model.rigid import nominal_flanges, nominal_frames
from elastocal.model.urdf import read_urdf


class Reference:
    """pinocchio on the whole file: T_base_flange and gravity torques by joint name."""

    def __init__(self, model: pin.Model, chain: Chain, base: str, flange: str) -> None:
        self.model, self.data, self.chain = model, model.createData(), chain
        self.base = model.getFrameId(base, pin.FrameType.BODY)
        self.flange = model.getFrameId(flange, pin.FrameType.BODY)
        self.ids = [model.getJointId(joint.name) for joint in chain.joints]

    def configuration(self, q: np.ndarray) -> np.ndarray:
        full = pin.neutral(self.model)
        for joint_id, value in zip(self.ids, q, strict=True):
            joint = self.model.joints[joint_id]
            wide = joint.nq == 2
            full[joint.idx_q : joint.idx_q + joint.nq] = (
                [np.cos(value), np.sin(value)] if wide else [value]
            )
        return full

    def T_base_flange(self, q: np.ndarray) -> np.ndarray:
        pin.framesForwardKinematics(self.model, self.data, self.configuration(q))
        frames = self.data.oMf
        return frames[self.base].actInv(frames[self.flange]).homogeneous

    def gravity_torques(self, q: np.ndarray) -> np.ndarray:
        tau = pin.computeGeneralizedGravity(self.model, self.data, self.configuration(q))
        return np.array([tau[self.model.joints[i].idx_v] for i in self.ids])


def standing_arm(tmp_path: Path, seed: int) -> tuple[Chain, Cell, Reference]:
    """A random arm, a cell where it stands as its file says, and pinocchio's."""
    text = random_chain_urdf(seed)
    path = tmp_path / "chain.urdf"
    path.write_text(text)
    chain = read_urdf(path, base="base", flange="flange")
    reference = Reference(pin.buildModelFromXML(text), chain, "base", "flange")
    reference.T_base_flange(np.zeros(chain.n_joints))
    standing = np.array(reference.data.oMf[reference.base].rotation)
    return chain, kr270_cell(nominal=Nominal(base_rotation=standing)), reference


def gravity_torques(chain: Chain, gravity: np.ndarray):
    """q → ∂V/∂q of the chain's lumped masses, gravity (3,) in the base frame."""
    q = ca.SX.sym("q", chain.n_joints)
    V = ca.SX(0)
    for i, body in enumerate(chain.masses):
        upto = Chain("part", chain.joints[: i + 1], np.eye(4))
        T = nominal_frames(upto, q[: i + 1], ca.SX.eye(4))[-1]
        V -= body.mass * ca.dot(ca.DM(gravity), T[:3, :3] @ ca.DM(body.com) + T[:3, 3])
    return ca.Function("tau", [q], [ca.gradient(V, q)])


def assert_agrees(chain: Chain, reference: Reference, count: int) -> None:
    q = random_poses(chain, count, seed=1)
    expected = [reference.T_base_flange(each) for each in q]
    np.testing.assert_allclose(nominal_flanges(chain, q), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", [*PACKAGED, "KR 270-2"])
def test_known_robots_agree_to_1e12(name: str) -> None:
    path, flange = (KR270, None) if name == "KR 270-2" else packaged_urdf(name)
    chain = read_urdf(path, flange=flange)
    model = pin.buildModelFromUrdf(str(path))
    assert chain.n_joints == (7 if name in ("Panda", "iiwa14") else 6)
    root = model.frames[1].name
    flange = flange or ("flange" if name == "KR 270-2" else "tool0")
    assert_agrees(chain, Reference(model, chain, root, flange), count=200)


@given(seed=st.integers(0, 2**32 - 1), from_base=st.booleans())
@settings(max_examples=40, deadline=None)
def test_random_chains_agree_to_1e12(tmp_path_factory, seed: int, from_base: bool) -> None:
    text = random_chain_urdf(seed, n_joints=None if from_base else 4 + seed % 5)
    path = tmp_path_factory.mktemp("random") / "chain.urdf"
    path.write_text(text)
    base = "base" if from_base else "root"
    chain = read_urdf(path, base=base, flange="flange")
    reference = Reference(pin.buildModelFromXML(text), chain, base, "flange")
    assert_agrees(chain, reference, count=5)


@pytest.mark.parametrize("seed", range(4))
def test_lumped_masses_weigh_the_same(tmp_path: Path, seed: int) -> None:
    """Gravity torques of the lumped masses equal those of all bodies, branches included."""
    chain, cell, reference = standing_arm(tmp_path, seed)
    standing = cell.model.nominal.base_rotation
    tau = gravity_torques(chain, standing.T @ reference.model.gravity.linear)
    for q in random_poses(chain, 5, seed):
        expected = reference.gravity_torques(q)
        np.testing.assert_allclose(tau(q).full().ravel(), expected, rtol=0, atol=1e-9)
