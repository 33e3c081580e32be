"""Which column of an export fills which column of the measurement table, and in which unit."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from elastocal.errors import InputError
from elastocal.importing.mapping_file import UnitsTable
from elastocal.measurements import families
from elastocal.text import did_you_mean, listed, quoted
from elastocal.units import FACTORS, known_unit, quantities, split_unit

TEXTS = ("name", "configuration", "marker", "repeat", "load", "time_text", "joint#")
AUTO = "auto"
_NUMBERED = re.compile(r"(q|torque_|approach_|joint)([1-9]\d?|#)((?:_[A-Za-z]+)?)")


def _quantities() -> dict[str, tuple[str, ...]]:
    """What each column of the measurement table, and each that becomes some of them, measures."""
    found: dict[str, tuple[str, ...]] = {"range": ("length",)}
    found |= dict.fromkeys(("azimuth", "zenith", "elevation"), ("angle",))
    for kind in ("revolute", "prismatic"):
        for family in families((kind,)).values():
            for stem, units in family.units.items():
                name = re.sub(r"^(q|torque_|approach_)1$", r"\1#", stem)
                if name not in TEXTS:
                    known = found.get(name, ())
                    found[name] = tuple(dict.fromkeys((*known, *quantities(units[0]))))
    return found


_QUANTITIES = _quantities()


@dataclass(frozen=True)
class ColumnKey:
    """A column to fill: `stem` ("x", "q3", "q#"), `unit` ("" where there is none, or "auto")."""

    key: str
    stem: str
    unit: str
    is_text: bool = False

    @property
    def quantities(self) -> tuple[str, ...]:
        return quantities_of(self.stem)

    @property
    def is_template(self) -> bool:
        """q#: one column for each joint."""
        return self.stem.endswith("#")

    def numbered(self, i: int) -> ColumnKey:
        """The column of joint i (from 1) of a template."""
        return ColumnKey(
            self.key.replace("#", str(i)), f"{self.stem[:-1]}{i}", self.unit, self.is_text
        )


def quantities_of(stem: str) -> tuple[str, ...]:
    """What the numbers of a column measure."""
    return _QUANTITIES[re.sub(r"^(q|torque_|approach_)\d+$", r"\1#", stem)]


def column_key(where: str, key: str) -> ColumnKey:
    """What a key of [source.columns] means.

    Raises InputError for an unknown column, a missing unit and a unit that it cannot have.
    """
    numbered = _NUMBERED.fullmatch(key)
    if numbered:
        family, number, tail = numbered.groups()
        if family == "joint" and not tail:
            return ColumnKey(key, key, "", is_text=True)
        stem, unit, general = f"{family}{number}", tail[1:], f"{family}#"
    else:
        if key in TEXTS:
            return ColumnKey(key, key, "", is_text=True)
        stem, unit = key, ""
        if key not in _QUANTITIES:
            stem, _, unit = key.rpartition("_")
        general = stem
    if general not in _QUANTITIES:
        valid = [*TEXTS, *_ways()]
        raise InputError(
            f"{where}: unknown column {quoted(key)}{did_you_mean(key, valid)}; columns are "
            f"{listed(valid, 40)}"
        )
    units = [u for quantity in _QUANTITIES[general] for u in FACTORS[quantity]]
    if unit == AUTO and units != [""]:
        return ColumnKey(key, stem, AUTO)
    if unit not in units:
        ways = listed(f"{stem}_{u}" if u else stem for u in units)
        what = f"the unit {unit} is not one of its" if unit else "has no unit"
        raise InputError(f"{where}: column {quoted(key)}: {what}; write {ways}")
    return ColumnKey(key, stem, unit)


def _ways() -> list[str]:
    return [
        f"{stem}_{next(iter(FACTORS[q[0]]))}".rstrip("_") if q[0] != "number" else stem
        for stem, q in _QUANTITIES.items()
    ]


