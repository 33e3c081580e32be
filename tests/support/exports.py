"""Cells with results to export, and what the exported files say when others read them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from elastocal.cell import read_cell
from elastocal.export.export import Exported, Wish, export
from elastocal.model.calibrated import CalibratedArm, Conditions, random_table, read_calibrated
from elastocal.model.effects.base import Parameter
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import Model
from elastocal.units import Array

GEOMETRY = ("base_frame", "joint_offset", "link_geometry", "marker_position")
SPRINGS = (*GEOMETRY, "joint_compliance")
LOAD = np.array([40.0, -25.0, -120.0])

DH = """\
joint,theta0_rad,d_m,a_m,alpha_rad,lower_rad,upper_rad
a1,0.1,0.4,0.18,-1.5707963267948966,-2.9,2.9
a2,-1.5707963267948966,0,0.6,0,-2,2
a3,0,0,0.12,-1.5707963267948966,-2,2.5
a4,0,0.62,0,1.5707963267948966,,
a5,0,0,0,-1.5707963267948966,-2,2
a6,3.141592653589793,0.115,0,0,-3,3
"""


def write_result(
    folder: Path,
    robot: str,
    effects: Sequence[str] = SPRINGS,
    model: str = "",
    seed: int = 1,
    value: Callable[[Parameter], float | None] = lambda p: None,
) -> tuple[Path, Path]:
    """cell.toml and result.json of an arm with random errors of about a millimetre.

    Compliances are 2e-6 unless `value` says otherwise; `robot` and `model` are lines of the cell.
    """
    cell, result = folder / "cell.toml", folder / "result.json"
    cell.write_text(
        f"[robot]\n{robot}\n[tool]\nload_point_m = [0.1, 0.02, 0.2]\n"
        "[tool.markers_m]\nM1 = [0.1, 0.0, 0.1]\nM2 = [0.0, 0.2, 0.05]\n"
        f"[model]\neffects = {json.dumps(list(effects))}\n{model}\n",
        encoding="utf-8",
    )
    rng = np.random.default_rng(seed)
    parameters = []
    for p in Model(read_cell(cell, known_effects=tuple(CATALOGUE))).parameters:
        drawn = float(p.nominal + 1e-3 * rng.normal())
        if p.effect == "base_frame":
            drawn = float(rng.normal())
        if p.effect in ("joint_compliance", "off_axis_compliance"):
            drawn = 2e-6
        given = value(p)
        held = drawn if given is None else given
        parameters.append(
            {"name": p.name, "unit": p.unit, "value": held, "std": 1e-5, "held": held,
             "ci95": [held - 2e-5, held + 2e-5], "identifiable": True, "combined_with": [],
             "nominal": p.nominal, "note": ""}
        )  # fmt: skip
    text = {"schema": "elastocal/identification/1", "parameters": parameters}
    result.write_text(json.dumps(text), encoding="utf-8")
    return cell, result


def exported(
    cell: Path,
    result: Path,
    format: str,
    force: Array | None = None,
    poses: int = 20,
    **added: bool,
) -> tuple[CalibratedArm, Exported]:
    calibrated = read_calibrated(cell, result)
    wish = Wish(cell.parent / "out", format, force, poses=poses, **added)
    return calibrated, export(calibrated, wish)


def flanges_in_base(calibrated: CalibratedArm, q: Array, force: Array) -> Array:
    """T_base_flange (n, 4, 4) that the full model predicts at commanded q (n, joints)."""
    from scipy.spatial.transform import Rotation

    model, x = calibrated.model, calibrated.x
    table = random_table(model, Conditions(force), len(q), 0)
    table.q[:] = q
    base = [calibrated.values.get(f"base.{k}", 0.0) for k in ("x", "y", "z", "rx", "ry", "rz")]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(base[3:]).as_matrix(), base[:3]
    return np.asarray(np.linalg.solve(T, model.flange_poses(table, x)))


def poses_of(calibrated: CalibratedArm, n: int, seed: int) -> Array:
    return random_table(calibrated.model, Conditions(), n, seed).q
