"""The work cell: what the user has (robot, tool, tracker, model, workspace) and asks of a plan.

A cell is read from a TOML file, `Cell.read("cell.toml")`, or built in Python from the same classes
in SI units.  Either way it is checked once and then frozen.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import field
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AllowInfNan, Field

from elastocal.cell_tables import DesignSpec, ModelSpec, Robot, Tool, Tracker, Unsteadiness
from elastocal.config import (
    RISING,
    TUPLE,
    Count,
    Direction,
    File,
    Key,
    Many,
    NonNegative,
    Numbers,
    Positive,
    Positives,
    Record,
    Spot,
    Table,
    Text,
    Transform,
    Vector3,
    by_name,
    checked,
    fields_of,
    file_key,
    from_table,
    holding,
    joint_values,
    key,
    keyed,
    keys_of,
    numbers,
    optional,
    read_toml,
    several,
    stated,
)
from elastocal.files import check_exists, is_plugin_file
from elastocal.messages import check_known, is_label, listed, quoted, require, wish
from elastocal.units import Array, pose_at, rotation_from_rpy

Shape = Literal["box", "sphere", "cylinder", "capsule", "mesh"]
Part = Annotated[str, Field(pattern=r"^(base|flange|link[1-9][0-9]{0,2})$")]
Pair = Annotated[tuple[Text, Text], TUPLE]
Angle = Annotated[float, Field(gt=0, le=180, description="a positive number")]
Edges = Annotated[Array, numbers(3, above=0)]
Scale = Annotated[Array, numbers(3, above=0, one_for_all=True)]
Radii = Positive | Annotated[Array, numbers(least=0)]
Joint = Annotated[Array, numbers(2), RISING]
Distance = Annotated[float, Field(ge=0), AllowInfNan(True)]
Label = Annotated[str, holding(is_label)]
Country = Annotated[str, Field(pattern="^[A-Z]{2}$")]
# shape → keys that it needs; `scale` alone may be left out.
NEEDED = {
    "box": ("size_m",),
    "sphere": ("radius_m",),
    "cylinder": ("radius_m", "length_m"),
    "capsule": ("radius_m", "length_m"),
    "mesh": ("file",),
}
SIZES = (
    Key("size_m", note=", the edges of a box", form=Edges),
    Key("radius_m", form=Positive),
    Key("length_m", note=", along the solid's z axis", form=Positive),
    Key("scale", note=", or three for x, y, z", form=Scale),
)
PLACE = (
    Key("position_m", note=", the solid's centre or the mesh's origin", form=Vector3),
    Key("rpy_deg", note=": roll, pitch, yaw", form=Vector3),
)
NAME = 'a name of its own, e.g. "table", on one line without blanks at its ends'
PARTS = re.compile(r"base|flange|load|rope|link[0-9]+")


class Solid(Record):
    """A rigid shape at `placement` (4, 4) in its carrier's frame.

    `size` in m: box (3,) edge lengths; sphere (1,) radius; cylinder (2,) radius and length along
    z; capsule (2,) radius and length between the centres of its caps along z; mesh (3,) scale of
    the file `mesh`.
    """

    name: str = keyed(takes=NAME, form=Label)
    shape: Shape = keyed()
    size: Numbers = keyed(keys=SIZES)
    placement: Transform = keyed(keys=PLACE, default_factory=lambda: np.eye(4))
    mesh: File | None = file_key("file", takes='the path of a mesh, as "part.stl"')

    def __post_init__(self) -> None:
        count = {"box": 3, "mesh": 3, "sphere": 1}.get(self.shape, 2)
        require(
            len(self.size) == count,
            f"Solid: size of a {self.shape} takes {count} numbers in m; found {len(self.size)}",
        )

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        shape = table["shape"]
        needed = NEEDED[shape]
        for known in (*SIZES, *fields_of(cls)["mesh"]):
            name = known.name
            if name in needed:
                told = f"key {spot.key(name)} is missing; for a {shape} it takes"
                require(name in table, f"{told} {known.of(name, known.form).takes}")
            elif name in table and (name, shape) != ("scale", "mesh"):
                told = f"{shape}, which takes {' and '.join(needed)}; drop it"
                require(False, f"key {spot.key(name)} has no meaning for a {told}")
        size = table.get("scale", np.ones(3))
        if shape != "mesh":
            size = np.hstack([table[name] for name in needed])
        turned = rotation_from_rpy(np.radians(table.get("rpy_deg", (0, 0, 0))))
        return {"size": size, "placement": pose_at(table.get("position_m", (0, 0, 0)), turned)}


class CarriedBody(Record):
    """A solid fixed to `on`: "base", "link1" … "linkN" (moved by joint N) or "flange"."""

    solid: Solid = keyed(keys=keys_of(Solid))
    on: Part = keyed(
        takes='"flange", "base", or a link as in "link3" (the one joint 3 moves)', default="flange"
    )

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        return {"solid": from_table(Solid, table, spot)}


class HalfSpace(Record):
    """Nothing may be where normal · (x − point) < 0; `normal` (3,) is a unit vector."""

    name: str = keyed(takes=NAME, form=Label)
    point: Vector3 = keyed("point_m", note=", a point of the boundary plane")
    normal: Direction = keyed(note=", a direction to the side where the arm may be")


class HangingLoad(Record):
    """What hangs at the load point by a rope, straight down, in loaded readings only.

    `solid` is upright, the rope's lower end at its top; `rope` its length in m.  `rope_axis` (3,)
    in the flange frame: the direction in which the rope leaves the tool; it may deviate from the
    vertical by `max_angle` rad.  `min_height` in m: lowest point of the load in the data's frame.
    """

    solid: Solid = keyed(keys=keys_of(Solid, without=("name", "position_m", "rpy_deg")))
    rope: NonNegative = keyed("rope_m", note=", from load point to load", default=0.0)
    rope_radius: Positive = keyed("rope_radius_mm", default=0.01)
    rope_axis: Direction | None = optional(note=", a direction in the flange frame")
    max_angle: float | None = optional("max_angle_deg", note=", at most 180", form=Angle)
    min_height: float | None = optional("min_height_m", note=", a height in the data's frame")

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        for given, other, takes in (
            ("rope_axis", "max_angle_deg", "the angle that it may deviate from the vertical"),
            ("max_angle_deg", "rope_axis", "the direction in which the rope leaves the tool"),
        ):
            told = f"key {spot.key(given)} has no meaning without {spot.key(other)}, {takes}"
            require(other in table or given not in table, f"{told}; give both or none")
        return {"solid": from_table(Solid, table, spot, name="load")}


class Visibility(Record):
    """What the tracker must see: all markers, or `min_markers` of them, past arm and obstacles.

    `normals` name → (3,) axis of the reflector in the flange frame, `max_incidence` rad from it;
    `range` m; `beam_radius` m of free sight.
    """

    normals: dict[str, Direction] = by_name(note=" per marker, in the flange frame")
    max_incidence: float | None = optional("max_incidence_deg", note=", at most 180", form=Angle)
    range: Annotated[tuple[Distance, Distance], TUPLE, RISING] = keyed(
        "range_m",
        takes="[nearest, farthest] in m with 0 <= nearest < farthest",
        form=Annotated[Array, numbers(2, least=0), RISING],
        default=(0.0, np.inf),
    )
    beam_radius: NonNegative = keyed("beam_radius_mm", default=0.005)
    line_of_sight: bool = keyed(default=True)
    min_markers: Count | None = optional()

    def __post_init__(self) -> None:
        require(
            not self.normals or self.max_incidence is not None,
            "[workspace.visibility.normals] has no meaning without max_incidence_deg of "
            "[workspace.visibility]; a corner-cube reflector takes about 30",
        )
        require(
            self.normals or self.max_incidence is None,
            "key workspace.visibility.max_incidence_deg has no meaning without the "
            "reflectors' axes; give them in [workspace.visibility.normals], as in M1 = [0, 0, 1]",
        )


class Workspace(Record):
    """`link_radius` (n,) m: capsules along the links, (1,) where all are alike, () for none;
    `urdf_geometry`: the URDF's own collision shapes.  `clearance` m to obstacles,
    `self_clearance` m between bodies of the arm; `ignored_pairs` of body names that may touch;
    `torque_limits` (n,) N m static, () none.  `mounting_plane`: links and tool stay on the arm's
    side of z = 0 of the base; None: where neither obstacles nor half-spaces are stated.

    Examples:
        >>> from elastocal.cell import HalfSpace
        >>> floor = HalfSpace(name="floor", point=[0, 0, 0], normal=[0, 0, 1])
        >>> ec.Workspace(keep_out=[floor], clearance=0.05).clearance
        0.05
    """

    obstacles: Many[Solid] = several("obstacle")
    bodies: Many[CarriedBody] = several("body")
    keep_out: Many[HalfSpace] = several()
    load: HangingLoad | None = optional()
    visibility: Visibility | None = optional()
    link_radius: Many[float] = several(
        "link_radius_mm", "link_radius_m", note=", or one per link (0: no body)", form=Radii
    )  # fmt: skip
    urdf_geometry: bool = keyed(
        "geometry",
        form=Literal["capsules", "urdf", "none"],
        into=lambda found, *_: found == "urdf",
        default=False,
    )
    self_collision: bool = keyed(default=True)
    mounting_plane: bool | None = optional()
    ignored_pairs: Many[Pair] = several(takes='pairs of names, as in [["link2", "link4"]]')
    clearance: NonNegative = keyed("clearance_mm", "clearance_m", default=0.0)
    self_clearance: NonNegative = keyed("self_clearance_mm", "self_clearance_m", default=0.0)
    torque_limits: Many[Positive] = several(
        "torque_limits_Nm", note=", one per joint", form=Positives
    )

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        _check_names(table, spot)
        radius = stated(table, spot, fields_of(cls)["link_radius"])
        geometry = table.get("geometry", "capsules" if radius else "none")
        require(
            radius or geometry != "capsules",
            'key workspace.link_radius_mm is missing; beside geometry = "capsules" it takes a '
            "positive number in mm, or one per link",
        )
        require(
            not radius or geometry == "capsules",
            f"key {spot.key(radius[1]) if radius else ''} has no meaning beside geometry = "
            f'"{geometry}"; drop one of them',
        )
        return {"link_radius": np.atleast_1d(radius[0]) if radius else ()}


def _check_names(table: Any, spot: Spot) -> None:
    places: dict[str, str] = {}
    for kind in ("obstacle", "body", "keep_out"):
        for i, entry in enumerate(table.get(kind, ())):
            here, name = (spot / kind / i).key("name"), getattr(entry, "solid", entry).name
            require(
                not PARTS.fullmatch(name),
                f"key {here} is {quoted(name)}, which names a part of the arm or its load; "
                "choose another",
            )
            require(
                name not in places,
                f"key {here} repeats {quoted(name)}, already {places.get(name)}; give every one "
                "a name of its own",
            )
            places[name] = here


class PluginsTable(Table):
    """Effects, criteria and noise models of the user's own."""

    modules: list[Text] | None = key(
        'a list of Python files or modules, as in ["my_effects.py", "my_package.effects"]'
    )


