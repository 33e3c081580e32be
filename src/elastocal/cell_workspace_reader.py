"""[workspace]: checked tables → the work cell in SI units."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from elastocal.cell_keys import place
from elastocal.cell_values import check_markers, direction, in_one_unit, rotation_from_rpy
from elastocal.cell_workspace import (
    CarriedBody,
    HalfSpace,
    HangingLoad,
    Solid,
    Visibility,
    Workspace,
)
from elastocal.cell_workspace_schema import (
    KeepOutTable,
    LoadTable,
    ObstacleTable,
    ShapeTable,
    VisibilityTable,
    WorkspaceTable,
)
from elastocal.errors import InputError, require
from elastocal.files import check_exists
from elastocal.text import is_label, quoted
from elastocal.units import to_si

LENGTH = {"mm": "mm", "m": "m"}
# shape → keys that it needs; `scale` alone may be left out.
NEEDED = {
    "box": ("size_m",),
    "sphere": ("radius_m",),
    "cylinder": ("radius_m", "length_m"),
    "capsule": ("radius_m", "length_m"),
    "mesh": ("file",),
}
PARTS = re.compile(r"base|flange|load|rope|link[0-9]+")
Keys = tuple[str | int, ...]


def read_workspace(path: Path, table: WorkspaceTable, markers: tuple[str, ...]) -> Workspace:
    """The work cell of the cell file `path`, whose tool has these markers.

    Raises InputError for keys that do not go together, missing files, zero directions, names
    given twice, and names of markers that the cell does not have.
    """
    _check_names(path, table)
    radius = in_one_unit(path, table, ("workspace",), "link_radius", LENGTH)
    geometry = table.geometry or ("capsules" if radius else "none")
    if geometry == "capsules" and not radius:
        raise InputError(
            f'{path}: key workspace.link_radius_mm is missing; beside geometry = "capsules" it '
            "takes a positive number in mm, or one per link"
        )
    if geometry != "capsules" and radius:
        raise InputError(
            f"{path}: key workspace.link_radius_{radius[1]} has no meaning beside geometry = "
            f'"{geometry}"; drop one of them'
        )
    obstacles = [
        _solid(path, ("workspace", "obstacle", i), t) for i, t in enumerate(table.obstacle or [])
    ]
    bodies = [
        CarriedBody(_solid(path, ("workspace", "body", i), t), t.on or "flange")
        for i, t in enumerate(table.body or [])
    ]
    keep_out = [_half_space(path, i, t) for i, t in enumerate(table.keep_out or [])]
    return Workspace(
        obstacles=tuple(obstacles),
        bodies=tuple(bodies),
        keep_out=tuple(keep_out),
        load=None if table.load is None else _load(path, table.load),
        visibility=None
        if table.visibility is None
        else _visibility(path, table.visibility, markers),
        link_radius=tuple(np.atleast_1d(radius[0]).tolist()) if radius else (),
        urdf_geometry=geometry == "urdf",
        self_collision=table.self_collision is not False,
        ignored_pairs=tuple((one, other) for one, other in table.ignored_pairs or []),
        clearance=_length(path, table, "clearance"),
        self_clearance=_length(path, table, "self_clearance"),
        torque_limits=tuple(table.torque_limits_Nm or ()),
    )


def _length(path: Path, table: WorkspaceTable, stem: str) -> float:
    given = in_one_unit(path, table, ("workspace",), stem, LENGTH)
    return float(given[0]) if given else 0.0


def _check_names(path: Path, table: WorkspaceTable) -> None:
    """Names of solids and half-spaces can stand in messages and plans, each only once."""
    places: dict[str, str] = {}
    lists: dict[str, Sequence[ObstacleTable | KeepOutTable]] = {
        "obstacle": table.obstacle or [],
        "body": table.body or [],
        "keep_out": table.keep_out or [],
    }
    for kind, entries in lists.items():
        for i, entry in enumerate(entries):
            here = place("workspace", kind, i, "name")
            if not is_label(entry.name):
                raise InputError(
                    f"{path}: key {here} takes a text on one line without blanks at its ends; "
                    f"found {quoted(entry.name)}"
                )
            if PARTS.fullmatch(entry.name):
                raise InputError(
                    f"{path}: key {here} is {quoted(entry.name)}, which names a part of the arm "
                    "or its load; choose another"
                )
            if entry.name in places:
                raise InputError(
                    f"{path}: key {here} repeats {quoted(entry.name)}, already "
                    f"{places[entry.name]}; give every one a name of its own"
                )
            places[entry.name] = here


def _shape(path: Path, above: Keys, table: ShapeTable) -> tuple[np.ndarray, Path | None]:
    """Size as in Solid and the mesh's file; the keys must be those of the shape."""
    needed = NEEDED[table.shape]
    for key in ("size_m", "radius_m", "length_m", "file", "scale"):
        given = getattr(table, key) is not None
        allowed = key in needed or (key == "scale" and table.shape == "mesh")
        if given and not allowed:
            raise InputError(
                f"{path}: key {place(*above, key)} has no meaning for a {table.shape}, which "
                f"takes {' and '.join(needed)}; drop it"
            )
        if key in needed and not given:
            takes = type(table).model_fields[key].description
            raise InputError(
                f"{path}: key {place(*above, key)} is missing; for a {table.shape} it takes {takes}"
            )
    if table.shape == "mesh":
        file = check_exists(path.parent / str(table.file), place(*above, "file"), path)
        return np.broadcast_to(np.array(table.scale or 1.0), 3).copy(), file
    return np.hstack([getattr(table, key) for key in needed]), None


