"""Bending and torsion of links, tilt of the base."""

from __future__ import annotations

import numpy as np
import pytest
from model.effects.stick import model, positions, rows, stick
from scipy.optimize import brentq
from support.cells import kr270_chain

from elastocal.model.effects.compliances import link_axes

K, F, LEVER = 1e-5, 400.0, 0.5


def settled(lever: float) -> float:
    """θ = k F l cos θ: the moment of a dead force at the deflected lever."""
    return brentq(lambda t: t - K * F * lever * np.cos(t), 0.0, 0.1, xtol=1e-16)


@pytest.mark.parametrize("axis", "yz")
def test_a_link_bends_under_a_force_beyond_its_end(axis: str) -> None:
    """Rotation at the link's end: the tip sinks by the lever times the angle it sees."""
    m = model(stick("z", (2.0,)), "link_bending:link1", tip=(LEVER, 0, 0))
    force = (0.0, 0.0, -F) if axis == "y" else (0.0, F, 0.0)
    tip = positions(m, rows([0.0], force), **{f"bending_{axis}": K})[0]
    theta = settled(LEVER)
    down = np.array([0, 0, -1.0]) if axis == "y" else np.array([0, 1.0, 0])
    expected = np.array([2.0, 0, 0]) + LEVER * (
        np.cos(theta) * np.array([1, 0, 0]) + np.sin(theta) * down
    )
    np.testing.assert_allclose(tip, expected, atol=1e-14)
    other = positions(m, rows([0.0], force), **{"bending_z" if axis == "y" else "bending_y": K})
    np.testing.assert_allclose(other, [[2.5, 0, 0]], atol=1e-14)


def test_a_link_twists_under_a_force_beside_it() -> None:
    m = model(stick("z", (2.0,)), "link_bending:link1", tip=(0, LEVER, 0))
    tip = positions(m, rows([0.0], (0.0, 0.0, -F)), torsion=K)[0]
    theta = settled(LEVER)
    np.testing.assert_allclose(
        tip, [2.0, LEVER * np.cos(theta), -LEVER * np.sin(theta)], atol=1e-14
    )


def test_torsion_is_about_the_line_between_the_links_joints() -> None:
    """A right-handed set in the distal frame, whatever its orientation; the joint's axis where
    both frames coincide."""
    chain = kr270_chain()
    for i in range(6):
        axes = link_axes(chain, i)
        frame = np.array([axes["torsion"], axes["bending_y"], axes["bending_z"]])
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(frame) == pytest.approx(1)
        last = i == chain.n_joints - 1
        T = chain.flange_placement if last else chain.joints[i + 1].placement
        own = T[:3, :3] @ axes["torsion"]
        length = np.linalg.norm(T[:3, 3])
        expected = T[:3, 3] / length if length > 1e-6 else chain.joints[i].axis
        np.testing.assert_allclose(own, expected, atol=1e-12)


def test_the_base_tilts_under_the_overturning_moment() -> None:
    m = model(stick("z", (2.0,)), "base_compliance")
    z = positions(m, rows([0.0, np.pi / 2], (0.0, 0.0, -F)), tilt_compliance_y=1e-6)[:, 2]
    theta = brentq(lambda t: t - 1e-6 * F * 2 * np.cos(t), 0.0, 0.1, xtol=1e-16)
    np.testing.assert_allclose(z, [-2 * np.sin(theta), 0.0], atol=1e-14)
