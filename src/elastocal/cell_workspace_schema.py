"""The keys of [workspace]: the cell around the arm, and what each key takes."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from elastocal.cell_table import (
    NonNegative,
    Positive,
    Positive3,
    Positives,
    Table,
    Text,
    Vector2,
    Vector3,
    key,
    required,
)

Place = Annotated[str, Field(pattern=r"^(base|flange|link[1-9][0-9]{0,2})$")]
Pair = Annotated[list[Text], Field(min_length=2, max_length=2)]
Angle = Annotated[float, Field(gt=0, le=180)]
Radii = Annotated[list[NonNegative], Field(min_length=1)]
SHAPES = '"box", "sphere", "cylinder", "capsule" or "mesh"'


class ShapeTable(Table):
    shape: Literal["box", "sphere", "cylinder", "capsule", "mesh"] = required(SHAPES)
    size_m: Positive3 | None = key("three positive numbers in m, the edges of a box")
    radius_m: Positive | None = key("a positive number in m")
    length_m: Positive | None = key("a positive number in m, along the solid's z axis")
    file: Text | None = key('the path of a mesh, e.g. "fixture.stl"')
    scale: Positive | Positive3 | None = key("a positive number, or three for x, y, z")


class ObstacleTable(ShapeTable):
    name: Text = required('a name of its own, e.g. "table"')
    position_m: Vector3 | None = key("three numbers in m, the solid's centre or the mesh's origin")
    rpy_deg: Vector3 | None = key("three numbers in degrees: roll, pitch, yaw")


class BodyTable(ObstacleTable):
    on: Place | None = key('"flange", "base", or a link as in "link3" (the one joint 3 moves)')


class KeepOutTable(Table):
    name: Text = required('a name of its own, e.g. "walkway"')
    point_m: Vector3 = required("three numbers in m, a point of the boundary plane")
    normal: Vector3 = required("three numbers, a direction to the side where the arm may be")


class LoadTable(ShapeTable):
    rope_m: NonNegative | None = key("a number >= 0 in m, from load point to load")
    rope_radius_mm: Positive | None = key("a positive number in mm")
    rope_axis: Vector3 | None = key("three numbers, a direction in the flange frame")
    max_angle_deg: Angle | None = key("a number in degrees, over 0 and up to 180")
    min_height_m: float | None = key("a number in m, a height in the data's frame")


class VisibilityTable(Table):
    normals: dict[str, Vector3] | None = key("three numbers per marker, in the flange frame")
    max_incidence_deg: Angle | None = key("a number in degrees, over 0 and up to 180")
    range_m: Vector2 | None = key("two numbers in m, [nearest, farthest]")
    beam_radius_mm: NonNegative | None = key("a number >= 0 in mm")
    line_of_sight: bool | None = key("true or false")


class WorkspaceTable(Table):
    clearance_mm: NonNegative | None = key("a number >= 0 in mm")
    clearance_m: NonNegative | None = key("a number >= 0 in m")
    self_clearance_mm: NonNegative | None = key("a number >= 0 in mm")
    self_clearance_m: NonNegative | None = key("a number >= 0 in m")
    link_radius_mm: Positive | Radii | None = key(
        "a positive number in mm, or one per link (0: no body)"
    )
    link_radius_m: Positive | Radii | None = key(
        "a positive number in m, or one per link (0: no body)"
    )
    geometry: Literal["capsules", "urdf", "none"] | None = key('"capsules", "urdf" or "none"')
    self_collision: bool | None = key("true or false")
    ignored_pairs: list[Pair] | None = key('pairs of names, as in [["link2", "link4"]]')
    torque_limits_Nm: Positives | None = key("one positive number per joint, in N m")
    obstacle: list[ObstacleTable] | None = key("tables, each headed [[workspace.obstacle]]")
    body: list[BodyTable] | None = key("tables, each headed [[workspace.body]]")
    keep_out: list[KeepOutTable] | None = key("tables, each headed [[workspace.keep_out]]")
    load: LoadTable | None = key("a table headed [workspace.load]")
    visibility: VisibilityTable | None = key("a table headed [workspace.visibility]")
