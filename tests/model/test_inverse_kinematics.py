"""Inverse kinematics: places an arm can reach are reached, the others told; posture and limits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from support.calibration import placement, random_chain
from support.cells import kr270_chain, nominal_flanges, random_poses
from support.robots import PACKAGED, packaged_urdf

from elastocal.model import Chain, Postures, nominal_flange, read_urdf
from elastocal.model.inverse_kinematics import inverse_kinematics

POINT = np.array([0.1, -0.05, 0.2])
ROBOTS = ["KR270", *PACKAGED]


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


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("oriented", [False, True])
def test_whatever_the_arm_reaches_is_reached(name: str, oriented: bool) -> None:
    chain = robot(name)
    position, rotation = places(chain, random_poses(chain, 40, seed=1))
    wanted = rotation if oriented else None
    found = inverse_kinematics(chain, position, limits(chain), rotation=wanted, point=POINT)
    assert len(found.out_of_reach) == 0
    assert found.reached[:, 0].all()
    check(chain, found, position, wanted)


@pytest.mark.parametrize("n", range(4, 10))
def test_four_to_nine_joints(n: int) -> None:
    chain = random_chain(seed=n, n=n)
    position, rotation = places(chain, random_poses(chain, 20, seed=2))
    # Four and five joints reach the rotations of their own postures, but few others.
    for wanted in (None, rotation):
        found = inverse_kinematics(chain, position, limits(chain), rotation=wanted, point=POINT)
        assert len(found.out_of_reach) == 0
        check(chain, found, position, wanted)


def test_a_prismatic_joint_slides() -> None:
    chain = random_chain(seed=3, n=6)
    slide = replace(chain.joints[1], kind="prismatic", lower=-0.2, upper=0.6)
    chain = replace(chain, joints=(chain.joints[0], slide, *chain.joints[2:]))
    position, rotation = places(chain, random_poses(chain, 20, seed=2))
    found = inverse_kinematics(chain, position, limits(chain), rotation=rotation, point=POINT)
    assert len(found.out_of_reach) == 0
    check(chain, found, position, rotation)


def test_different_starts_give_different_postures() -> None:
    """A spherical wrist flips: with the rotation prescribed there are at least two postures."""
    chain = kr270_chain()
    q = random_poses(chain, 10, seed=4)
    position, rotation = places(chain, q)
    found = inverse_kinematics(chain, position, limits(chain), rotation=rotation, point=POINT)
    for t in range(10):
        postures = found.q[t][found.reached[t]]
        apart = np.linalg.norm(postures[:, None] - postures[None], axis=2)
        assert (apart > 0.1).any()


@pytest.mark.parametrize("name", ["KR270", "Panda"])
def test_the_first_posture_is_the_nearest(name: str) -> None:
    """Against constrained minimisation (SLSQP) of the distance from many starts."""
    chain = robot(name)
    lower, upper = limits(chain)
    position, _ = places(chain, random_poses(chain, 6, seed=1), np.zeros(3))
    near = random_poses(chain, 1, seed=77)[0]
    found = inverse_kinematics(chain, position, (lower, upper), near=near)
    symbol = ca.SX.sym("q", chain.n_joints)
    place = nominal_flange(chain, symbol)[:3, 3]
    f = ca.Function("f", [symbol], [place])
    J = ca.Function("J", [symbol], [ca.jacobian(place, symbol)])
    starts = np.vstack([near, random_poses(chain, 6, seed=5)])
    for target, q in zip(position, found.q[:, 0], strict=True):
        reach: dict[str, Any] = {
            "type": "eq",
            "fun": lambda x, p=target: f(x).full().ravel() - p,
            "jac": lambda x: J(x).full(),
        }
        best = np.inf
        for start in starts:
            tried = minimize(
                lambda x: ((x - near) ** 2).sum(),
                start,
                jac=lambda x: 2 * (x - near),
                method="SLSQP",
                bounds=list(zip(lower, upper, strict=True)),
                constraints=reach,
            )
            if tried.success:
                best = min(best, float(np.sqrt(tried.fun)))
        assert np.linalg.norm(q - near) < best + 1e-3


def test_postures_come_in_order_of_distance() -> None:
    chain = kr270_chain()
    position, _ = places(chain, random_poses(chain, 10, seed=6))
    near = random_poses(chain, 1, seed=7)[0]
    found = inverse_kinematics(chain, position, limits(chain), point=POINT, near=near)
    for t in range(10):
        distance = np.linalg.norm(found.q[t] - near, axis=1)[found.reached[t]]
        assert (np.diff(distance) >= 0).all()
        assert found.reached[t, : len(distance)].all()


def test_joints_without_limits_stay_within_half_a_turn() -> None:
    chain = kr270_chain()
    free = tuple(replace(j, lower=-np.inf, upper=np.inf) for j in chain.joints)
    chain = replace(chain, joints=free)
    near = np.full(6, 20.0)
    position, rotation = places(chain, random_poses(chain, 10, seed=8))
    found = inverse_kinematics(
        chain, position, limits(chain), rotation=rotation, point=POINT, near=near
    )
    assert len(found.out_of_reach) == 0
    assert np.abs(found.q[found.reached] - near).max() <= np.pi + 1e-9
    check(chain, found, position, rotation)


def test_the_place_of_the_base_changes_nothing() -> None:
    chain = kr270_chain()
    position, rotation = places(chain, random_poses(chain, 10, seed=9))
    T = placement([3.0, -2.0, 0.5], Rotation.from_euler("xyz", [0.3, -0.2, 2.0]))
    here = inverse_kinematics(chain, position, limits(chain), rotation=rotation, point=POINT)
    there = inverse_kinematics(
        chain,
        position @ T[:3, :3].T + T[:3, 3],
        limits(chain),
        rotation=T[:3, :3] @ rotation,
        point=POINT,
        T_data_base=T,
    )
    np.testing.assert_allclose(there.q[:, 0], here.q[:, 0], atol=1e-6)


def test_one_rotation_stands_for_all_targets() -> None:
    chain = kr270_chain()
    down = Rotation.from_euler("y", np.pi).as_matrix()
    position = np.array([1.6, 0.0, 1.0]) + 0.2 * np.random.default_rng(0).normal(size=(5, 3))
    found = inverse_kinematics(chain, position, limits(chain), rotation=down, point=POINT)
    check(chain, found, position, np.broadcast_to(down, (5, 3, 3)))
    assert len(found.out_of_reach) == 0


@pytest.mark.parametrize("far", [5.0, 1e4, 1e300])
def test_what_is_out_of_reach_is_told_with_its_distance(far: float) -> None:
    """No drawn posture gets nearer, save for a hundred-thousandth of the distance."""
    chain = kr270_chain()
    position, _ = places(chain, random_poses(chain, 3, seed=1))
    position[1] = [0.0, 0.0, far]
    found = inverse_kinematics(chain, position, limits(chain), point=POINT)
    assert found.out_of_reach.tolist() == [1]
    drawn, _ = places(chain, random_poses(chain, 20_000, seed=2))
    goal = [0, 0, min(far, 1e6)]
    assert found.miss[1, 0] <= np.linalg.norm(drawn - goal, axis=1).min() * (1 + 1e-5)
    at, _ = places(chain, found.q[1, :1])
    assert found.miss[1, 0] == pytest.approx(np.linalg.norm(at[0] - goal))


def test_a_rotation_out_of_reach_is_told_with_its_angle() -> None:
    """With its wrist held, the arm reaches the place but not the rotation."""
    chain = kr270_chain()
    held = tuple(replace(j, lower=-0.01, upper=0.01) for j in chain.joints[3:])
    chain = replace(chain, joints=(*chain.joints[:3], *held))
    position, rotation = places(chain, random_poses(chain, 4, seed=1))
    tilted = rotation @ Rotation.from_euler("x", 0.5).as_matrix()
    found = inverse_kinematics(chain, position, limits(chain), rotation=tilted, point=POINT)
    assert found.out_of_reach.tolist() == [0, 1, 2, 3]
    at, turned = places(chain, found.q[:, 0])
    np.testing.assert_allclose(found.miss[:, 0], np.linalg.norm(at - position, axis=1), atol=1e-12)
    angle = Rotation.from_matrix(turned.transpose(0, 2, 1) @ tilted).magnitude()
    np.testing.assert_allclose(found.turn[:, 0], angle, atol=1e-9)


def test_the_same_seed_gives_the_same_postures() -> None:
    chain = kr270_chain()
    position, _ = places(chain, random_poses(chain, 5, seed=1))
    one, same, other = (
        inverse_kinematics(chain, position, limits(chain), seed=seed).q for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


def test_targets_do_not_depend_on_their_company() -> None:
    """Many targets are solved in blocks; each as if it stood alone."""
    chain = kr270_chain()
    position, _ = places(chain, random_poses(chain, 520, seed=1))
    together = inverse_kinematics(chain, position, limits(chain), point=POINT)
    assert len(together.out_of_reach) == 0
    for t in (0, 499, 500, 519):
        alone = inverse_kinematics(chain, position[t : t + 1], limits(chain), point=POINT)
        np.testing.assert_allclose(alone.q[0, 0], together.q[t, 0], atol=1e-9)
