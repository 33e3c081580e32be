"""The mapping file: what the columns, names, numbers and units of somebody's export mean.

A mapping and its presets are read and checked first; against a file they then say which of its
columns fills which column of the measurement table, and in which unit.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from elastocal import config, messages
from elastocal.config import NonNegative, Positive, Table, Text, Vector3, checked, key, place
from elastocal.measurements import families
from elastocal.messages import NUMBER, InputError, did_you_mean, listed, option, quoted, require
from elastocal.tables import THOUSANDS, column, first_bad_cell
from elastocal.units import FACTORS, known_unit, quantities, split_unit

Place = Annotated[int, Field(ge=1)] | Text
Where = Place | Annotated[list[Place], Field(min_length=1)]
Texts = Annotated[list[Text], Field(min_length=1)]
PRESETS = (
    "spatialanalyzer", "polyworks", "leica", "faro", "spherical", "wide", "kuka", "abb", "ros",
)  # fmt: skip
COLUMNS = (
    'places in the file by column of the measurement table, as in x_mm = "X [mm]", q1_deg = 5, '
    'q#_deg = "A#" or name = "Point"'
)


class TextSourceKeys(Table):
    """How the text is written; what is left out is found out or taken from the preset."""

    format: Literal["table", "krl", "rapid"] = "table"
    encoding: Literal["auto", "utf-8", "utf-16", "cp1252", "latin-1"] = "auto"
    delimiter: Literal["auto", ",", ";", "tab", "space"] = "auto"
    decimal: Literal["auto", ".", ","] = "auto"
    thousands: Literal["none", ",", ".", " ", "'"] = "none"
    comments: list[Text] = key('a list of what begins a comment line, as in ["//", "#"]', [])
    ignore: Text | None = key("a regular expression for lines to pass over")
    unit_comment: Text | None = key("a regular expression with a group (?P<unit>…)")
    missing: list[str] = key('a list of cells that mean no value, as in ["-", "n/a"]', [])


class NamesTable(Table):
    """What a point's or pose's name says."""

    pattern: Text | Texts | None = key(
        "a regular expression with groups (?P<configuration>…), (?P<marker>…), (?P<repeat>…), "
        "(?P<load>…), or a list of them to be tried in order"
    )
    unmatched: Literal["refuse", "ignore"] = "refuse"
    markers: dict[str, Text] = key('names by what the file says, as in { "1" = "M1" }', {})
    in_order: Texts | None = key('the markers in the order they are measured, as in ["M1", "M2"]')


class SourceTable(Table):
    """One kind of file."""

    preset: Text | None = key(f"the name of a preset: {', '.join(PRESETS)}")
    files: Texts | None = key('patterns of file names, as in ["loaded_*.txt"]')
    role: Literal["points", "joints", "both"] | None = None
    load: Text | None = key("the name of a load of [loads], for all of these files")
    time_format: Text | Texts | None = key('how time_text is written, as in "%d.%m.%Y %H:%M:%S"')
    coverage_factor: Positive = key("a positive number k: the sigma columns hold k sigma", 1.0)
    azimuth: Literal["counterclockwise", "clockwise"] = key(
        '"counterclockwise" or "clockwise", seen from above', "counterclockwise"
    )
    text: TextSourceKeys = key("a table", TextSourceKeys())
    columns: dict[str, Where] = key(COLUMNS, {})
    optional: dict[str, Where] = key(COLUMNS + "; these may be absent", {})
    names: NamesTable = key("a table", NamesTable())


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
    coupling: list[CouplingTable] = key("tables { joint = 3, of = 2, factor = 1.0 }", [])


class LoadStatesTable(Table):
    mass_kg: NonNegative = Field(description="a number >= 0 in kg; hangs straight down")


class JoinTable(Table):
    """How a point finds its joint values."""

    by: Literal["order", "name", "time", "standstill"] | None = None
    points_per_pose: Annotated[int, Field(ge=1)] | None = key(
        "a whole number >= 1: points measured in each pose, for order"
    )
    tolerance_s: NonNegative = key("a number >= 0 in s: how far apart clocks may read", 0.5)
    offset_s: float = key("a number in s, added to the times of the joint log", 0.0)
    still_deg: Positive = key("a positive number of degrees: motion that counts as none", 0.01)
    still_mm: Positive = key("a positive number of mm, for prismatic joints", 0.01)
    still_s: NonNegative = key("a number >= 0 in s: the shortest standstill that counts", 1.0)
    unmatched: Literal["refuse", "leave_out"] = "refuse"
    same_pose_deg: Positive = key("a positive number: joints this near are the same pose", 0.05)
    same_pose_mm: Positive = key("a positive number of mm, for prismatic joints", 0.05)


class UnitsTable(Table):
    """Units of presets' columns where the file does not say them."""

    length: Literal["mm", "m", "um", "cm", "in"] | None = None
    angle: Literal["deg", "rad", "mrad", "gon"] | None = None


