"""The mapping file: what the columns, names and units of somebody's export mean."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from elastocal.config import (
    NonNegative,
    Positive,
    Table,
    Text,
    Vector3,
    checked,
    key,
    place,
    read_toml,
)
from elastocal.errors import InputError
from elastocal.text import did_you_mean, listed, quoted

# The keys of a mapping file: what the columns of somebody's export mean.

Place = Annotated[int, Field(ge=1)] | Text
Where = Place | Annotated[list[Place], Field(min_length=1)]
Texts = Annotated[list[Text], Field(min_length=1)]
COLUMNS = (
    'places in the file by column of the measurement table, as in x_mm = "X [mm]", q1_deg = 5, '
    'q#_deg = "A#" or name = "Point"'
)


class TextSourceKeys(Table):
    """How the text is written; what is left out is found out or taken from the preset."""

    format: Literal["table", "krl", "rapid"] | None = key('"table", "krl" or "rapid"')
    encoding: Literal["auto", "utf-8", "utf-16", "cp1252", "latin-1"] | None = key(
        '"auto", "utf-8", "utf-16", "cp1252" or "latin-1"'
    )
    delimiter: Literal["auto", ",", ";", "tab", "space"] | None = key(
        '"auto", ",", ";", "tab" or "space"'
    )
    decimal: Literal["auto", ".", ","] | None = key('"auto", "." or ","')
    thousands: Literal["none", ",", ".", " ", "'"] | None = key('"none", ",", ".", " " or "\'"')
    comments: list[Text] | None = key('a list of what begins a comment line, as in ["//", "#"]')
    ignore: Text | None = key("a regular expression for lines to pass over")
    unit_comment: Text | None = key("a regular expression with a group (?P<unit>…)")
    missing: list[str] | None = key('a list of cells that mean no value, as in ["-", "n/a"]')


class NamesTable(Table):
    """What a point's or pose's name says."""

    pattern: Text | Texts | None = key(
        "a regular expression with groups (?P<configuration>…), (?P<marker>…), (?P<repeat>…), "
        "(?P<load>…), or a list of them to be tried in order"
    )
    unmatched: Literal["refuse", "ignore"] | None = key('"refuse" or "ignore"')
    markers: dict[str, Text] | None = key('names by what the file says, as in { "1" = "M1" }')
    in_order: Texts | None = key('the markers in the order they are measured, as in ["M1", "M2"]')


class SourceTable(Table):
    """One kind of file."""

    preset: Text | None = key("the name of a preset (elastocal import --help lists them)")
    files: Texts | None = key('patterns of file names, as in ["loaded_*.txt"]')
    role: Literal["points", "joints", "both"] | None = key('"points", "joints" or "both"')
    load: Text | None = key("the name of a load of [loads], for all of these files")
    time_format: Text | Texts | None = key('how time_text is written, as in "%d.%m.%Y %H:%M:%S"')
    coverage_factor: Positive | None = key("a positive number k: the sigma columns hold k sigma")
    azimuth: Literal["counterclockwise", "clockwise"] | None = key(
        '"counterclockwise" or "clockwise", seen from above'
    )
    text: TextSourceKeys | None = key("a table")
    columns: dict[str, Where] | None = key(COLUMNS)
    optional: dict[str, Where] | None = key(COLUMNS + "; these may be absent")
    names: NamesTable | None = key("a table")


class CouplingTable(Table):
    joint: Annotated[int, Field(ge=1)] = Field(description="the number of the joint that follows")
    of: Annotated[int, Field(ge=1)] = Field(description="the number of the joint it follows")
    factor: float = Field(description="a number: the joint gets factor times the other's value")


class JointsTable(Table):
    """From the controller's joint values to those of the robot model."""

    names: Texts | None = key("the joint names of the file in the order of the robot's joints")
    order: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=1)] | None = key(
        "the number of the file's joint for each joint of the robot, as in [1, 2, 4, 3, 5, 6]"
    )
    sign: list[float] | None = key("1 or -1 per joint")
    offset_deg: list[float] | None = key("degrees per joint, added after the sign")
    offset_mm: list[float] | None = key("mm per joint, added after the sign, for prismatic joints")
    coupling: list[CouplingTable] | None = key("tables { joint = 3, of = 2, factor = 1.0 }")


class LoadStatesTable(Table):
    mass_kg: NonNegative = Field(description="a number >= 0 in kg; hangs straight down")


class JoinTable(Table):
    """How a point finds its joint values."""

    by: Literal["order", "name", "time", "standstill"] | None = key(
        '"order", "name", "time" or "standstill"'
    )
    points_per_pose: Annotated[int, Field(ge=1)] | None = key(
        "a whole number >= 1: points measured in each pose, for order"
    )
    tolerance_s: NonNegative | None = key("a number >= 0 in s: how far apart clocks may read")
    offset_s: float | None = key("a number in s, added to the times of the joint log")
    still_deg: Positive | None = key("a positive number of degrees: motion that counts as none")
    still_mm: Positive | None = key("a positive number of mm, for prismatic joints")
    still_s: NonNegative | None = key("a number >= 0 in s: the shortest standstill that counts")
    unmatched: Literal["refuse", "leave_out"] | None = key('"refuse" or "leave_out"')
    same_pose_deg: Positive | None = key("a positive number: joints this near are the same pose")
    same_pose_mm: Positive | None = key("a positive number of mm, for prismatic joints")


