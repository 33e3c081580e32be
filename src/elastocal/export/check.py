"""What was written is read back, by the library that users read it with, before it is kept."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import casadi as ca
import numpy as np

from elastocal.cell import Array
from elastocal.errors import ElastocalError
from elastocal.export.cost import random_table
from elastocal.export.kept import Kept
from elastocal.export.mujoco_rest import MujocoRest
from elastocal.export.pieces import Pieces
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.rigid import nominal_flange

LARGEST = 1e-8  # m; a hundred times the rounding of a chain of a few metres
# Origin and points 0.1 m along the flange's axes, homogeneous (4, 4).
CORNERS = np.vstack([np.hstack([np.zeros((3, 1)), 0.1 * np.eye(3)]), np.ones((1, 4))])
LARGEST_AT_REST = 1e-6  # m


def flanges(chain: Chain, q: Array) -> Array:
    """T_base_flange (n, 4, 4) of a chain at joint values q (n, joints)."""
    symbol = ca.SX.sym("q", chain.n_joints)
    function = ca.Function("flange", [symbol], [nominal_flange(chain, symbol)])
    return np.array([function(row).full() for row in q])


def check_chain(
    text: str,
    ending: str,
    read: Callable[[Path], Chain],
    chain: Chain,
    kept: Kept,
    seed: int,
    largest: float | None = LARGEST,
) -> float:
    """Largest distance in m between the flange of the written text, read back, and `chain`'s: of
    its origin and of points on its axes, so that its orientation counts.

    Raises ElastocalError where it is more than `largest` (None: any will do).
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"written{ending}"
        path.write_text(text, encoding="utf-8", newline="\n")
        back = read(path)
    q = random_table(kept.full.model, kept.conditions, 100, seed).q
    apart = (flanges(back, q) - flanges(chain, q))[:, :3] @ CORNERS
    worst = float(np.linalg.norm(apart, axis=1).max())
    return worst if largest is None else _accepted(worst, largest)


def check_rest(
    mjcf: str, pieces: Pieces, kept: Kept, base_frame: bool, poses: int, seed: int
) -> float:
    """Largest distance in m of flange and markers between MuJoCo at rest and the exported model.

    Raises InputError where MuJoCo is not installed, ElastocalError where they differ.
    """
    arm = MujocoRest(mjcf)
    part, force = kept.exported, kept.conditions.force
    table = random_table(kept.full.model, kept.conditions, poses, seed)
    expected = part.model.flange_poses(table, part.x)
    if not base_frame:
        expected = np.linalg.inv(pieces.T_tracker_base) @ expected
    names = ["flange", *(f"marker_{name}" for name in pieces.markers)]
    points = np.array([np.zeros(3), *(T[:3, 3] for T in pieces.markers.values())])
    worst = 0.0
    for q, T in zip(table.q, expected, strict=True):
        if np.isfinite(T).all():
            found = arm.sites(q, force, names)
            away = found - (points @ T[:3, :3].T + T[:3, 3])
            worst = max(worst, float(np.linalg.norm(away, axis=1).max()))
    return _accepted(worst, LARGEST_AT_REST)


def _accepted(distance: float, largest: float) -> float:
    if not distance <= largest:
        raise ElastocalError(
            f"the written file, read back, is {distance * 1e6:.3g} µm from the model and was not "
            "kept; please report this robot description"
        )
    return distance