class MappingTable(Table):
    source: Annotated[list[SourceTable], Field(min_length=1)] | None = key("[[source]] tables")
    units: UnitsTable = key("a table", UnitsTable())
    joints: JointsTable = key("a table", JointsTable())
    loads: dict[Text, Vector3 | LoadStatesTable] = key(
        "forces in N in the tracker's frame by name, as in full = [0, 0, -2600], or "
        "{ mass_kg = 265 }",
        {},
    )
    join: JoinTable = key("a table", JoinTable())


# A key of [source.columns] with its unit cut off: what two keys for the same column share.
_UNIT = re.compile(r"_[A-Za-z]+$")


def preset_text(name: str) -> str:
    messages.check_known(name, PRESETS, f"no preset {quoted(name)}")
    folder = resources.files("elastocal.importing") / "presets"
    return (folder / f"{name}.toml").read_text(encoding="utf-8")


def read_mapping(
    path: str | Path | None, presets: Sequence[str] = (), length_unit: str | None = None,
    angle_unit: str | None = None,
) -> tuple[str, MappingTable]:  # fmt: skip
    """The mapping of a file, of presets (one source each), or of both, and where messages say that
    it was stated; units given count instead of its own.  A mapping file without [[source]] tables
    says how to join and convert what `presets` read."""
    given = {k: v for k, v in (("length", length_unit), ("angle", angle_unit)) if v is not None}
    checked(MappingTable, {"units": given}, f"{option('length_unit')}, {option('angle_unit')}")
    where = option("presets") if path is None else str(path)
    data: dict[str, Any] = {} if path is None else config.read_toml(path, "mapping file")
    if presets:
        told = f"has [[source]] tables, so {option('presets', presets[0])} has no place; write"
        remedy = f"into the [[source]] it is for, or leave {option('presets')} out"
        require(not data.get("source"), f'{where}: {told} preset = "{presets[0]}" {remedy}')
        data = {**data, "source": [{"preset": name} for name in presets]}
    checked(MappingTable, data, where)
    told = f'no [[source]] table; add one with preset = "{PRESETS[0]}" or columns, or give'
    require(data.get("source"), f"{where}: {told} {option('presets')}")
    merged = {"source": [_with_preset(where, s) for s in data["source"]]}
    table = checked(MappingTable, data | merged | {"units": data.get("units", {}) | given}, where)
    told = 'has neither preset nor columns; say where the numbers stand, as in x_mm = "X"'
    for k, source in enumerate(table.source or ()):
        require(source.columns, f"{where}: {place('source', k)} {told}")
    return where, table


def _with_preset(where: str, source: dict[str, Any]) -> dict[str, Any]:
    name = source.get("preset")
    if name is None:
        return source
    with messages.said_of(where):
        base = tomllib.loads(preset_text(name))
    # x_mm of the user replaces the preset's x_auto, whichever table either stands in.
    own = source.get("columns", {}) | source.get("optional", {})
    taken = {_UNIT.sub("", column) for column in own} | set(own)
    for part in ("columns", "optional"):
        base[part] = {c: at for c, at in base.get(part, {}).items()
                      if not {c, _UNIT.sub("", c)} & taken}  # fmt: skip
    tables = ("text", "names", "columns", "optional")
    return base | source | {part: base.get(part, {}) | source.get(part, {}) for part in tables}


