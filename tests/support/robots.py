"""Robots to test with: URDFs from PyPI packages, and random serial chains as URDF text."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

KR270 = Path(__file__).parents[2] / "src" / "elastocal" / "demo" / "kr270_2.urdf"

# name → (distribution, end of the file's path, flange link or None)
PACKAGED = {
    "UR5": ("example-robot-data", "ur_description/urdf/ur5_robot.urdf", "tool0"),
    "UR10": ("example-robot-data", "ur_description/urdf/ur10_robot.urdf", "tool0"),
    "Panda": ("example-robot-data", "panda_description/urdf/panda.urdf", "panda_hand_tcp"),
    "iiwa14": ("rtb-data", "kuka_lbr_iiwa/urdf/lbr_iiwa_14_r820.urdf", None),
    "KR210": ("rtb-data", "kuka_kr210/urdf/kr210l150.urdf", None),
    "IRB140": ("rtb-data", "abb_irb140_description/urdf/irb140.urdf", None),
}


def packaged_urdf(name: str) -> tuple[Path, str | None]:
    """(URDF path, flange) of a robot in PACKAGED; skips the test where its package is missing."""
    package, ending, flange = PACKAGED[name]
    try:
        distribution = metadata.distribution(package)
    except metadata.PackageNotFoundError:
        pytest.skip(f"{name}: package {package} is not installed")
    for file in distribution.files or ():
        if str(file).endswith(ending):
            return Path(str(distribution.locate_file(file))), flange
    pytest.skip(f"{name}: {package} {distribution.version} has no {ending}")


def random_chain_urdf(seed: int, n_joints: int | None = None) -> str:
    """A random tree with links `base` and `flange` and 4…9 moving joints between them.

    Revolute, prismatic and continuous joints about aligned, negative and oblique axes of any
    length, fixed joints in between, side branches (moving ones too), and joints above `base`.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 10)) if n_joints is None else n_joints
    parts = [_link(rng, "root"), _link(rng, "base")]
    parts.append(_joint(rng, "above", "revolute", "root", "base"))
    last = "base"
    for i in range(1, n + 1):
        if rng.random() < 0.4:
            parts += [_link(rng, f"rigid{i}"), _joint(rng, f"f{i}", "fixed", last, f"rigid{i}")]
            last = f"rigid{i}"
        if rng.random() < 0.4:
            kind = rng.choice(["revolute", "prismatic", "continuous", "fixed", "floating"])
            parts += [_link(rng, f"side{i}"), _joint(rng, f"s{i}", kind, last, f"side{i}")]
        kind = rng.choice(["revolute", "prismatic", "continuous"])
        parts += [_link(rng, f"link{i}"), _joint(rng, f"q{i}", kind, last, f"link{i}")]
        last = f"link{i}"
    parts += [_link(rng, "flange"), _joint(rng, "end", "fixed", last, "flange")]
    order = rng.permutation(len(parts))
    return f'<robot name="random{seed}">' + "".join(parts[k] for k in order) + "</robot>"


def _link(rng: np.random.Generator, name: str) -> str:
    if rng.random() < 0.2:
        return f'<link name="{name}"/>'
    com, mass = _text(rng.uniform(-0.5, 0.5, 3)), rng.uniform(0.1, 50.0)
    return (
        f'<link name="{name}"><inertial><mass value="{mass!r}"/><origin xyz="{com}"/>'
        '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
    )


def _joint(rng: np.random.Generator, name: str, kind: str, parent: str, child: str) -> str:
    if rng.random() < 0.6:
        axis = np.eye(3)[rng.integers(3)] * rng.choice([-1.0, 1.0])
    else:
        axis = rng.normal(size=3)
    xyz, rpy = _text(rng.uniform(-1, 1, 3)), _text(rng.uniform(-np.pi, np.pi, 3))
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{_text(axis)}"/>'
        '<limit lower="-3.0" upper="3.0" effort="1" velocity="1"/></joint>'
    )


def _text(vector: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in vector)
