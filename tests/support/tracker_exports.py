"""A small campaign as trackers and controllers export it, in styles of our own making."""

from __future__ import annotations

from collections.abc import Mapping as Files
from pathlib import Path

import numpy as np
from support.cells import random_poses, table_of
from support.robots import KR270

from elastocal.cell import Cell, read_cell
from elastocal.importing.assemble import Imported, import_files
from elastocal.importing.mapping_file import read_mapping
from elastocal.model.manipulator import Model

MARKERS = ("M1", "M2")
CELL = """\
[robot]
urdf = "arm.urdf"
[tool.markers_m]
M1 = [0.2, 0.05, 0.1]
M2 = [-0.1, 0.15, 0.12]
[model]
effects = ["base_frame", "joint_offset", "marker_position"]
"""


def kr270_readings(folder: Path, poses: int = 10) -> tuple[Cell, np.ndarray, np.ndarray]:
    """The cell of a KR 270-2 in cell.toml, joint values (poses, 6) in degrees, and points (poses,
    markers, 3) in mm."""
    (folder / "arm.urdf").write_bytes(KR270.read_bytes())
    (folder / "cell.toml").write_text(CELL, encoding="utf-8")
    cell = read_cell(folder / "cell.toml")
    model = Model(cell)
    degrees = np.round(np.degrees(random_poses(model.chain, poses, seed=4)), 3)
    table = table_of(np.radians(degrees), np.zeros(3), MARKERS)
    points = model.predict(table).reshape(poses, len(MARKERS), 3) * 1e3
    return cell, degrees, np.round(points, 4)


def krl(degrees: np.ndarray) -> str:
    tail = ",E1 0.0,E2 0.0,E3 0.0,E4 0.0,E5 0.0,E6 0.0"
    lines = ["&ACCESS RVO", "DEFDAT CALIB PUBLIC", "; poses of the campaign {not one}"]
    for i, q in enumerate(degrees, start=1):
        axes = ",".join(f"A{j} {v:.3f}" for j, v in enumerate(q, start=1))
        lines.append(f"DECL E6AXIS XP{i}={{{axes}{tail}}}")
        lines.append(f'DECL FDAT FP{i}={{TOOL_NO 1,BASE_NO 0,POINT2[] " "}}')
    return "\n".join([*lines, "ENDDAT", ""])


def rapid(degrees: np.ndarray) -> str:
    """A module with one jointtarget per pose, every second over two lines."""
    lines = ["MODULE Calib", "! poses; not [[1,2,3,4,5,6],[0,0,0,0,0,0]]"]
    for i, q in enumerate(degrees, start=1):
        robot = ",".join(f"{v:.3f}" for v in q)
        gap = "\n    " if i % 2 == 0 else ""
        lines.append(f"CONST jointtarget p{i}:=[[{robot}],{gap}[9E9,9E9,9E+09,9E9,9E9,9E9]];")
    return "\n".join([*lines, "ENDMODULE", ""])


def spatialanalyzer(points: np.ndarray, unit: str = "mm") -> str:
    """Group (pose), target (marker), x, y, z."""
    lines = ["// SpatialAnalyzer SA 2024", f"// AXES = CARTESIAN: X,  Y,  Z ({unit})"]
    for i, pose in enumerate(points, start=1):
        for marker, p in zip(MARKERS, pose, strict=True):
            xyz = ",  ".join(f"{v:.4f}" for v in p)
            lines.append(f"P{i:02d},  {marker},  {xyz}")
    return "\n".join([*lines, ""])


def delimited(points: np.ndarray, header: str, delimiter: str = ",", decimal: str = ".") -> str:
    lines = [header]
    for i, pose in enumerate(points, start=1):
        for marker, p in zip(MARKERS, pose, strict=True):
            xyz = [f"{v:.4f}".replace(".", decimal) for v in p]
            lines.append(delimiter.join([f"P{i}_{marker}", *xyz]))
    return "\n".join([*lines, ""])


def imported(
    folder: Path, files: Files[str, str | bytes], mapping: str | None = None,
    presets: tuple[str, ...] = (), cell: Cell | None = None,
) -> Imported:  # fmt: skip
    """What `elastocal import` makes of files with these contents."""
    paths = []
    for name, content in files.items():
        path = folder / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        paths.append(path)
    where = None
    if mapping is not None:
        where = folder / "mapping.toml"
        where.write_text(mapping, encoding="utf-8")
    return import_files(paths, read_mapping(where, presets), cell)
