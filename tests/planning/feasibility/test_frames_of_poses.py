"""Frames: those of the CasADi model and of pinocchio; what hangs stays upright."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning.feasibility.small_cells import DOWN, KR270_CHAIN, cell
from scipy.spatial.transform import Rotation
from support.robots import random_chain_urdf

from elastocal.cell.arm_description import Nominal, Tool
from elastocal.cell.workspace_rules import Workspace
from elastocal.model import read_urdf
from elastocal.planning import Kinematics, arm_configuration, arm_model
from elastocal.planning.bodies import HANGING, WORLD

LOAD_POINT = np.array([0.2, -0.1, 0.25])


def placed_cell(seed: int):
    rng = np.random.default_rng(seed)
    nominal = Nominal(
        base_position=rng.normal(size=3), base_rotation=Rotation.random(rng=rng).as_matrix()
    )
    plain = cell(Workspace(), Tool(LOAD_POINT, {"M1": np.zeros(3)}))
    return replace(plain, model=replace(plain.model, nominal=nominal))


def random_chain(seed: int, folder):
    path = folder / f"{seed}.urdf"
    path.write_text(random_chain_urdf(seed))
    return read_urdf(path, base="base", flange="flange")


@pytest.mark.parametrize("seed", range(4))
def test_the_collision_model_stands_in_the_same_frames(seed, tmp_path):
    """Every joint of the pinocchio model, the hanging one included, at every carrier's frame."""
    chain, given_cell = random_chain(seed, tmp_path), placed_cell(seed)
    q = np.random.default_rng(seed).uniform(-2, 2, (20, chain.n_joints))
    kinematics = Kinematics(given_cell, chain)
    poses = kinematics.poses(q, DOWN)
    model = arm_model(kinematics)
    data = model.createData()
    for configuration, frames in zip(arm_configuration(poses), poses.frames, strict=True):
        pin.forwardKinematics(model, data, configuration)
        for i in range(chain.n_joints + 1):
            assert np.allclose(data.oMi[i + 1].homogeneous, frames[i], atol=1e-9)


@settings(deadline=None)
@given(st.lists(st.floats(-6, 6), min_size=6, max_size=6))
def test_what_hangs_is_upright_at_the_load_point(q):
    poses = Kinematics(placed_cell(1), KR270_CHAIN).poses(np.array([q]), DOWN)
    hanging = poses.frames[0, HANGING]
    assert np.allclose(hanging[:3, :3], np.eye(3))
    assert np.allclose(hanging[:3, 3], (poses.flange[0] @ [*LOAD_POINT, 1.0])[:3])
    assert np.allclose(poses.frames[0, WORLD], np.eye(4))