def _solid(path: Path, above: Keys, table: ObstacleTable) -> Solid:
    size, mesh = _shape(path, above, table)
    T = np.eye(4)
    T[:3, :3] = rotation_from_rpy(table.rpy_deg or [0.0, 0.0, 0.0])
    T[:3, 3] = table.position_m or [0.0, 0.0, 0.0]
    return Solid(table.name, table.shape, size, T, mesh)


def _half_space(path: Path, i: int, table: KeepOutTable) -> HalfSpace:
    key = place("workspace", "keep_out", i, "normal")
    return HalfSpace(table.name, np.array(table.point_m), direction(path, key, table.normal))


def _load(path: Path, table: LoadTable) -> HangingLoad:
    size, mesh = _shape(path, ("workspace", "load"), table)
    if (table.rope_axis is None) != (table.max_angle_deg is None):
        given, other, takes = (
            ("rope_axis", "max_angle_deg", "the angle that it may deviate from the vertical")
            if table.max_angle_deg is None
            else ("max_angle_deg", "rope_axis", "the direction in which the rope leaves the tool")
        )
        raise InputError(
            f"{path}: key workspace.load.{given} has no meaning without workspace.load.{other}, "
            f"{takes}; give both or none"
        )
    axis, angle, radius = table.rope_axis, table.max_angle_deg, table.rope_radius_mm
    return HangingLoad(
        solid=Solid("load", table.shape, size, np.eye(4), mesh),
        rope=table.rope_m or 0.0,
        rope_radius=HangingLoad.rope_radius if radius is None else to_si(radius, "mm"),
        rope_axis=None if axis is None else direction(path, "workspace.load.rope_axis", axis),
        max_angle=None if angle is None else to_si(angle, "deg"),
        min_height=table.min_height_m,
    )


def _visibility(path: Path, table: VisibilityTable, markers: tuple[str, ...]) -> Visibility:
    above = ("workspace", "visibility")
    normals = table.normals or {}
    check_markers(path, (*above, "normals"), normals, markers)
    require(
        not normals or table.max_incidence_deg is not None,
        f"{path}: [workspace.visibility.normals] has no meaning without max_incidence_deg of "
        "[workspace.visibility]; a corner-cube reflector takes about 30",
    )
    require(
        bool(normals) or table.max_incidence_deg is None,
        f"{path}: key workspace.visibility.max_incidence_deg has no meaning without the "
        "reflectors' axes; give them in [workspace.visibility.normals], as in M1 = [0, 0, 1]",
    )
    low, high = table.range_m or Visibility.range
    require(
        0 <= low < high,
        f"{path}: key workspace.visibility.range_m takes [nearest, farthest] in m with "
        f"0 <= nearest < farthest; found {quoted([low, high])}",
    )
    angle, beam = table.max_incidence_deg, table.beam_radius_mm
    return Visibility(
        normals={
            name: direction(path, place(*above, "normals", name), normal)
            for name, normal in normals.items()
        },
        max_incidence=None if angle is None else to_si(angle, "deg"),
        range=(low, high),
        beam_radius=Visibility.beam_radius if beam is None else to_si(beam, "mm"),
        line_of_sight=table.line_of_sight is not False,
    )