TEXTS = ("name", "configuration", "marker", "repeat", "load", "time_text", "joint#")
AUTO = "auto"
_NUMBERED = re.compile(r"^(q|torque_|approach_|joint)([1-9]\d?|#)(?=_|$)")


def _of_any_joint(name: str) -> str:
    return _NUMBERED.sub(r"\1#", name)


_QUANTITIES: dict[str, tuple[str, ...]] = {"range": ("length",)}
_QUANTITIES |= dict.fromkeys(("azimuth", "zenith", "elevation"), ("angle",))
for _family in (*families(("revolute",)).values(), *families(("prismatic",)).values()):
    for _stem, (_unit, *_) in _family.units.items():
        if (_name := _of_any_joint(_stem)) not in TEXTS:
            _known = (*_QUANTITIES.get(_name, ()), *quantities(_unit))
            _QUANTITIES[_name] = tuple(dict.fromkeys(_known))


@dataclass(frozen=True)
class ColumnKey:
    """A column to fill: `stem` ("x", "q3", "q#"), `unit` ("" where there is none, or "auto").
    `quantities` that its units are of, the usual first (joints are angles first), none of a text;
    `at`: where the mapping has it; `required`: it is of [source.columns], not [source.optional].
    Found in a file, it has its `index` among the cells of a row (several are joined, for texts),
    the file's own name and its unit there."""

    key: str
    stem: str
    unit: str
    quantities: tuple[str, ...] = ()
    at: tuple[str | int, ...] = ()
    required: bool = True
    index: tuple[int, ...] = ()
    header: str = ""

    @property
    def of_each_marker(self) -> bool:
        return EACH in str(self.at[0])

    @property
    def spare(self) -> bool:
        """Whether readings can do without it: optional, and neither place, joint nor load."""
        return not self.required and self.quantities[0] in ("time", "temperature")

    def of_marker(self, name: str) -> ColumnKey:
        places = (p.replace(EACH, name) if isinstance(p, str) else p for p in self.at)
        return replace(self, at=tuple(places))


def column_key(where: str, key: str) -> ColumnKey:
    if _of_any_joint(key) in TEXTS:
        return ColumnKey(key, key, "")
    stem, unit = key, ""
    if _of_any_joint(key) not in _QUANTITIES:
        stem, _, unit = key.rpartition("_")
    if (general := _of_any_joint(stem)) not in _QUANTITIES:
        ways = [column(stem, next(iter(FACTORS[q[0]]))) for stem, q in _QUANTITIES.items()]
        valid = [*TEXTS, *ways]
        raise InputError(
            f"{where}: unknown column {quoted(key)}{did_you_mean(key, valid)}; columns are "
            f"{listed(valid, 40)}"
        )
    units = [u for quantity in _QUANTITIES[general] for u in FACTORS[quantity]]
    if unit not in units and (unit != AUTO or units == [""]):
        ways = [column(stem, u) for u in units]
        what = f"the unit {unit} is not one of its" if unit else "has no unit"
        raise InputError(f"{where}: column {quoted(key)}: {what}; write {listed(ways)}")
    return ColumnKey(key, stem, unit, _QUANTITIES[general])


MOST_JOINTS = 64
USUAL = {"length": "mm", "angle": "deg"}  # the quantities whose unit an option states
EACH = "*"  # in a place of [source.columns]: the name of a marker


