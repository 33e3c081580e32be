"""The arm of the benchmarks: the demo's KR 270 with errors of its geometry."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

import numpy as np

from elastocal.measurements import Measurements
from elastocal.model.chain import finite_ranges, joint_limits
from elastocal.model.manipulator import Model
from elastocal.simulation import draw_errors, values_from

GEOMETRY = ("base_frame", "joint_offset", "link_geometry", "marker_position")
SEED = 1


def kr270(folder: Path) -> Model:
    """The demo's KR 270 with one marker."""
    path = folder / "kr270.toml"
    urdf = files("elastocal.demo") / "kr270_2.urdf"
    path.write_text(
        f'[robot]\nurdf = "{urdf}"\nbase = "base_link"\nflange = "flange"\n'
        "[tool]\nload_point_m = [0.20, 0.0, 0.25]\n[tool.markers_m]\nM1 = [0.332, -0.138, -0.175]\n"
        f"[tracker]\nsigma_um = 10\n[model]\neffects = {json.dumps(GEOMETRY)}\n"
    )
    return Model(path)


def truth(model: Model) -> np.ndarray:
    """Parameters off their nominal values by one typical size, a base set up anywhere."""
    drawn = draw_errors(model, 1.0, np.random.default_rng(SEED))
    base = {"base.x": 2.0, "base.y": -1.0, "base.z": 0.5, "base.rz": 2.0}
    return values_from(model, drawn | base)


def poses(model: Model, n: int) -> Measurements:
    """n rows at random joint angles, positions zero."""
    rng = np.random.default_rng([SEED, n])
    low, high = finite_ranges(model.chain, *joint_limits(model.cell, model.chain))
    q = rng.uniform(low, high, (n, len(low)))
    (marker,) = model.cell.tool.markers
    return Measurements.of_poses("poses", q, np.zeros(3), marker, position=np.zeros((n, 3)))