Where = int | str | list[str | int]
MOST_JOINTS = 64


@dataclass(frozen=True)
class FileColumn:
    """`index` into the cells of a row (several are joined, for texts), the file's own name."""

    target: ColumnKey
    index: tuple[int, ...]
    header: str
    unit: str


@dataclass(frozen=True)
class Wanted:
    """The keys of [source.columns] (required) and [source.optional]."""

    required: tuple[tuple[ColumnKey, Where], ...]
    optional: tuple[tuple[ColumnKey, Where], ...]

    @property
    def by_name(self) -> bool:
        """Whether any required column is looked for by its name in a header."""
        return any(isinstance(part, str) for _, at in self.required for part in _parts(at))


def wanted(where: str, required: Mapping[str, Where], optional: Mapping[str, Where]) -> Wanted:
    """The keys checked.  Raises InputError for unknown columns and columns given twice."""
    observed: dict[str, str] = {}
    result: list[list[tuple[ColumnKey, Where]]] = []
    for part in (required, optional):
        targets = [(column_key(where, key), at) for key, at in part.items()]
        for target, at in targets:
            # Seconds and nanoseconds of one clock stand in two columns, and are added.
            name = target.key if target.stem == "time" else target.stem
            if name in observed:
                raise InputError(
                    f"{where}: {observed[name]} and {target.key} fill the same column; keep one"
                )
            observed[name] = target.key
            if target.is_template and any(isinstance(p, int) for p in _parts(at)):
                raise InputError(
                    f"{where}: {target.key} takes a name with # or #0 in it, as in "
                    f'"position_#0"; write {target.numbered(1).key} = {at}, … for columns by number'
                )
            if isinstance(at, list) and not target.is_text:
                raise InputError(
                    f"{where}: {target.key} takes one column; only texts such as name are joined "
                    "from several"
                )
        result.append(targets)
    return Wanted(tuple(result[0]), tuple(result[1]))


def lacking(asked: Wanted, cells: Sequence[str]) -> list[str]:
    """The required columns asked for by name that a line does not name, as the mapping has them."""
    absent = []
    for target, at in asked.required:
        first = target.numbered(1) if target.is_template else target
        for part in _parts(at):
            if isinstance(part, str) and not _find(_named(part, first), cells):
                absent.append(f"{target.key} = {quoted(part)}")
    return absent


def no_header(source: str, asked: Wanted, rows: Sequence[tuple[int, list[str]]]) -> InputError:
    """What to say where no line is the header: which line comes nearest, and what it lacks."""
    number, cells = min(rows, key=lambda row: len(lacking(asked, row[1])))
    return InputError(
        f"{source}: no line has all the columns that the mapping names; line {number} has "
        f"{listed(map(quoted, cells), 12)}, but not {listed(lacking(asked, cells), 8)}: correct "
        "the names, the delimiter or the comments in [source], or give columns by number"
    )


def resolve(
    source: str, asked: Wanted, header: Sequence[str], width: int, units: UnitsTable,
    hint: str | None,
) -> tuple[FileColumn, ...]:  # fmt: skip
    """Where each column stands, and in which unit.

    `header`: names of the columns, () without a header; `width`: cells of the first row;
    `units`: for columns whose key ends in _auto where neither the header nor `hint`, the unit
    that a comment of the file states, says one.
    Raises InputError for names and numbers that the file does not have, names that stand for
    several columns, and units that contradict the header.
    """
    columns: list[FileColumn] = []
    for target, at in asked.required:
        columns += _columns(source, target, at, header, width, True)
    for target, at in asked.optional:
        columns += _columns(source, target, at, header, width, False)
    return tuple(_with_unit(source, column, units, hint) for column in columns)


def _parts(at: Where) -> list[str | int]:
    return list(at) if isinstance(at, list) else [at]


