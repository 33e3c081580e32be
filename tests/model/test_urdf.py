"""read_urdf: the chain it returns."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from support.robots import KR270
from support.urdf_text import LIMIT, arm, joint, link

from elastocal.model.rigid import nominal_flange
from elastocal.model.urdf import read_urdf


def read(tmp_path: Path, text: str, base: str | None = None, flange: str | None = None):
    path = tmp_path / "arm.urdf"
    path.write_text(text, encoding="utf-8")
    return read_urdf(path, base, flange)


def flange_at(chain, q) -> np.ndarray:
    symbol = ca.SX.sym("q", chain.n_joints)
    return ca.Function("T", [symbol], [nominal_flange(chain, symbol)])(q).full()


def test_kr270_upright_pose_and_limits() -> None:
    """A2 = −90°, A3 = +90°: link arm up, forearm level; A1 = +90° turns it towards −y."""
    chain = read_urdf(KR270)
    p = flange_at(chain, np.radians([90, -90, 90, 0, 0, 0]))[:3, 3]
    np.testing.assert_allclose(p, [0, -(0.35 + 1.1 + 0.23), 0.75 + 1.25 - 0.055], atol=1e-15)
    limits = np.degrees([(j.lower, j.upper) for j in chain.joints])
    expected = [[-185, 185], [-146, 0], [-119, 155], [-350, 350], [-125, 125], [-350, 350]]
    np.testing.assert_allclose(limits, expected, atol=1e-12)
    axes = [[0, 0, -1], [0, 1, 0], [0, 1, 0], [-1, 0, 0], [0, 1, 0], [-1, 0, 0]]
    np.testing.assert_array_equal([j.axis for j in chain.joints], axes)
    assert sum(body.mass for body in chain.masses) == pytest.approx(1100 - 270)


def test_kinds_limits_and_default_axis(tmp_path: Path) -> None:
    spin = joint("q2", "l1", "l2", "continuous", '<axis xyz="0 3 4"/>')
    slide = joint("q3", "l2", "l3", "prismatic", '<axis xyz="0 0 -2"/>' + LIMIT)
    text = arm(replace={joint("q2", "l1", "l2"): spin, joint("q3", "l2", "l3"): slide})
    chain = read(tmp_path, text)
    assert chain.name == "arm"
    assert [j.name for j in chain.joints] == ["q1", "q2", "q3", "q4"]
    assert chain.kinds == ("revolute", "revolute", "prismatic", "revolute")
    np.testing.assert_allclose(chain.joints[0].axis, [1, 0, 0])  # URDF's default
    np.testing.assert_allclose(chain.joints[1].axis, [0, 0.6, 0.8])
    np.testing.assert_allclose(chain.joints[2].axis, [0, 0, -1])
    assert (chain.joints[0].lower, chain.joints[0].upper) == (-1, 2)
    assert (chain.joints[1].lower, chain.joints[1].upper) == (-np.inf, np.inf)
    assert chain.masses == ()


def test_masses_are_lumped_into_the_joint_that_carries_them(tmp_path: Path) -> None:
    side = link("side", 2.0, "0 0 1") + joint("s", "l4", "side", "prismatic")
    beyond = link("tool", 2.0, "1 0 -1") + joint("t", "l4", "tool", "fixed", "")
    text = arm(extra=side + beyond, replace={link("l0"): link("l0", 100.0)})
    chain = read(tmp_path, text, flange="l4")
    assert [body.mass for body in chain.masses] == [0, 0, 0, 4.0]
    np.testing.assert_allclose(chain.masses[3].com, [0.5, 0, 1.0])


def test_namespaces_gazebo_and_strange_names_are_harmless(tmp_path: Path) -> None:
    noise = '<gazebo><joint name="q1"/></gazebo><transmission name="t"><joint name="q1"/>'
    text = arm(extra=noise + "</transmission>", replace={'<robot name="arm">': "<robot>"})
    text = text.replace("<robot>", '<robot xmlns="http://x" xmlns:xacro="http://wiki/xacro">')
    text = text.replace('"l0"', '"universe"').replace('"l4"', '"a &lt; ü/1"')
    chain = read(tmp_path, text)
    assert (chain.n_joints, chain.name) == (4, "arm")
