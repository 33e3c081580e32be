"""Inverse kinematics: places an arm can reach are reached, the others told; posture and limits."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from support.cells import kr270_chain, nominal_flanges, random_poses
from support.robots import packaged_urdf

from elastocal.model.chain import Chain, finite_ranges
from elastocal.model.rigid import Postures, inverse_kinematics
from elastocal.model.urdf import read_urdf

POINT = np.array([0.1, -0.05, 0.2])
ROBOTS = ["KR270", "UR5", "Panda", "iiwa14"]


def robot(name: str) -> Chain:
    if name == "KR270":
        return kr270_chain()
    path, flange = packaged_urdf(name)
    return read_urdf(path, flange=flange)


def limits(chain: Chain) -> tuple[NDArray, NDArray]:
    return np.array([j.lower for j in chain.joints]), np.array([j.upper for j in chain.joints])


def places(chain: Chain, q: NDArray, point: NDArray = POINT) -> tuple[NDArray, NDArray]:
    T = nominal_flanges(chain, q)
    return T[:, :3, :3] @ point + T[:, :3, 3], T[:, :3, :3]


def check(chain: Chain, found: Postures, position: NDArray, rotation: NDArray | None) -> None:
    """Every posture told as reached is inside the limits and at its target."""
    lower, upper = limits(chain)
    t, k = np.nonzero(found.reached)
    q = found.q[t, k]
    assert (q >= lower).all()
    assert (q <= upper).all()
    at, turned = places(chain, q)
    np.testing.assert_allclose(at, position[t], atol=1.1e-6)
    if rotation is not None:
        off = Rotation.from_matrix(turned.transpose(0, 2, 1) @ rotation[t]).magnitude()
        assert off.max() < 1.1e-6


@pytest.mark.parametrize(
    ("name", "oriented"), [*((name, True) for name in ROBOTS), ("KR270", False), ("Panda", False)]
)
def test_whatever_the_arm_reaches_is_reached(name: str, oriented: bool) -> None:
    chain = robot(name)
    position, rotation = places(chain, random_poses(chain, 20, seed=1))
    wanted = rotation if oriented else None
    found = inverse_kinematics(chain, position, limits(chain), rotation=wanted, point=POINT)
    assert len(found.out_of_reach) == 0
    assert found.reached[:, 0].all()
    check(chain, found, position, wanted)


def test_the_nearest_posture_comes_first() -> None:
    chain, near = kr270_chain(), random_poses(kr270_chain(), 1, seed=77)[0]
    place = places(chain, random_poses(chain, 6, seed=1))
    found = inverse_kinematics(chain, place[0], limits(chain), rotation=place[1], near=near,
                               point=POINT)  # fmt: skip
    for q, reached in zip(found.q, found.reached, strict=True):
        away = np.linalg.norm(q[reached] - near, axis=1)
        assert len(away) > 1 and (np.diff(away) >= 0).all()


@pytest.mark.parametrize("far", [5.0, 1e300])
def test_what_is_out_of_reach_is_told_with_its_distance(far: float) -> None:
    """No drawn posture gets nearer, save for a hundred-thousandth of the distance."""
    chain = kr270_chain()
    position, _ = places(chain, random_poses(chain, 3, seed=1))
    position[1] = [0.0, 0.0, far]
    found = inverse_kinematics(chain, position, limits(chain), point=POINT)
    assert found.out_of_reach.tolist() == [1]
    drawn, _ = places(chain, random_poses(chain, 5000, seed=2))
    goal = [0, 0, min(far, 1e6)]
    assert found.miss[1, 0] <= np.linalg.norm(drawn - goal, axis=1).min() * (1 + 1e-5)
    at, _ = places(chain, found.q[1, :1])
    assert found.miss[1, 0] == pytest.approx(np.linalg.norm(at[0] - goal))


def test_a_range_without_an_end_is_a_turn_from_the_other() -> None:
    """1e16 is none, as files write it; without both ends it lies about the middle."""
    chain = kr270_chain()
    lower = np.array([-np.inf, -1e16, -0.5, -np.inf, -1.0, -9.0])
    upper = np.array([0.5, 0.5, np.inf, 1e16, 1.0, 9.0])
    low, high = finite_ranges(chain, lower, upper)
    turn = 2 * np.pi
    np.testing.assert_allclose(low, [0.5 - turn, 0.5 - turn, -0.5, -np.pi, -1.0, -9.0])
    np.testing.assert_allclose(high, [0.5, 0.5, turn - 0.5, np.pi, 1.0, 9.0])
