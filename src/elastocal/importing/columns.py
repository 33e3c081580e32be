"""Which column of a file is which column of the measurement table, and in which unit."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from elastocal.errors import InputError
from elastocal.importing.schema import UnitsTable
from elastocal.importing.targets import AUTO, Target, target_of
from elastocal.importing.units import known_unit, quantities, split_unit
from elastocal.text import did_you_mean, listed, quoted

Where = int | str | list[str | int]
MOST_JOINTS = 64


@dataclass(frozen=True)
class Column:
    """`index` into the cells of a row (several are joined, for texts), the file's own name."""

    target: Target
    index: tuple[int, ...]
    header: str
    unit: str


@dataclass(frozen=True)
class Wanted:
    """The keys of [source.columns] (required) and [source.optional]."""

    required: tuple[tuple[Target, Where], ...]
    optional: tuple[tuple[Target, Where], ...]

    @property
    def by_name(self) -> bool:
        """Whether any required column is looked for by its name in a header."""
        return any(isinstance(part, str) for _, at in self.required for part in _parts(at))


def wanted(where: str, required: Mapping[str, Where], optional: Mapping[str, Where]) -> Wanted:
    """The keys checked.  Raises InputError for unknown columns and columns given twice."""
    seen: dict[str, str] = {}
    result: list[list[tuple[Target, Where]]] = []
    for part in (required, optional):
        targets = [(target_of(where, key), at) for key, at in part.items()]
        for target, at in targets:
            # Seconds and nanoseconds of one clock stand in two columns, and are added.
            name = target.key if target.stem == "time" else target.stem
            if name in seen:
                raise InputError(
                    f"{where}: {seen[name]} and {target.key} fill the same column; keep one"
                )
            seen[name] = target.key
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
) -> tuple[Column, ...]:  # fmt: skip
    """Where each column stands, and in which unit.

    `header`: names of the columns, () without a header; `width`: cells of the first row;
    `units`: for columns whose key ends in _auto where neither the header nor `hint`, the unit
    that a comment of the file states, says one.
    Raises InputError for names and numbers that the file does not have, names that stand for
    several columns, and units that contradict the header.
    """
    columns: list[Column] = []
    for target, at in asked.required:
        columns += _columns(source, target, at, header, width, True)
    for target, at in asked.optional:
        columns += _columns(source, target, at, header, width, False)
    return tuple(_with_unit(source, column, units, hint) for column in columns)


def _parts(at: Where) -> list[str | int]:
    return list(at) if isinstance(at, list) else [at]


def _columns(
    source: str, target: Target, at: Where, header: Sequence[str], width: int, required: bool
) -> list[Column]:
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
    source: str, target: Target, at: Where, header: Sequence[str], width: int, required: bool
) -> Column | None:
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
    return Column(target, tuple(index), " + ".join(names), target.unit)


def _named(part: str, target: Target) -> list[str]:
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


def _absent(source: str, target: Target, names: Sequence[str], header: Sequence[str]) -> str:
    what = " or ".join(quoted(name) for name in names)
    return (
        f"{source}: no column {what} for {target.key}{did_you_mean(names[0], header)}; the file "
        f"has {listed(map(quoted, header))}"
    )


def _with_unit(source: str, column: Column, units: UnitsTable, hint: str | None) -> Column:
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
    return Column(target, column.index, column.header, unit)
