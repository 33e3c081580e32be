"""Arms of the benchmarks: the demo's KR 270 with chosen effects, chains of six to nine joints."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

import numpy as np

from elastocal.cell.work_cell import read_cell
from elastocal.measurements import Measurements
from elastocal.model.chain import finite_ranges, joint_limits
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import Model

GEOMETRY = ("base_frame", "joint_offset", "link_geometry", "marker_position")
LOAD_N = (0.0, 0.0, -2600.0)
SEED = 1


def kr270(folder: Path, effects: Sequence[str], more: str = "", markers: int = 1) -> Model:
    """The demo's KR 270; `more` is further text of the cell, [model] being the last table."""
    path = folder / "kr270.toml"
    urdf = files("elastocal.demo") / "kr270_2.urdf"
    path.write_text(
        f'[robot]\nurdf = "{urdf}"\nbase = "base_link"\nflange = "flange"\n'
        + _tool(markers)
        + f'[tracker]\nsigma_um = 10\n[model]\nobserve = "position"\neffects = '
        f"{json.dumps(list(effects))}\n{more}"
    )
    return Model(read_cell(path, known_effects=tuple(CATALOGUE)))


def serial(folder: Path, joints: int, effects: Sequence[str]) -> Model:
    """A chain of `joints` revolute joints, axes square to each other or parallel by turns."""
    rng = np.random.default_rng(joints)
    rows = ["theta0_rad,d_m,a_m,alpha_rad"]
    for k in range(joints):
        d, a = rng.uniform(0.05, 0.4, 2)
        rows.append(f"0,{d:.3f},{a:.3f},{(0.0, np.pi / 2, -np.pi / 2)[k % 3]:.9f}")
    (folder / "dh.csv").write_text("\n".join(rows) + "\n")
    path = folder / "serial.toml"
    path.write_text(
        '[robot]\ndh = "dh.csv"\ndh_convention = "standard"\n'
        + _tool(1)
        + f'[tracker]\nsigma_um = 10\n[model]\nobserve = "position"\neffects = '
        f"{json.dumps(list(effects))}\n"
    )
    return Model(read_cell(path, known_effects=tuple(CATALOGUE)))


def _tool(markers: int) -> str:
    spread = np.random.default_rng(0).uniform(-0.3, 0.3, (markers, 3))
    places = spread + np.array([0.25, 0.0, 0.1])
    lines = [f"M{k + 1} = {[round(float(v), 3) for v in p]}" for k, p in enumerate(places)]
    return "[tool]\nload_point_m = [0.20, 0.0, 0.25]\n[tool.markers_m]\n" + "\n".join(lines) + "\n"


def truth(model: Model) -> np.ndarray:
    """Parameters off their nominal values by one typical size, a base set up anywhere."""
    rng = np.random.default_rng(SEED)
    size = [0.0 if p.typical is None else p.typical for p in model.parameters]
    x = model.nominal + np.array(size) * rng.normal(size=len(size))
    base = {"base.x": 2.0, "base.y": -1.0, "base.z": 0.5, "base.rz": 2.0}
    for i, p in enumerate(model.parameters):
        x[i] = base.get(p.name, x[i])
        if p.effect == "joint_compliance":
            x[i] = rng.uniform(3e-7, 3e-6)
    return x


def poses(model: Model, n: int, loaded: bool = False, everything: bool = False) -> Measurements:
    """n rows at random joint angles, positions zero; every other row loaded where asked.

    `everything` adds time, temperature, torques and side of approach, which some effects ask for.
    """
    rng = np.random.default_rng([SEED, n])
    low, high = finite_ranges(model.chain, *joint_limits(model.cell, model.chain))
    force = np.zeros((n, 3))
    if loaded:
        force[::2] = LOAD_N
    q = rng.uniform(low, high, (n, len(low)))
    markers = tuple(model.cell.tool.markers)
    return Measurements(
        source="poses",
        row=np.arange(n),
        q=q,
        configuration=np.arange(n),
        configuration_labels=tuple(str(k + 1) for k in range(n)),
        repeat=np.zeros(n, dtype=np.int64),
        marker=np.arange(n) % len(markers),
        marker_names=markers,
        force=force,
        position=np.zeros((n, 3)),
        time=np.linspace(0.0, 7200.0, n) if everything else None,
        approach=np.where(rng.random(q.shape) < 0.5, -1.0, 1.0) if everything else None,
        temperature=np.linspace(20.0, 26.0, n) if everything else None,
        torque=rng.normal(0.0, 500.0, q.shape) if everything else None,
    )