def wanted(
    where: str, required: Mapping[str, Where], optional: Mapping[str, Where]
) -> tuple[ColumnKey, ...]:
    filled: dict[str, ColumnKey] = {}
    # q1 that is stated by itself counts before the q1 of q#, as of a preset.
    single = {column_key(where, name).stem for name in (*required, *optional) if "#" not in name}
    for name, at, needed in (*((*own, True) for own in required.items()),
                            *((*own, False) for own in optional.items())):  # fmt: skip
        target, places = column_key(where, name), at if isinstance(at, list) else [at]
        for wrong, told in (
            ("#" in name and any(isinstance(part, int) for part in places),
             ' takes a name with # or #0 in it, as in "position_#0"; write '
             f"{name.replace('#', '1')} = {at}, … for columns by number"),
            (target.quantities and isinstance(at, list),
             " takes one column; only texts such as name are joined from several"),
            (EACH in str(at) and not target.quantities,
             f" = {quoted(str(at))}: {EACH} stands for the markers of a row in places of numbers, "
             'as in x_mm = "*_x"'),
        ):  # fmt: skip
            require(not wrong, f"{where}: {name}{told}")
        every = [replace(target, at=tuple(places), required=needed)]
        if "#" in name:  # one column for each joint
            every = [
                replace(
                    target, key=name.replace("#", str(i)), stem=target.stem.replace("#", str(i)),
                    at=tuple(str(part).replace("#0", str(i - 1)).replace("#", str(i))
                             for part in places),
                    required=needed and i == 1,
                )
                for i in range(1, MOST_JOINTS + 1)
                if target.stem.replace("#", str(i)) not in single
            ]  # fmt: skip
        for one in every:
            # Seconds and nanoseconds of one clock stand in two columns, and are added.
            before = filled.setdefault(name if one.stem == "time" else one.stem, one)
            told = f"{where}: {before.key} and {name} fill the same column; keep one"
            require(before is one, told)
    return tuple(filled.values())


def lacking(asked: Sequence[ColumnKey], cells: Sequence[str]) -> list[str]:
    """The required columns asked for by name that a line does not have."""
    free = _unnamed(asked, cells)
    return [
        f"{target.key} = {quoted(part)}"
        for target in asked
        for part in target.at
        if target.required and isinstance(part, str)
        and not (_marker_names(target, free) if target.of_each_marker else _find(part, cells))
    ]  # fmt: skip


def markers_of_row(source: str, asked: Sequence[ColumnKey], header: Sequence[str]) -> list[str]:
    """As the file calls them; none where the mapping has no * in a place."""
    free = _unnamed(asked, header)
    found = {target: _marker_names(target, free) for target in asked if target.of_each_marker}
    names = list(dict.fromkeys(name for t, own in found.items() if t.required for name in own))
    for name in names:  # what is optional is there for all of them or for none
        if absent := [t for t, own in found.items()
                      if name not in own and (t.required or {*own} & {*names})]:  # fmt: skip
            raise InputError(
                f"{source}: {quoted(name)} has no column for {listed(t.key for t in absent)}, as "
                f"{quoted(str(absent[0].of_marker(name).at[0]))}; write the places so that {EACH} "
                "stands for the markers' names alone"
            )
    return names


def _unnamed(asked: Sequence[ColumnKey], header: Sequence[str]) -> list[str]:
    """Without the cells that the mapping calls by their whole name, as force_z: no marker is called
    force."""
    named = {_plain(name) for c in asked if not c.of_each_marker
             for part in c.at for name in str(part).split("|")}  # fmt: skip
    return [cell for cell in header if not named & {_plain(cell), _unitless(cell)}]


def _marker_names(target: ColumnKey, header: Sequence[str]) -> list[str]:
    found = []
    for cell in header:
        unit = split_unit(cell)[1]
        if unit is not None and not set(quantities(unit)) & set(target.quantities):
            continue
        for part in str(target.at[0]).split("|"):
            before, _, after = (re.escape(piece) for piece in part.strip().partition(EACH))
            for text in (" ".join(cell.split()), " ".join(split_unit(cell)[0].split())):
                if match := re.fullmatch(f"{before}(.+?){after}", text, re.IGNORECASE):
                    found.append(match[1])
    return list(dict.fromkeys(found))


