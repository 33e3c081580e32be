"""The UR10 of fits_peers.py: its nominal table, a true arm, campaigns, and the files each reads.

Nominal lengths are those of pybotics' own UR10, in modified Denavit–Hartenberg convention, so that
one table states the same arm exactly to all three: T_i = Rx(α) Tx(a) Rz(θ + q) Tz(d).  The true
arm is computed here, by no code of the three.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# α rad, a m, θ rad, d m
NOMINAL = np.array(
    [
        [0, 0, 0, 0.118],
        [np.pi / 2, 0, np.pi, 0],
        [0, 0.6127, 0, 0],
        [0, 0.5716, 0, 0.1639],
        [-np.pi / 2, 0, 0, 0.1157],
        [np.pi / 2, 0, np.pi, 0.0922],
    ]
)
LENGTH, ANGLE, OFFSET = 0.5e-3, 1e-3, 3e-3  # errors of the true arm, 1σ: m, rad, rad
NOISE = 50e-6  # of one coordinate of a reading, m
BASE = (1.2, -0.8, 0.4), (0.6, -0.02, 0.03)  # of the arm in the tracker's frame: m, ZYX angles rad
MARKER = (0.1, 0.05, 0.1)  # in the flange frame, m: off the last axis
FRESH = 500  # poses that no fit sees
TRUTHS = ("mdh", "full")
JOINTS = [f"joint{i + 1}" for i in range(len(NOMINAL))]


@dataclass(frozen=True)
class Campaign:
    """Joint angles q (n, 6) rad and readings (n, 3) m; fresh poses, exact and as read."""

    q: Array
    points: Array
    fresh_q: Array
    fresh_exact: Array
    fresh_read: Array


def campaign(truth: str, poses: int, seed: int) -> Campaign:
    """Random poses of an arm with errors drawn for this seed, read with independent noise.

    `truth` "mdh": the 24 numbers of the table are wrong, which all three models can express;
    "full": every joint is displaced in all six directions, as joints of real arms are.  Arm and
    fresh poses depend on the seed alone, and fewer poses are the first of more.
    """
    arm, fresh, posed, read = (np.random.default_rng([seed, k]) for k in range(4))
    placements = _placements(truth, arm)
    q, fresh_q = posed.uniform(-np.pi, np.pi, (poses, 6)), fresh.uniform(-np.pi, np.pi, (FRESH, 6))
    points = marker_positions(placements, q) + NOISE * read.normal(size=(poses, 3))
    exact = marker_positions(placements, fresh_q)
    return Campaign(q, points, fresh_q, exact, exact + NOISE * fresh.normal(size=(FRESH, 3)))


def _placements(truth: str, rng: np.random.Generator) -> Array:
    """True placements (6, 4, 4) of the joints in their parents' frames, at q = 0."""
    table = np.array([ANGLE, LENGTH, OFFSET, LENGTH]) * rng.normal(size=NOMINAL.shape)
    shift = np.array([LENGTH] * 3 + [ANGLE, ANGLE, OFFSET]) * rng.normal(size=(6, 6))
    if truth == "mdh":
        return np.stack([placement(row) for row in NOMINAL + table])
    return np.stack([placement(row) @ _pose(s[:3], Rotation.from_rotvec(s[3:]))
                     for row, s in zip(NOMINAL, shift, strict=True)])  # fmt: skip


def placement(row: Array) -> Array:
    """Rx(α) Tx(a) Rz(θ) Tz(d) (4, 4)."""
    alpha, a, theta, d = row
    turn = _pose(np.zeros(3), Rotation.from_euler("x", alpha))
    return turn @ _pose(np.array([a, 0, d]), Rotation.from_euler("z", theta))


def marker_positions(placements: Array, q: Array) -> Array:
    """Where the tracker sees the marker (n, 3), in m, at joint angles q (n, 6)."""
    T = np.broadcast_to(_pose(np.array(BASE[0]), Rotation.from_euler("ZYX", BASE[1])),
                        (len(q), 4, 4))  # fmt: skip
    for i, own in enumerate(placements):
        turn = np.broadcast_to(np.eye(4), (len(q), 4, 4)).copy()
        turn[:, :3, :3] = Rotation.from_euler("z", q[:, i : i + 1]).as_matrix()
        T = T @ own @ turn
    return T[:, :3, :3] @ np.array(MARKER) + T[:, :3, 3]


def _pose(translation: Array, rotation: Rotation) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), translation
    return T


def write(found: Campaign, folder: Path) -> None:
    """arm.urdf, cell.toml and data.csv for elastocal; FIGAROH's readings.csv; all in given.npz."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.urdf").write_text(urdf(), encoding="utf-8")
    (folder / "cell.toml").write_text(CELL, encoding="utf-8")
    head = ",".join([*(f"q{i + 1}_rad" for i in range(6)), "x_m", "y_m", "z_m"])
    rows = np.hstack([found.q, found.points])
    np.savetxt(folder / "data.csv", rows, "%.17g", ",", header=head, comments="")
    head = ",".join([*JOINTS, "x1", "y1", "z1"])
    np.savetxt(folder / "readings.csv", rows, "%.17g", ",", header=head, comments="")
    np.savez(
        folder / "given.npz", q=found.q, points=found.points, fresh_q=found.fresh_q,
        table=NOMINAL, base=np.concatenate(BASE), marker=np.array(MARKER),
    )  # fmt: skip


def urdf() -> str:
    """The nominal arm as URDF, with the flange's frame of the last joint as link `flange`."""
    links = ["base", *(f"link{i + 1}" for i in range(5)), "flange"]
    lines = ['<robot name="ur10">', *(f'  <link name="{name}"/>' for name in links)]
    for i, name in enumerate(JOINTS):
        T = placement(NOMINAL[i])
        xyz = " ".join(repr(float(v)) for v in T[:3, 3])
        angles = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
        rpy = " ".join(repr(float(v)) for v in angles)
        lines += [
            f'  <joint name="{name}" type="revolute">',
            f'    <parent link="{links[i]}"/><child link="{links[i + 1]}"/>',
            f'    <origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/>',
            f'    <limit lower="{-np.pi}" upper="{np.pi}" effort="100" velocity="1"/>',
            "  </joint>",
        ]
    return "\n".join([*lines, "</robot>", ""])


CELL = """[robot]
urdf = "arm.urdf"
base = "base"
flange = "flange"

[tool.markers_m]
M1 = [0, 0, 0]

[model]
observe = "position"
effects = ["base_frame", "joint_offset", "link_geometry", "marker_position"]
"""
