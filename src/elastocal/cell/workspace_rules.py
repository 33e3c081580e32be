"""The space around the arm: bodies, obstacles, keep-out, sight, load (DESIGN: [workspace]).

Positions of obstacles and half-spaces are in the data's frame (the tracker's, z vertical), those
of carried bodies in the frame of what carries them.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from elastocal.cell.file_keys import (
    TUPLE,
    AnyFloat,
    Direction,
    File,
    Key,
    Many,
    Spot,
    Transform,
    direction,
    fields_of,
    from_table,
    keyed,
    keys_of,
    record,
    stated,
)
from elastocal.config import (
    Count,
    NonNegative,
    Numbers,
    Positive,
    Text,
    Vector2,
    Vector3,
    numbers,
)
from elastocal.errors import require
from elastocal.text import is_label, quoted
from elastocal.units import Array, rotation_from_rpy

Shape = Literal["box", "sphere", "cylinder", "capsule", "mesh"]
Part = Annotated[str, Field(pattern=r"^(base|flange|link[1-9][0-9]{0,2})$")]
Pair = Annotated[tuple[Text, Text], TUPLE]
Angle = Annotated[float, Field(gt=0, le=180)]
Edges = Annotated[Array, numbers(3, above=0)]
Scale = Annotated[Array, numbers(3, above=0, one_for_all=True)]
Radii = Positive | Annotated[Array, numbers(least=0)]
# shape → keys that it needs; `scale` alone may be left out.
NEEDED = {
    "box": ("size_m",),
    "sphere": ("radius_m",),
    "cylinder": ("radius_m", "length_m"),
    "capsule": ("radius_m", "length_m"),
    "mesh": ("file",),
}
SIZE_KEYS = (
    Key("size_m", "three positive numbers in m, the edges of a box", Edges),
    Key("radius_m", "a positive number in m", Positive),
    Key("length_m", "a positive number in m, along the solid's z axis", Positive),
    Key("scale", "a positive number, or three for x, y, z", Scale),
)
PLACE_KEYS = (
    Key("position_m", "three numbers in m, the solid's centre or the mesh's origin", Vector3),
    Key("rpy_deg", "three numbers in degrees: roll, pitch, yaw", Vector3),
)
ANGLE = "a number in degrees, over 0 and up to 180"
PARTS = re.compile(r"base|flange|load|rope|link[0-9]+")


@record
class Solid:
    """A rigid shape at `placement` (4, 4) in its carrier's frame.

    `size` in m: box (3,) edge lengths; sphere (1,) radius; cylinder (2,) radius and length along
    z; capsule (2,) radius and length between the centres of its caps along z; mesh (3,) scale of
    the file `mesh`.
    """

    name: str = keyed('a name of its own, e.g. "table"', form=Text, required=True)
    shape: Shape = keyed(required=True)
    size: Numbers = keyed(keys=SIZE_KEYS)
    placement: Transform = keyed(keys=PLACE_KEYS, default_factory=lambda: np.eye(4))
    mesh: File | None = keyed('the path of a mesh, e.g. "fixture.stl"', "file", default=None)

    def __post_init__(self) -> None:
        count = {"box": 3, "mesh": 3, "sphere": 1}.get(self.shape, 2)
        require(
            len(self.size) == count,
            f"Solid: size of a {self.shape} takes {count} numbers in m; found {len(self.size)}",
        )

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        """Size and placement; the keys of the size are those of the shape."""
        needed = NEEDED[table.shape]
        for known in keys_of(cls):
            given = getattr(table, known.name, None) is not None
            meant = known in SIZE_KEYS or known.name == "file"
            allowed = known.name in needed or (known.name == "scale" and table.shape == "mesh")
            spot.require(
                allowed or not (given and meant),
                f"key {spot.key(known.name)} has no meaning for a {table.shape}, which takes "
                f"{' and '.join(needed)}; drop it",
            )
            spot.require(
                given or known.name not in needed,
                f"key {spot.key(known.name)} is missing; for a {table.shape} it takes "
                f"{known.takes}",
            )
        size = np.ones(3) if table.scale is None else table.scale
        if table.shape != "mesh":
            size = np.hstack([getattr(table, name) for name in needed])
        T = np.eye(4)
        if getattr(table, "rpy_deg", None) is not None:
            T[:3, :3] = rotation_from_rpy(np.radians(table.rpy_deg))
        if getattr(table, "position_m", None) is not None:
            T[:3, 3] = table.position_m
        return {"size": size, "placement": T}


@record
class CarriedBody:
    """A solid fixed to `on`: "base", "link1" … "linkN" (moved by joint N) or "flange"."""

    solid: Solid = keyed(keys=keys_of(Solid))
    on: Part = keyed(
        '"flange", "base", or a link as in "link3" (the one joint 3 moves)', default="flange"
    )

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        """The solid, whose keys stand beside the carrier's."""
        return {"solid": from_table(Solid, table, spot)}