def resolve(
    source: str, asked: Sequence[ColumnKey], header: Sequence[str], width: int,
    units: UnitsTable, hint: str | None,
) -> tuple[ColumnKey, ...]:  # fmt: skip
    """Where each column stands, and in which unit.  `header`: names of the columns, () without a
    header; `width`: cells of the first row; `units`: for columns whose key ends in _auto where
    neither the header nor `hint`, the unit that a comment of the file states, says one.  Times and
    temperatures that are optional have the unit AUTO where nothing says it."""
    found = (_column(source, target, header, width) for target in asked)
    columns = [_with_unit(source, one, units, hint) for one in found if one is not None]
    unstated = {c: column(c.stem, next(iter(FACTORS[c.quantities[0]]))) for c in columns
                if c.unit == AUTO and not c.spare}  # fmt: skip
    if not unstated:
        return tuple(columns)
    needed = [*dict.fromkeys(option(f"{q}_unit", unit) for c in unstated
                             if (unit := USUAL.get(q := c.quantities[0])))]  # fmt: skip
    more = f"; a mapping file says it by [units] or a key such as {next(iter(unstated.values()))}"
    more = more if needed else " of a mapping file"
    if by_key := [key for c, key in unstated.items() if c.quantities[0] not in USUAL]:
        needed.append(f"{listed(by_key)} in [source.columns]")
    several = len(unstated) > 1
    raise InputError(
        f"{source}: column{'s' * several} {listed((quoted(c.header) for c in unstated), 12)} "
        f"state{'s' * (not several)} no unit; give {' and '.join(needed)}{more}"
    )


def _column(source: str, target: ColumnKey, header: Sequence[str], width: int) -> ColumnKey | None:
    index = []
    for part in target.at:
        sought = [] if isinstance(part, int) else [name.strip() for name in part.split("|")]
        hits = [part - 1] * (part <= width) if isinstance(part, int) else _find(part, header)
        if not hits and not target.required:
            return None
        if not hits and not sought:
            raise InputError(
                f"{source}: {target.key} is column {part}, but the first reading has {width} "
                "columns; correct the number in [source.columns], or the delimiter"
            )
        if not hits:
            raise InputError(
                f"{source}: no column {' or '.join(map(quoted, sought))} for {target.key}"
                f"{did_you_mean(sought[0], header)}; the file has {listed(map(quoted, header))}"
            )
        could = " or ".join(f"{i + 1} ({header[i]})" for i in hits if len(hits) > 1)
        told = f"{target.key} = {quoted(part)} could be column {could}; give its number"
        require(not could, f"{source}: {told}")
        index.append(hits[0])
    names = (header[i] if i < len(header) else f"column {i + 1}" for i in index)
    return replace(target, index=tuple(index), header=" + ".join(names))


@lru_cache(4096)  # of one header many names are sought
def _plain(name: str) -> str:
    return " ".join(name.split()).casefold()


@lru_cache(4096)
def _unitless(name: str) -> str:
    return _plain(split_unit(name)[0])


def _find(names: str, header: Sequence[str]) -> list[int]:
    """Columns with the first of the names "A|B" that any has, by the whole header, else less its
    unit."""
    for name in names.split("|"):
        sought = _plain(name)
        for view in (_plain, _unitless):
            hits = [i for i, cell in enumerate(map(view, header)) if cell == sought]
            if hits:
                return hits
    return []


def _with_unit(source: str, target: ColumnKey, units: UnitsTable, hint: str | None) -> ColumnKey:
    if target.unit == "":
        return target
    stated = split_unit(target.header)[1]
    if stated is not None and not set(quantities(stated)) & set(target.quantities):
        stated = None  # "Roll m" of a header is no unit of an angle
    if target.unit != AUTO:
        require(
            stated in (None, target.unit),
            f"{source}: column {quoted(target.header)} says {stated}, but the mapping has "
            f"{target.key}; write {target.stem}_{stated}, or correct the header",
        )
        return target
    told = known_unit(hint) if hint else None
    general = {"length": units.length, "angle": units.angle}.get(target.quantities[0])
    fitting = told if told and set(quantities(told)) & set(target.quantities) else None
    return replace(target, unit=stated or fitting or general or AUTO)


MISSING = ("", "-", "--", "---", "n/a", "na", "nan", "none", "null")
ISO = "ISO 8601"