class UnitsTable(Table):
    """Units of presets' columns where the file does not say them."""

    length: Literal["mm", "m", "um", "cm", "in"] | None = key('"mm", "m", "um", "cm" or "in"')
    angle: Literal["deg", "rad", "mrad", "gon"] | None = key('"deg", "rad", "mrad" or "gon"')


class MappingTable(Table):
    source: Annotated[list[SourceTable], Field(min_length=1)] | None = key("[[source]] tables")
    units: UnitsTable | None = key("a table")
    joints: JointsTable | None = key("a table")
    loads: dict[Text, Vector3 | LoadStatesTable] | None = key(
        "forces in N in the tracker's frame by name, as in full = [0, 0, -2600], or "
        "{ mass_kg = 265 }"
    )
    join: JoinTable | None = key("a table")


# Reads a mapping file and the presets: TOML → checked tables, the user's keys on top.

MAX_BYTES = 1_000_000
PRESETS = ("spatialanalyzer", "polyworks", "leica", "faro", "spherical", "kuka", "abb", "ros")
# A key of [source.columns] with its unit cut off: what two keys for the same column share.
_UNIT = re.compile(r"_[A-Za-z]+$")


@dataclass(frozen=True)
class Mapping:
    """`path` says in messages where it was stated; `sources` have their presets merged in."""

    path: str
    table: MappingTable
    sources: tuple[SourceTable, ...]


def preset_text(name: str) -> str:
    """The TOML of a preset.  Raises InputError for an unknown name."""
    if name not in PRESETS:
        raise InputError(
            f"no preset {quoted(name)}{did_you_mean(name, PRESETS)}; there are {listed(PRESETS)}"
        )
    folder = resources.files("elastocal.importing") / "presets"
    return (folder / f"{name}.toml").read_text(encoding="utf-8")


def read_mapping(path: str | Path | None, presets: Sequence[str] = ()) -> Mapping:
    """The mapping of a file, of presets (one source each), or of both.

    A mapping file without [[source]] tables says how to join and convert what `presets` read.
    Raises InputError that names file, key, what the key takes and what was found.
    """
    where = "--preset" if path is None else str(path)
    data: dict[str, Any] = {} if path is None else read_toml(path, "mapping file", MAX_BYTES)
    if presets and data.get("source"):
        raise InputError(
            f"{where}: has [[source]] tables, so --preset {presets[0]} has no place; write "
            f'preset = "{presets[0]}" into the [[source]] it is for, or leave --preset out'
        )
    if presets:
        data = {**data, "source": [{"preset": name} for name in presets]}
    checked(MappingTable, data, where)
    if not data.get("source"):
        raise InputError(
            f'{where}: no [[source]] table; add one with preset = "{PRESETS[0]}" or columns, or '
            "give --preset"
        )
    merged = {**data, "source": [_with_preset(where, s) for s in data["source"]]}
    table = checked(MappingTable, merged, where)
    sources = table.source or []
    for k, source in enumerate(sources):
        if not source.columns:
            raise InputError(
                f"{where}: {place('source', k)} has neither preset nor columns; say where the "
                'numbers stand, as in x_mm = "X"'
            )
    return Mapping(where, table, tuple(sources))


def with_units(mapping: Mapping, length: str | None, angle: str | None) -> Mapping:
    """The mapping with the units of the command line, where given, instead of its own."""
    given = {k: v for k, v in (("length", length), ("angle", angle)) if v is not None}
    if not given:
        return mapping
    data = mapping.table.model_dump(exclude_none=True)
    data["units"] = data.get("units", {}) | given
    return replace(mapping, table=checked(MappingTable, data, "--length-unit, --angle-unit"))


def _with_preset(where: str, source: dict[str, Any]) -> dict[str, Any]:
    name = source.get("preset")
    if name is None:
        return source
    try:
        base = tomllib.loads(preset_text(name))
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    merged = {**base, **source}
    for part in ("text", "names"):
        merged[part] = base.get(part, {}) | source.get(part, {})
    # x_mm of the user replaces the preset's x_auto, whichever table either stands in.
    own = source.get("columns", {}) | source.get("optional", {})
    taken = {_UNIT.sub("", column) for column in own} | set(own)
    for part in ("columns", "optional"):
        kept = {
            column: at
            for column, at in base.get(part, {}).items()
            if _UNIT.sub("", column) not in taken and column not in taken
        }
        merged[part] = kept | source.get(part, {})
    return merged