def _modules(table: PluginsTable, spot: Spot, name: str) -> tuple[str, ...]:
    modules = table.modules or ()
    for i, module in enumerate(modules):
        if is_plugin_file(module):
            check_exists(spot.path.parent / module, f"key plugins.modules[{i}]")
    return tuple(str(spot.path.parent / m) if is_plugin_file(m) else m for m in modules)


class Acceptance(Record):
    """What a calibration must keep to be accepted: 3-D rms errors in m, None for any.

    `heldout`: in poses left out of the fit, the noise of a reading included; `new_poses`: the
    upper end of the 95 % interval of the arm's own error where it will be used; `test`: on
    readings that took no part in the fit.
    """

    heldout: Positive | None = optional("heldout_um")
    new_poses: Positive | None = optional("new_poses_um")
    test: Positive | None = optional("test_um")


class CertificateEntries(Record):
    """What a calibration certificate states besides the results (ISO/IEC 17025, 7.8.2).

    `country` by two letters (ISO 3166).  `temperature` in °C.  `instrument_uncertainty` m: expanded
    (k = 2), of a length, as the instrument's own certificate `instrument_calibration` has it.
    `limit` m: the largest position error with which the arm conforms; None for no such statement.
    """

    number: Text | None = optional()
    laboratory: Text | None = optional()
    country: Country | None = optional(takes='the two letters of ISO 3166, as in "DE"')
    customer: Text | None = optional()
    robot_serial: Text | None = optional()
    tool_serial: Text | None = optional()
    instrument: Text | None = optional()
    instrument_calibration: Text | None = optional()
    place: Text | None = optional()
    measured_on: Annotated[str, holding(date.fromisoformat)] | None = optional(
        takes='the date of measurement, as in "2026-03-17"'
    )
    operator: Text | None = optional()
    procedure: Text | None = optional()
    temperature: float | None = optional("temperature_c", takes="a number in °C")
    instrument_uncertainty: NonNegative | None = optional("instrument_uncertainty_um")
    limit: Positive | None = optional("limit_um")

    @property
    def missing(self) -> list[str]:
        """The keys without which a document is no certificate."""
        keys = fields_of(type(self)).items()
        return [k[0].name for n, k in keys if n != "limit" and getattr(self, n) is None]