def _columns(
    source: str, target: ColumnKey, at: Where, header: Sequence[str], width: int, required: bool
) -> list[FileColumn]:
    if not target.is_template:
        found = _column(source, target, at, header, width, required)
        return [] if found is None else [found]
    columns = []
    for i in range(1, MOST_JOINTS + 1):
        found = _column(source, target.numbered(i), at, header, width, required and i == 1)
        if found is None:
            break
        columns.append(found)
    return columns


def _column(
    source: str, target: ColumnKey, at: Where, header: Sequence[str], width: int, required: bool
) -> FileColumn | None:
    index, names = [], []
    for part in _parts(at):
        if isinstance(part, int):
            if part > width:
                if not required:
                    return None
                raise InputError(
                    f"{source}: {target.key} is column {part}, but the first reading has {width} "
                    "columns; correct the number in [source.columns], or the delimiter"
                )
            index.append(part - 1)
            names.append(header[part - 1] if part <= len(header) else f"column {part}")
            continue
        hits = _find(_named(part, target), header)
        if not hits:
            if not required:
                return None
            raise InputError(_absent(source, target, _named(part, target), header))
        if len(hits) > 1:
            raise InputError(
                f"{source}: {target.key} = {quoted(part)} could be column "
                f"{' or '.join(f'{i + 1} ({header[i]})' for i in hits)}; give its number"
            )
        index.append(hits[0])
        names.append(header[hits[0]])
    return FileColumn(target, tuple(index), " + ".join(names), target.unit)


def _named(part: str, target: ColumnKey) -> list[str]:
    """The names "A|B#" stands for, with the joint's number from 1 (#) or 0 (#0)."""
    number = re.search(r"\d+", target.stem) if "#" in part else None
    if number:
        part = part.replace("#0", str(int(number[0]) - 1)).replace("#", number[0])
    return [name.strip() for name in part.split("|")]


def _plain(name: str) -> str:
    return " ".join(name.split()).casefold()


def _find(names: Sequence[str], header: Sequence[str]) -> list[int]:
    """Columns with the first of the names that any has; by the whole header, else less its unit."""
    for name in names:
        for view in (_plain, lambda cell: _plain(split_unit(cell)[0])):
            hits = [i for i, cell in enumerate(header) if view(cell) == _plain(name)]
            if hits:
                return hits
    return []


def _absent(source: str, target: ColumnKey, names: Sequence[str], header: Sequence[str]) -> str:
    what = " or ".join(quoted(name) for name in names)
    return (
        f"{source}: no column {what} for {target.key}{did_you_mean(names[0], header)}; the file "
        f"has {listed(map(quoted, header))}"
    )


def _with_unit(source: str, column: FileColumn, units: UnitsTable, hint: str | None) -> FileColumn:
    """The column with its unit found out, or compared with what the file says."""
    target = column.target
    if target.is_text or target.unit == "":
        return column
    stated = split_unit(column.header)[1]
    if stated is not None and not set(quantities(stated)) & set(target.quantities):
        stated = None  # "Roll m" of a header is no unit of an angle
    if target.unit != AUTO:
        if stated is not None and stated != target.unit:
            raise InputError(
                f"{source}: column {quoted(column.header)} says {stated}, but the mapping has "
                f"{target.key}; write {target.stem}_{stated}, or correct the header"
            )
        return column
    told = known_unit(hint) if hint else None
    default = {"length": units.length, "angle": units.angle}
    general = [default[q] for q in target.quantities if default.get(q)]
    fitting = told if told and set(quantities(told)) & set(target.quantities) else None
    unit = stated or fitting or (general[0] if general else None)
    if unit is None:
        option = "--length-unit mm" if "length" in target.quantities else "--angle-unit deg"
        raise InputError(
            f"{source}: column {quoted(column.header)} states no unit; give {option}, [units] in "
            f"the mapping file, or {target.stem}_{option.split()[1]} in [source.columns]"
        )
    return FileColumn(target, column.index, column.header, unit)