@record
class HalfSpace:
    """Nothing may be where normal · (x − point) < 0; `normal` (3,) is a unit vector."""

    name: str = keyed('a name of its own, e.g. "walkway"', form=Text, required=True)
    point: Vector3 = keyed(
        "three numbers in m, a point of the boundary plane", "point_m", required=True
    )
    normal: Direction = keyed(
        "three numbers, a direction to the side where the arm may be", required=True
    )


@record
class HangingLoad:
    """What hangs at the load point by a rope, straight down, in loaded readings only.

    `solid` is upright, the rope's lower end at its top; `rope` its length in m.  `rope_axis` (3,)
    in the flange frame: the direction in which the rope leaves the tool; it may deviate from the
    vertical by `max_angle` rad.  `min_height` in m: lowest point of the load in the data's frame.
    """

    solid: Solid = keyed(keys=keys_of(Solid, without=("name", "position_m", "rpy_deg")))
    rope: NonNegative = keyed("a number >= 0 in m, from load point to load", "rope_m", default=0.0)
    rope_radius: Positive = keyed("a positive number in mm", "rope_radius_mm", default=0.01)
    rope_axis: Direction | None = keyed(
        "three numbers, a direction in the flange frame", default=None
    )
    max_angle: float | None = keyed(ANGLE, "max_angle_deg", form=Angle, default=None)
    min_height: float | None = keyed(
        "a number in m, a height in the data's frame", "min_height_m", default=None
    )

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        """The solid, whose keys stand beside the rope's."""
        axis, angle = table.rope_axis is not None, table.max_angle_deg is not None
        given, other, takes = (
            ("rope_axis", "max_angle_deg", "the angle that it may deviate from the vertical")
            if axis
            else ("max_angle_deg", "rope_axis", "the direction in which the rope leaves the tool")
        )
        spot.require(
            axis == angle,
            f"key {spot.key(given)} has no meaning without {spot.key(other)}, {takes}; give both "
            "or none",
        )
        return {"solid": from_table(Solid, table, spot, name="load")}


@record
class Visibility:
    """What the tracker must see: all markers, or `min_markers` of them, past arm and obstacles.

    `normals` name → (3,) axis of the reflector in the flange frame, `max_incidence` rad from it;
    `range` m; `beam_radius` m of free sight.
    """

    normals: dict[str, Direction] = keyed(
        "three numbers per marker, in the flange frame",
        form=dict[str, Vector3],
        into=lambda found, spot, name: {m: direction(v, spot / name, m) for m, v in found.items()},
        default_factory=dict,
    )
    max_incidence: float | None = keyed(ANGLE, "max_incidence_deg", form=Angle, default=None)
    range: Annotated[tuple[AnyFloat, AnyFloat], TUPLE] = keyed(
        "two numbers in m, [nearest, farthest]", "range_m", form=Vector2, default=(0.0, np.inf)
    )
    beam_radius: NonNegative = keyed("a number >= 0 in mm", "beam_radius_mm", default=0.005)
    line_of_sight: bool = keyed(default=True)
    min_markers: Count | None = keyed("a whole number >= 1", default=None)

    def __post_init__(self) -> None:
        low, high = self.range
        require(
            0 <= low < high,
            "key workspace.visibility.range_m takes [nearest, farthest] in m with "
            f"0 <= nearest < farthest; found {quoted([low, high])}",
        )
        require(
            not self.normals or self.max_incidence is not None,
            "[workspace.visibility.normals] has no meaning without max_incidence_deg of "
            "[workspace.visibility]; a corner-cube reflector takes about 30",
        )
        require(
            bool(self.normals) or self.max_incidence is None,
            "key workspace.visibility.max_incidence_deg has no meaning without the "
            "reflectors' axes; give them in [workspace.visibility.normals], as in M1 = [0, 0, 1]",
        )