class Cell(Record):
    """Everything known about arm, tool, tracker and model before measuring.

    `limits` joint → (lower, upper) in rad or m, which narrow those of the robot.  `plugins`:
    Python files, as absolute paths or relative to the working folder, and importable modules;
    `Model` runs them where it is told to.
    `path`: the file that it was read from.

    Examples:
        >>> from elastocal.cell_tables import ModelSpec
        >>> cell = ec.Cell(
        ...     name="our arm",
        ...     robot=ec.Robot.from_urdf("kr270_2.urdf", flange="flange"),
        ...     tool=ec.Tool(markers={"M1": [0.25, 0.0, 0.05]}),
        ...     model=ModelSpec(effects=["base_frame", "joint_compliance:joint2"]),
        ... )
        >>> ec.Model(cell).names[-1]
        'joint2.compliance'
    """

    name: str = keyed(form=Text, required=False)
    path: File | None = field(default=None, compare=False)
    robot: Robot = keyed(
        takes='a table with urdf = "arm.urdf", mjcf = "arm.xml" or dh = "dh.csv"',
        required=True,
        default_factory=Robot,
    )
    tool: Tool = keyed(default_factory=Tool)
    tracker: Tracker = keyed(default_factory=Tracker)
    model: ModelSpec = keyed(default_factory=ModelSpec)
    limits: dict[str, Joint] = by_name(
        takes="[lower, upper] per joint, lower < upper, as in joint1_deg = [-170.0, 170.0] (for a "
        "joint that stands still [design.levels] takes its value, as in joint1_deg = [90])",
        form=dict[str, Joint],
        into=joint_values,
    )
    workspace: Workspace = keyed(default_factory=Workspace)
    design: DesignSpec = keyed(default_factory=DesignSpec)
    require: Acceptance = keyed(default_factory=Acceptance)
    certificate: CertificateEntries = keyed(default_factory=CertificateEntries)
    plugins: Many[Text] = several(form=PluginsTable, into=_modules)
    noise: Unsteadiness = keyed(default_factory=Unsteadiness)

    @classmethod
    def read(cls, path: str | Path, known_effects: Collection[str] | None = None) -> Cell:
        """Returns the cell that a TOML file describes, in SI units.

        Args:
            path: the cell file; paths in it are relative to it, and its files must exist.
            known_effects: as of `check`.

        Returns:
            The `Cell`; `Model` takes it as it takes the file.

        Raises:
            InputError: names file, key, what the key takes and the nearest valid name.

        Examples:
            >>> cell = ec.read_cell("cell.toml")
            >>> cell.model.observe, tuple(cell.tool.markers)
            ('deflection', ('M1', 'M2', 'M3'))
        """
        cell = checked(cls, read_toml(path, "cell file"), Path(path))
        cell.check(known_effects)
        return cell

    @property
    def source(self) -> str:
        """Its file, or its name, as messages begin."""
        return str(self.path or self.name)

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        return {"path": spot.path, "name": table.get("name") or spot.path.stem}

    def check(self, known_effects: Collection[str] | None = None) -> None:
        """Raises InputError where the parts of the cell do not fit together, which `replace` may
        leave, or `model.effects` names none of the `known_effects`; None leaves these unchecked."""
        where, sight = self.source, self.workspace.visibility
        freedom = self.design.choose
        for table, names in (
            (f"{where}: [workspace.visibility.normals]", sight.normals if sight else ()),
            (wish("marker_sigma", f"{where}: [design.marker_sigma_um]"), self.design.marker_sigma),
            (f"{where}: [design.choose.markers_m]", freedom.markers if freedom else ()),
        ):
            for name in names:
                told = f"{table} names {quoted(name)}, which is no marker of the cell"
                check_known(name, self.tool.markers, told, "[tool.markers_m] has")
        least = None if sight is None else sight.min_markers
        require(
            least is None or least <= len(self.tool.markers),
            f"{where}: key workspace.visibility.min_markers is {least}, but [tool.markers_m] has "
            f"{listed(self.tool.markers) or 'none'}; ask for fewer",
        )
        require(
            not self.workspace.urdf_geometry or self.robot.urdf is not None,
            f'{where}: key workspace.geometry = "urdf" needs [robot] urdf; give link_radius_mm '
            "for capsules along the links instead",
        )
        if known_effects is not None:
            for i, choice in enumerate(self.model.effects):
                told = f"{where}: key model.effects[{i}] names the unknown effect"
                told = f"{told} {quoted(choice.name)}"
                check_known(choice.name, tuple(known_effects), told, "known effects:")


read_cell = Cell.read


def files_of(cell: Cell) -> list[Path]:
    robot, targets = cell.robot, cell.design.test_path
    solids = [*cell.workspace.obstacles, *(body.solid for body in cell.workspace.bodies)]
    path = None if targets is None else targets.file
    named = [robot.urdf, robot.mjcf, robot.dh, robot.masses, cell.design.taught, path]
    named += [solid.mesh for solid in solids]
    named += [Path(name) for name in cell.plugins if is_plugin_file(name)]
    return [path for path in named if path is not None]