def unit_in_comments(where: str, pattern: str | None, comments: Sequence[str]) -> str | None:
    if pattern is None:
        return None
    expression = compiled(where, "unit_comment", pattern)
    told = "has no group (?P<unit>…); name the part that is the unit so"
    require("unit" in expression.groupindex, f"{where}: unit_comment = {quoted(pattern)} {told}")
    found = (match["unit"] for text in comments if (match := expression.search(text)))
    return next((unit for unit in found if unit and known_unit(unit)), None)


def compiled(where: str, key: str, pattern: str) -> re.Pattern[str]:
    try:
        return re.compile(pattern)
    except re.error as error:
        what = f"{key} = {quoted(pattern)} is no regular expression: {error}"
        raise InputError(f"{where}: {what}") from None


# A number in any style, and blanks and apostrophes in it as office programs write them.
_STYLED = re.compile(f"{NUMBER.pattern}|{THOUSANDS.pattern}")
_PLAIN = str.maketrans("\u00a0\u202f\u2009\u2019", "   '")


class NumberCells:
    """How the numbers of one file are written."""

    def __init__(
        self, decimal: str, thousands: str, missing: Sequence[str], sample: Iterable[str]
    ) -> None:
        self.thousands = "" if thousands == "none" else thousands
        self.missing = {*MISSING, *(text.strip().casefold() for text in missing)}
        self.decimal = decimal
        if decimal == "auto":
            bare = [text for cell in sample if _STYLED.fullmatch(text := self._bare(cell))]
            # Where a cell has both, the last is the decimal mark and the other is told as wrong.
            both = next((cell for cell in bare if "." in cell and "," in cell), None)
            points, commas = (any(mark in cell for cell in bare) for mark in ".,")
            usual = "," if commas and not points else "."
            self.decimal = max(".,", key=both.rfind) if both else usual

    def _bare(self, cell: str) -> str:
        text = cell.strip()
        text = text if text.isascii() else messages.plain_minus(text).translate(_PLAIN)
        return text.replace(self.thousands, "") if self.thousands else text

    def looks_numeric(self, cell: str) -> bool:
        bare = self._bare(cell)
        return bool(NUMBER.fullmatch(bare)) or bare.casefold() in self.missing - {""}

    def value(self, source: str, line: int, header: str, cell: str) -> float | None:
        """The number, None for a cell without a value."""
        text = self._bare(cell)
        if text.casefold() in self.missing:
            return None
        own = ("," if self.decimal == "." else ".") not in text and NUMBER.fullmatch(text)
        if own and math.isfinite(number := float(text.replace(",", "."))):
            return number
        others = [mark for mark in ",.' " if mark in text and mark != self.decimal]
        if others and _STYLED.fullmatch(text):
            raise InputError(
                f"{source}, line {line}, column {header}: {quoted(cell)} has "
                f"{' and '.join(map(quoted, others))} in it, but the file is read with decimal "
                f"{'points' if self.decimal == '.' else 'commas'}; set decimal or thousands in "
                "[source.text]"
            )
        found = first_bad_cell(source, [(line, [text])], {0: header}, True)
        raise InputError(
            f"{found}, or list it in missing if it means no value, or pass over such lines with "
            "ignore, both in [source.text]"
        )


def seconds_of(
    source: str, lines: Sequence[int], texts: Sequence[str], formats: Sequence[str]
) -> list[float]:
    """Seconds since 1970 (UTC); a time without a zone is taken as UTC.  The first of `formats`
    (strptime, or ISO 8601) that reads the first text reads all."""
    chosen, found = [*formats, ISO], list[float]()
    for line, text in zip(lines, texts, strict=True):
        t = " ".join(text.split())
        for form in chosen:
            with suppress(ValueError, OverflowError):
                read = datetime.fromisoformat(t) if form == ISO else datetime.strptime(t, form)
                found.append((read if read.tzinfo else read.replace(tzinfo=UTC)).timestamp())
                chosen = [form]
                break
        else:
            raise InputError(
                f"{source}, line {line}: {quoted(text)} is no time of the form "
                f"{' or '.join(chosen)}; set time_format in [[source]], or name it time_s (seconds)"
            )
    return found