@record
class Workspace:
    """`link_radius` (n,) m: capsules along the links, (1,) where all are alike, () for none;
    `urdf_geometry`: the URDF's own collision shapes.  `clearance` m to obstacles,
    `self_clearance` m between bodies of the arm; `ignored_pairs` of body names that may touch;
    `torque_limits` (n,) N m static, () none.  `mounting_plane`: links and tool stay on the arm's
    side of z = 0 of the base; None: where neither obstacles nor half-spaces are stated.

    Examples:
        >>> from elastocal.cell.workspace_rules import HalfSpace
        >>> floor = HalfSpace(name="floor", point=[0, 0, 0], normal=[0, 0, 1])
        >>> ec.Workspace(keep_out=[floor], clearance=0.05).clearance
        0.05
    """

    obstacles: Many[Solid] = keyed(
        "tables, each headed [[workspace.obstacle]]", "obstacle", default=()
    )
    bodies: Many[CarriedBody] = keyed("tables, each headed [[workspace.body]]", "body", default=())
    keep_out: Many[HalfSpace] = keyed("tables, each headed [[workspace.keep_out]]", default=())
    load: HangingLoad | None = keyed("a table headed [workspace.load]", default=None)
    visibility: Visibility | None = keyed("a table headed [workspace.visibility]", default=None)
    link_radius: Many[float] = keyed(
        "a positive number in {}, or one per link (0: no body)",
        "link_radius_mm",
        "link_radius_m",
        form=Radii,
        default=(),
    )
    urdf_geometry: bool = keyed(
        "",
        "geometry",
        form=Literal["capsules", "urdf", "none"],
        into=lambda found, *_: found == "urdf",
        default=False,
    )
    self_collision: bool = keyed(default=True)
    mounting_plane: bool | None = keyed("true or false", default=None)
    ignored_pairs: Many[Pair] = keyed('pairs of names, as in [["link2", "link4"]]', default=())
    clearance: NonNegative = keyed(
        "a number >= 0 in {}", "clearance_mm", "clearance_m", default=0.0
    )
    self_clearance: NonNegative = keyed(
        "a number >= 0 in {}", "self_clearance_mm", "self_clearance_m", default=0.0
    )
    torque_limits: Many[Positive] = keyed(
        "one positive number per joint, in N m", "torque_limits_Nm", default=()
    )

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        """Checks names, and whether the geometry and the links' radii go together."""
        _check_names(table, spot)
        radius = stated(table, spot, fields_of(cls)["link_radius"])
        geometry = table.geometry or ("capsules" if radius else "none")
        spot.require(
            bool(radius) or geometry != "capsules",
            'key workspace.link_radius_mm is missing; beside geometry = "capsules" it takes a '
            "positive number in mm, or one per link",
        )
        spot.require(
            not radius or geometry == "capsules",
            f"key {spot.key(radius[1]) if radius else ''} has no meaning beside geometry = "
            f'"{geometry}"; drop one of them',
        )
        return {"link_radius": np.atleast_1d(radius[0]) if radius else ()}


def _check_names(table: Any, spot: Spot) -> None:
    """Names of solids and half-spaces can stand in messages and plans, each only once."""
    places: dict[str, str] = {}
    for kind in ("obstacle", "body", "keep_out"):
        for i, entry in enumerate(getattr(table, kind) or ()):
            here = (spot / kind / i).key("name")
            spot.require(
                is_label(entry.name),
                f"key {here} takes a text on one line without blanks at its ends; found "
                f"{quoted(entry.name)}",
            )
            spot.require(
                not PARTS.fullmatch(entry.name),
                f"key {here} is {quoted(entry.name)}, which names a part of the arm or its load; "
                "choose another",
            )
            spot.require(
                entry.name not in places,
                f"key {here} repeats {quoted(entry.name)}, already {places.get(entry.name)}; give "
                "every one a name of its own",
            )
            places[entry.name] = here
